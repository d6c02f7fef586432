"""Writing of files: whole or not at all, and one line of what cannot be written."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import fcntl
import os
from pathlib import Path
from typing import TextIO

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.atomic import write_atomically


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a file, whole or not at all, and never into a pipe or a device.

    Raises
    ------
    InputError
        It cannot be written.
    """
    with into(path):
        write_atomically(Path(path), text)


def unfinished(path: Path) -> Path:
    """Where a file that grows lies until it is whole."""
    return path.with_name(f'{path.name}.part')


def claim(file: TextIO) -> None:
    """Let others see, by :func:`is_claimed`, that this process writes an open file, until it is closed."""
    # Where the file system has no locks.
    with suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_claimed(path: Path) -> bool:
    """Whether somebody is writing a file that he has claimed; what a killed process has left is nobody's."""
    try:
        with path.open('rb') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


@contextmanager
def new_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A file beside ``path`` for a library to write, which takes the place of ``path`` when it is whole.

    Raises
    ------
    InputError
        It cannot be written.
    """
    place = Path(path)
    new = place.with_name(f'.{place.stem}.{os.getpid()}{place.suffix}')
    try:
        with into(path):
            yield new
            new.replace(place)
    finally:
        # Where nothing can be written nothing can be removed either.
        with suppress(OSError):
            new.unlink()


@contextmanager
def into(path: str | os.PathLike[str]) -> Iterator[None]:
    """What the file system refuses while ``path`` is written (a full disk, a folder that is read-only) as one line.

    Raises
    ------
    InputError
        In the place of an OSError.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from None
