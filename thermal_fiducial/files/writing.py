"""Writing of files: whole or not at all, and one line of what cannot be written."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path

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
