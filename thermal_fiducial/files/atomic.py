"""Atomic replacement of files: a kill at any moment leaves either the old or the new content."""

from collections.abc import Iterator
from contextlib import contextmanager
import errno
import fcntl
import glob
import os
from pathlib import Path
import tempfile
import time

from thermal_fiducial.errors import InputError

#: Timeout for the lock of another program that writes in the same folder [s].
PATIENCE_S = 5.0
_POLL_S = 0.02
_MODE = 0o644


def write_atomically(path: Path, text: str) -> None:
    """Replace the content of ``path`` atomically: a concurrent reader sees the old text or the new one.

    A symbolic link is followed: its target is replaced.

    Raises
    ------
    OSError
        From the file system; the old file is then unchanged.
    """
    path = target(path)
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, 'not a regular file')
    descriptor, name = tempfile.mkstemp(prefix=f'.{path.name}.', suffix='.tmp', dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, 'w', encoding='utf-8') as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(path.stat().st_mode if path.exists() else _MODE)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """``fsync`` of ``folder``, so that renames and removals survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def clean_up(path: Path) -> None:
    """Remove temporary files of killed writers of ``path``; only under :func:`locked`."""
    path = target(path)
    for litter in path.parent.glob(f'.{glob.escape(path.name)}.*.tmp'):
        litter.unlink(missing_ok=True)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Context with an exclusive advisory lock on the folder of ``path``.

    The lock is on the folder itself, so no lock file can be left behind or planted.

    Raises
    ------
    InputError
        No such folder, or another program holds the lock for too long.
    """
    folder = path.parent
    try:
        folder = target(path).parent
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise InputError(f'{folder}: {error.strerror}') from None
    try:
        _wait_for(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def _wait_for(descriptor: int, folder: Path) -> None:
    until = time.monotonic() + PATIENCE_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() > until:
                raise InputError(f'{folder}: another program is writing there') from None
            time.sleep(_POLL_S)
        except OSError:
            # A file system without locks: a single writer is assumed.
            return


def target(path: Path) -> Path:
    """``path`` with symbolic links resolved. Raises OSError for a cycle of links."""
    try:
        return path.resolve()
    except RuntimeError:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP)) from None
