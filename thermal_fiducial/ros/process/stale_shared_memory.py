"""Shared memory that killed processes have left: 5 MB for each, which Fast DDS takes away only on request."""

from contextlib import suppress
import fcntl
import os
from pathlib import Path
import re
import time

_SHARED = Path('/dev/shm')
#: Lock file of a segment; those of ports are Fast DDS's own affair.
_LOCK = re.compile(r'(fastrtps_[0-9a-f]{16})_el')
#: Age of a lock file [s] before which its owner may not have locked it yet.
_YOUNG_S = 10.0


def remove_stale_memory(folder: Path = _SHARED) -> None:
    """Remove segments of shared memory whose owner has ended, known by their lock, as ``fastdds shm clean`` does."""
    for file in folder.glob('fastrtps_*_el'):
        # Another user's, or removed by another node at this moment.
        with suppress(OSError):
            if name := _LOCK.fullmatch(file.name):
                _remove_unlocked(file, folder / name[1])


def _remove_unlocked(lock: Path, segment: Path) -> None:
    """Remove a segment and its lock; OSError while a process holds the lock."""
    descriptor = os.open(lock, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        if time.time() - os.fstat(descriptor).st_mtime > _YOUNG_S:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            segment.unlink(missing_ok=True)
            lock.unlink()
    finally:
        os.close(descriptor)
