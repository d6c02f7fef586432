"""Reading of files that anybody may have written: regular ones only, and no more of them than they may hold."""

import os
from pathlib import Path
import stat

from thermal_fiducial.errors import InputError

#: Of a text that is taken into memory at once: a map of 1,700 markers has 2 MB.
TEXT_LIMIT_BYTES = 6_000_000


def read_bytes(path: str | Path, limit: int) -> bytes:
    """What is in a file of at most ``limit`` bytes.

    Raises
    ------
    InputError
        No such file, not a regular one (a device, a pipe, a folder), too large, or unreadable.
    """
    try:
        # A pipe without a writer would be waited for.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        name = str(path) if str(path).isprintable() else repr(str(path))
        raise InputError(f'{name}: cannot read it: {getattr(error, "strerror", None) or error}') from None
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f'{path}: not a regular file')
        if found.st_size > limit:
            raise InputError(f'{path}: {found.st_size} bytes, more than such a file may have ({limit})')
        with os.fdopen(descriptor, 'rb', closefd=False) as file:
            return file.read(found.st_size)
    except OSError as error:
        raise InputError(f'{path}: cannot read it: {error.strerror}') from None
    finally:
        os.close(descriptor)


def read_text(path: str | Path, limit: int = TEXT_LIMIT_BYTES) -> str:
    """The same as UTF-8 text.

    Raises
    ------
    InputError
        As :func:`read_bytes`, or not a text.
    """
    try:
        return read_bytes(path, limit).decode('utf-8')
    except UnicodeDecodeError:
        raise InputError(f'{path}: not a text file') from None


def cannot_write(path: str | Path, what: str, error: OSError) -> InputError:
    """The one line for a file that cannot be written."""
    return InputError(f'{path}: cannot write {what}: {error.strerror or error}')


def one_line(error: Exception, longest: int = 200) -> str:
    """What an error of a library says, printable and short enough for one line."""
    text = ' '.join(str(error).split())
    return ''.join(letter if letter.isprintable() else '?' for letter in text)[:longest]
