"""The folder for files that must survive a restart of the nodes."""

import os
from pathlib import Path

from thermal_fiducial.config import local_path


def robot_folder() -> Path:
    """ROS's folder for persistent files (ROS_HOME); it may not exist."""
    return Path(local_path(os.environ.get('ROS_HOME') or '~/.ros')) / 'thermal_fiducial'
