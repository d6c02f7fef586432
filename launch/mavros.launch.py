"""Localization for PX4 behind mavros: ``odometry/out`` at 30 Hz.

``ros2 launch thermal_fiducial mavros.launch.py map_file:=hall.yaml params_file:=rig.yaml``, beside mavros with its
``odometry`` plugin, whose frames are ours (``map`` and ``base_link``), and its ``imu`` plugin. In PX4: EKF2_EV_CTRL 11
(position and yaw), EKF2_HGT_REF 3 (vision). The pose alone (``bridge/pose`` to ``mavros/vision_pose/pose_cov``) would
do too, but says north where our map has any heading.
"""

from launch import LaunchDescription

from thermal_fiducial.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """The four nodes with the output of mavros."""
    return describe(
        'localization',
        [('bridge/odometry', 'mavros/odometry/out'), ('landing_target', 'mavros/landing_target/pose')],
        {'bridge_rate': 30.0, 'landing_target_frame': 'map'},
        {'imu_topic': 'mavros/imu/data'},
    )
