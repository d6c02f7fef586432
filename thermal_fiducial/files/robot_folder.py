"""The folder for files that must survive a restart of the nodes, and names of files of one robot or node."""

import hashlib
import os
from pathlib import Path

from thermal_fiducial.config import local_path

#: Longest name that is written out, and how much of a longer one is. Nodes have names of up to 225 characters, file
#: systems allow 255 or (eCryptfs) 143 in all; the name of a map and the ending of a temporary file need the rest.
_LONGEST, _SHORTENED = 80, 40


def robot_folder() -> Path:
    """ROS's folder for persistent files (ROS_HOME); it may not exist."""
    return Path(local_path(os.environ.get('ROS_HOME') or '~/.ros')) / 'thermal_fiducial'


def file_name_of(ros_name: str) -> str:
    """What stands for a node or a namespace in the name of a file; no other one has the same.

    A ROS name has neither dots nor hyphens.
    """
    name = ros_name.strip('/').replace('/', '.')
    if len(name) <= _LONGEST:
        return name
    # 128 bits: two names meet by chance nowhere.
    return f'{name[:_SHORTENED]}-{hashlib.sha256(name.encode()).hexdigest()[:32]}'
