"""Reading of untrusted files: regular files only, with a size limit."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
from pathlib import Path
import stat
from typing import BinaryIO

from thermal_fiducial.errors import InputError

#: Largest text read into memory at once; a map of 1,700 markers has 2 MB.
TEXT_LIMIT_BYTES = 6_000_000
#: Longest line of a table; a camera pose with its covariance has 1,200 bytes.
LINE_LIMIT_BYTES = 10_000
#: Most consecutive blank lines of a table.
_BLANK_LINES = 100_000
#: Of a picture or an archive, or of a text as some editors save it: with umlauts in Latin-1, or all in UTF-16.
_NOT_UTF_8 = 'no text in UTF-8 (an editor can save it as such)'
#: Longest path or other name in an error message [characters].
_LONGEST_NAME = 400


def read_bytes(path: str | Path, limit: int) -> bytes:
    """Content of a file of at most ``limit`` bytes.

    Raises
    ------
    InputError
        No such file, not a regular one (a device, a pipe, a folder), too large, or unreadable.
    """
    with _opened(path, limit) as file:
        return file.read(os.fstat(file.fileno()).st_size)


def is_there(path: str | Path) -> bool:
    """Whether there is a file or folder; False also if its name is too long, or its folder closed to this user."""
    try:
        return Path(path).exists()
    except OSError:
        return False


def is_text(name: str) -> bool:
    """Whether a name can be written to a file: Python has names of files that are not UTF-8 with surrogates."""
    return not any('\ud800' <= letter <= '\udfff' for letter in name)


def shown(name: str | Path) -> str:
    """A path or another name of any length and letters as a message has it."""
    name = str(name) if str(name).isprintable() else repr(str(name))
    return name if len(name) <= _LONGEST_NAME else f'{name[:_LONGEST_NAME]}...'


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Let an InputError in this context begin with ``path``: what computes does not know where its input is from."""
    try:
        yield
    except InputError as error:
        raise InputError(f'{shown(path)}: {error}') from None


def require_regular(path: str | Path) -> None:
    """Raise InputError unless ``path`` is a readable regular file; reading a pipe or device might block forever."""
    with _opened(path, 1 << 63):
        pass


def require_folder(path: Path, kind: str = 'folder') -> None:
    """Raise InputError unless ``path`` is a folder; ``kind`` says of what."""
    if not path.is_dir():
        raise InputError(f'{path}: is a file, not a {kind}' if is_there(path) else f'{path}: no such {kind}')


@contextmanager
def _opened(path: str | Path, limit: int) -> Iterator[BinaryIO]:
    try:
        # Without O_NONBLOCK, opening a pipe without a writer blocks.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise InputError(f'{shown(path)}: cannot read it: {getattr(error, "strerror", None) or error}') from None
    try:
        found = os.fstat(descriptor)
        if stat.S_ISDIR(found.st_mode):
            raise InputError(f'{path}: is a folder, not a file')
        if not stat.S_ISREG(found.st_mode):
            raise InputError(f'{path}: not a regular file')
        if found.st_size > limit:
            raise InputError(f'{path}: {found.st_size} bytes, more than such a file may have ({limit})')
        with os.fdopen(descriptor, 'rb', closefd=False) as file:
            yield file
    except OSError as error:
        raise InputError(f'{path}: cannot read it: {error.strerror}') from None
    finally:
        os.close(descriptor)


def read_text(path: str | Path, limit: int = TEXT_LIMIT_BYTES) -> str:
    """:func:`read_bytes` as UTF-8 text.

    Raises
    ------
    InputError
        As :func:`read_bytes`, or not UTF-8.
    """
    content = read_bytes(path, limit)
    try:
        return content.decode('utf-8')
    except UnicodeDecodeError as error:
        line = content.count(b'\n', 0, error.start) + 1
        raise InputError(f'{path}: line {line}: {_NOT_UTF_8}') from None


def text_lines(path: str | Path, limit: int) -> Iterator[tuple[int, str]]:
    """Number, from 1, and text of each non-blank line of a file of at most ``limit`` bytes.

    Lines are read one at a time, so that reading a broken file ends at its first bad line.

    Raises
    ------
    InputError
        As :func:`read_bytes`, not UTF-8, a line that is too long, or too many blank lines.
    """
    number = last = 0
    with _opened(path, limit) as file:
        while data := file.readline(LINE_LIMIT_BYTES + 1):
            number += 1
            if len(data) > LINE_LIMIT_BYTES:
                raise InputError(f'{path}: line {number} is longer than {LINE_LIMIT_BYTES} bytes')
            try:
                # Spreadsheets begin a file with a byte order mark.
                line = data.decode('utf-8-sig').strip()
            except UnicodeDecodeError:
                raise InputError(f'{path}: line {number}: {_NOT_UTF_8}') from None
            if line:
                last = number
                yield number, line
            elif number - last > _BLANK_LINES:
                raise InputError(f'{path}: more than {_BLANK_LINES} blank lines from line {last + 1} on')


def one_line(error: Exception, longest: int = 200) -> str:
    """The message of an error as one printable line of limited length; its type if the message is empty."""
    text = ' '.join(str(error).split()) or type(error).__name__
    return ''.join(letter if letter.isprintable() else '?' for letter in text)[:longest]
