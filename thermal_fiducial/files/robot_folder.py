"""The folder for files that must survive a restart of the nodes."""

import os
from pathlib import Path


def robot_folder() -> Path:
    """ROS's folder for persistent files (ROS_HOME); it may not exist."""
    return Path(os.environ.get('ROS_HOME', '~/.ros')).expanduser() / 'thermal_fiducial'
