"""Localization for PX4 over uXRCE-DDS: ``fmu/in/vehicle_visual_odometry`` at 50 Hz, no mavros.

``ros2 launch thermal_fiducial px4.launch.py map_file:=hall.yaml params_file:=rig.yaml``, with px4_msgs of the
firmware's version in the workspace and the Micro XRCE-DDS agent running. In PX4: EKF2_EV_CTRL 11 (position and yaw),
EKF2_HGT_REF 3 (vision), UXRCE_DDS_SYNCT 1 (common clock).
"""

from launch import LaunchDescription

from thermal_fiducial.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """The four nodes with the output for PX4."""
    return describe('localization', parameters={'bridge_rate': 50.0, 'px4': True})
