"""Notices that a node has gone deaf: Fast DDS has replaced a port of shared memory to which it listens.

A node that hardly got the processor for seconds is taken for dead by whoever opens its port of shared memory then, and
Fast DDS puts a new one in its place: the node goes on to listen to the old one, which others no longer find. Only a new
participant helps, so the node starts again.
"""

from contextlib import suppress
from pathlib import Path

#: Names of the threads that listen to a port of shared memory, and of the ports' files; a number follows.
_LISTENER, _PORT = 'dds.shm.', '/dev/shm/fastrtps_port'
_DELETED = ' (deleted)'


def replaced_ports() -> list[str]:
    """Numbers of the ports of shared memory to which this process listens although others would open new ones."""
    numbers = [name.removeprefix(_LISTENER) for name in _threads() if name.startswith(_LISTENER)]
    mapped = {line.partition(_PORT)[2] for line in Path('/proc/self/maps').read_text().splitlines() if _PORT in line}
    return sorted(number for number in numbers if number + _DELETED in mapped and number not in mapped)


def _threads() -> list[str]:
    """Names of this process's threads."""
    names = []
    for thread in Path('/proc/self/task').iterdir():
        # It may have ended since the folder was listed.
        with suppress(FileNotFoundError, ProcessLookupError):
            names.append((thread / 'comm').read_text().strip())
    return names
