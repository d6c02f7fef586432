"""The four nodes as processes of their own."""

from collections.abc import Sequence
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from typing import Self

from thermal_fiducial.config import NODES
from thermal_fiducial.errors import InputError

_PATIENCE_S = 15.0
_TICK = os.sysconf('SC_CLK_TCK')


class NodeProcesses:
    """One process a node, started by ``with`` and stopped in an orderly way, so that the map is saved.

    Parameters
    ----------
    domain_id : DDS domain
    ros_arguments : for the nodes, after ``--ros-args``
    """

    def __init__(self, domain_id: int, ros_arguments: Sequence[str]) -> None:
        self._environment = {**os.environ, 'ROS_DOMAIN_ID': str(domain_id)}
        self._arguments = ['--ros-args', *ros_arguments]
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        self._folder = tempfile.TemporaryDirectory(prefix='thermal_fiducial_')
        self._environment.setdefault('ROS_LOG_DIR', self._folder.name)
        for node in NODES:
            command = [sys.executable, '-m', f'thermal_fiducial.nodes.{node}', *self._arguments]
            with self._log(node).open('wb') as log:
                self._processes[node] = subprocess.Popen(
                    command, env=self._environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
                )
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        for process in self._processes.values():
            try:
                process.wait(_PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._folder.cleanup()

    def check(self) -> None:
        """Raise if a node has ended.

        Raises
        ------
        InputError
            It refused its parameters.
        RuntimeError
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
            raise RuntimeError(f'node {node} ended: {reason}')

    def cpu_seconds(self) -> dict[str, float]:
        """Processor time of each node so far."""
        return {node: _cpu_seconds(process.pid) for node, process in self._processes.items()}

    def _log(self, node: str) -> Path:
        return Path(self._folder.name) / f'{node}.txt'


def _cpu_seconds(pid: int) -> float:
    # Fields 14 and 15 of proc(5) stat, user and system; the name before them may hold blanks.
    words = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(words[11]) + int(words[12])) / _TICK
