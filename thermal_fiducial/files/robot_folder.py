"""The folder of the nodes themselves, for what outlives them."""

import os
from pathlib import Path


def robot_folder() -> Path:
    """Where ROS lets programs keep what outlives them; it need not be there."""
    return Path(os.environ.get('ROS_HOME', '~/.ros')).expanduser() / 'thermal_fiducial'
