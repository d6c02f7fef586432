"""A node without parameters, and programs that run such a node in a process of their own."""

from dataclasses import dataclass
import os
from pathlib import Path
import signal
import subprocess
import sys

from support.waiting import PATIENCE_S
from thermal_fiducial.ros.base.node import StageNode

#: Statuses of a node that was asked to stop: SIGPROF ends one that DDS does not let go of, after all is saved.
STOPPED = {0, -signal.SIGPROF}

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Nothing:
    """No parameters."""


class EmptyStage(StageNode[Nothing]):
    """A node that has what all nodes have, and does nothing."""

    def __init__(self):
        super().__init__('stage', Nothing)


def environment():
    """Of a process that finds this package and this folder."""
    return os.environ | {'PYTHONPATH': f'{ROOT}{os.pathsep}{ROOT / "test"}'}


def finished(program, *arguments):
    """What a Python program printed and its exit status, once it has ended.

    Without lines of Fast DDS about shared memory that another process, of any domain, is just about to give up.
    """
    command = [sys.executable, '-c', program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False, env=environment())
    done.stderr = ''.join(line for line in done.stderr.splitlines(keepends=True) if 'RTPS_TRANSPORT_SHM' not in line)
    return done
