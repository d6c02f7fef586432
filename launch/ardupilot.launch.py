"""Localization for ArduPilot behind mavros: ``odometry/out`` at 20 Hz.

``ros2 launch thermal_fiducial ardupilot.launch.py map_file:=hall.yaml params_file:=rig.yaml``, beside mavros with its
``odometry`` and ``imu`` plugins. In ArduPilot: VISO_TYPE 3, EK3_SRC1_POSXY, _VELXY, _POSZ, _VELZ and _YAW 6 (external
navigation), VISO_DELAY_MS as measured; the origin of the EKF must be set.
"""

from launch import LaunchDescription

from thermal_fiducial.ros.launching import describe


def generate_launch_description() -> LaunchDescription:
    """The four nodes with the output of mavros, at the rate of ArduPilot."""
    return describe(
        'localization',
        [('bridge/odometry', 'mavros/odometry/out'), ('landing_target', 'mavros/landing_target/pose')],
        {'bridge_rate': 20.0, 'landing_target_frame': 'body'},
        {'imu_topic': 'mavros/imu/data'},
    )
