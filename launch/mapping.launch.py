"""Build a map: new markers enter it; it is saved on request and when the nodes are stopped.

``ros2 launch thermal_fiducial mapping.launch.py map_file:=hall.yaml params_file:=rig.yaml``, where ``hall.yaml`` holds
at least one marker whose pose is known.
"""

from launch import LaunchDescription

from thermal_fiducial.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """The four nodes in mapping mode."""
    return describe('mapping')
