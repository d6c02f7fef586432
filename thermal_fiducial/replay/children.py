"""Runs the four nodes as separate processes."""

from collections.abc import Sequence
import os
from pathlib import Path
from shutil import which
import signal
import subprocess
import sys
import time
from typing import Self

from thermal_fiducial.errors import InputError, RunError
from thermal_fiducial.replay.own_namespace import kind_of, own_arguments

#: Idle time after SIGINT beyond which a node counts as hung [s].
_IDLE_S = 15.0
_GLANCE_S = 0.05
#: Lets the kernel stop a node when the replay ends, be it killed: nobody else would.
_ENDS_WITH_REPLAY = ('setpriv', '--pdeathsig', 'TERM') if which('setpriv') else ()
_TICK = os.sysconf('SC_CLK_TCK')


class NodeProcesses:
    """One process a node, started by ``with`` and stopped in an orderly way, so that the map is saved.

    Parameters
    ----------
    domain_id : DDS domain
    nodes : names of the nodes, those of a second camera with its namespace
    ros_arguments : for the nodes, after ``--ros-args``
    folder : for what the nodes print, and for the log files of ROS unless the user has set another place for them
    """

    def __init__(self, domain_id: int, nodes: Sequence[str], ros_arguments: Sequence[str], folder: Path) -> None:
        self._nodes = tuple(nodes)
        self._folder = folder
        self._environment = {'ROS_LOG_DIR': str(folder), **os.environ, 'ROS_DOMAIN_ID': str(domain_id)}
        self._arguments = ['--ros-args', *ros_arguments]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        #: after the end: messages on nodes that did not end properly
        self.unclean: list[str] = []

    def __enter__(self) -> Self:
        for node in self._nodes:
            self._start(node)
        return self

    def _start(self, node: str) -> None:
        module = f'thermal_fiducial.nodes.{kind_of(node)}'
        command = [*_ENDS_WITH_REPLAY, sys.executable, '-m', module, *self._arguments, *own_arguments(node)]
        with self._log(node).open('ab') as log:
            self._processes[node] = subprocess.Popen(
                command, env=self._environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
            )

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        for node, process in self._processes.items():
            if fault := _await_end(process):
                self.unclean.append(f'{node}: {fault}')

    def check(self) -> None:
        """Raise if a node has ended.

        Raises
        ------
        InputError
            It refused its parameters.
        RunError
            It died.
        """
        for node, process in self._processes.items():
            status = process.poll()
            if status is None:
                continue
            lines = self._log(node).read_text(errors='replace').strip().splitlines()
            reason = lines[-1] if lines else f'exit status {status}'
            if status == 2:
                raise InputError(reason)
            raise RunError(f'node {node} ended: {reason}')

    def crash(self, node: str) -> None:
        """Kill a node and restart it, as a launch file with respawn does."""
        self._processes[node].kill()
        self._processes[node].wait()
        self._start(node)

    @property
    def working(self) -> bool:
        """Whether any node computes or waits for a processor."""
        return any(_works(process.pid) for process in self._processes.values())

    def cpu_seconds(self) -> dict[str, float]:
        """Processor time of each node so far."""
        return {node: _cpu_seconds(process.pid) for node, process in self._processes.items()}

    def _log(self, node: str) -> Path:
        return self._folder / f'{node.replace("/", "_")}.txt'


def _await_end(process: subprocess.Popen[bytes]) -> str:
    """Wait while a process works, however slow the machine; kill it if it stays idle without ending.

    Returns
    -------
    Message if it did not end properly; else empty.
    """
    idle = 0
    while process.poll() is None and idle * _GLANCE_S < _IDLE_S:
        time.sleep(_GLANCE_S)
        idle += not _works(process.pid)
    if process.poll() is not None:
        return f'ended with status {process.returncode}' if process.returncode else ''
    process.kill()
    process.wait()
    return f'did not end within {_IDLE_S:g} idle seconds of SIGINT, killed'


def _works(pid: int) -> bool:
    """Whether a thread of the process runs, waits for a processor (R) or for a disk (D): the state in proc(5) stat."""
    for path in Path(f'/proc/{pid}/task').glob('*/stat'):
        try:
            state = path.read_text().rpartition(')')[2].split()[0]
        except OSError:  # the thread has just ended
            continue
        if state in 'RD':
            return True
    return False


def _cpu_seconds(pid: int) -> float:
    # Fields 14 and 15 of proc(5) stat, user and system; the name before them may contain blanks.
    words = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(words[11]) + int(words[12])) / _TICK
