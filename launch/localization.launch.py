"""Fly in a known map, which never changes.

``ros2 launch thermal_fiducial localization.launch.py map_file:=hall.yaml params_file:=rig.yaml``
"""

from launch import LaunchDescription

from thermal_fiducial.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """The four nodes in localization mode."""
    return describe('localization')
