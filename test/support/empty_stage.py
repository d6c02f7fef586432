"""A node without parameters, and programs that run such a node in a process of their own."""

from dataclasses import dataclass
import os
from pathlib import Path
import subprocess
import sys

from thermal_fiducial.ros.base.node import StageNode

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
    """What a Python program printed and its exit status, once it has ended."""
    command = [sys.executable, '-c', program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=environment())
