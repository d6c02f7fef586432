"""Atomic writing of files, with one-line errors."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import fcntl
import os
from pathlib import Path
from typing import TextIO

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.atomic import write_atomically


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a file atomically, and never into a pipe or a device.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    with into(path):
        write_atomically(Path(path), text)


def unfinished(path: Path) -> Path:
    """Temporary path of a growing file until it is complete."""
    return path.with_name(f'{path.name}.part')


def claim(file: TextIO) -> None:
    """Lock an open file until it is closed, to show others by :func:`is_claimed` that it is being written."""
    # The file system may have no locks.
    with suppress(OSError):
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_claimed(path: Path) -> bool:
    """Whether a process holds the claim on a file; that of a killed process is released."""
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
    """Context with a temporary path for a library to write; on success it replaces ``path``.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    place = Path(path)
    new = place.with_name(f'.{place.stem}.{os.getpid()}{place.suffix}')
    try:
        with into(path):
            yield new
            new.replace(place)
    finally:
        # If the folder is not writable, the removal fails too.
        with suppress(OSError):
            new.unlink()


@contextmanager
def into(path: str | os.PathLike[str]) -> Iterator[None]:
    """Context that converts an OSError while ``path`` is written (a full or read-only disk) to InputError.

    Raises
    ------
    InputError
        Instead of the OSError.
    """
    try:
        yield
    except OSError as error:
        raise InputError(f'{path}: {error.strerror or error}') from None
