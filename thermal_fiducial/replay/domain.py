"""A DDS domain of one's own, so that a replay meets neither a robot nor another replay."""

from collections.abc import Iterator
from contextlib import contextmanager
import fcntl
import os
from pathlib import Path
import tempfile

from thermal_fiducial.errors import InputError

#: Domains above 101 reach into the ports that Linux hands out to anybody; 0 is everybody's default.
_DOMAINS = range(1, 90)


@contextmanager
def own_domain() -> Iterator[int]:
    """Number of a domain that no other replay on this machine uses, for as long as the context lasts.

    Discovery is restricted to this machine, for this process and those that it starts.

    Raises
    ------
    InputError
        All are taken.
    """
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    for domain in _DOMAINS:
        path = Path(tempfile.gettempdir()) / f'thermal_fiducial_{os.getuid()}_domain_{domain}.lock'
        try:
            # In a folder that everybody may write to: what somebody else has put there is neither followed nor cut.
            file = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600), 'r+')
        except OSError:
            continue
        with file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            yield domain
            return
    raise InputError(f'all {len(_DOMAINS)} DDS domains for replays are in use on this machine')
