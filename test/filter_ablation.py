"""Prints what each mechanism of the filter buys, as ``make ablation`` does for detector and mapper.

For each mechanism one row: the lines that exist for it alone, and all figures of its scenes that change by more than a
tenth without it. A mechanism is switched off by a parameter, or by putting what does nothing in its place. Names of
mechanisms as arguments: only these. Recordings are taken where ``THERMAL_FIDUCIAL_DATA`` names their folder.
"""

from collections.abc import Callable
from dataclasses import replace
import sys
from typing import Any

import numpy as np
from support.filter_scenes import SCENES
from support.taken_out import Mechanism, Study

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.evidence import ClockEvidence
from thermal_fiducial.core.filter.pose_noise import LIMITS
from thermal_fiducial.core.filter.update import body_pose

FILTER = 'thermal_fiducial.core.filter'
#: Change of a figure that is worth printing.
NOTABLE = 0.1
#: Scenes that every mechanism is judged by.
ACCEPTANCE = ('brisk', 'cam0')


def _first(value: Any) -> Callable[..., Any]:
    """What returns its first argument behind ``self``."""
    return lambda self, given, *_: given if value is None else value


def _with_the_map(pose: Any, T_body_camera: Any, scale: float) -> Any:
    """The map's error as one that changes with the view."""
    return body_pose(replace(pose, map_covariance=np.zeros((6, 6))), T_body_camera, scale)


def _limits_with(place: int, value: float) -> Any:
    """Limits of the white errors' variances, with one of them fixed."""
    limits = LIMITS.copy()
    limits[:, place] = value
    return limits


MECHANISMS = {
    'systematic error of poses': Mechanism(('lasting errors',), changes={'systematic_pose_std': 0.01}),
    'error of the map apart': Mechanism(
        ('map in the making',), off={'hypotheses:body_pose': _with_the_map, 'history:body_pose': _with_the_map}
    ),
    'map of the present markers': Mechanism(
        ('map in the making',),
        (
            'pose_noise:BodyPose.map_changes',
            'pose_noise:BodyPose.moved_by',
            'update:_propagated_to_markers',
            'update:_in_map_of_markers',
            'update:map_jacobian',
        ),
        {'update:_propagated_to_markers': lambda config, estimate, _: estimate},
    ),
    'size of white errors is learned': Mechanism(
        ('noise of poses', 'lasting errors'),
        off={'pose_noise:LIMITS': _limits_with(0, 1.0)},
    ),
    'jitter of stamps': Mechanism(('jittering',), changes={'stamp_jitter': 0.0}),
    'jitter is learned': Mechanism(
        ('jittering',),
        off={'pose_noise:LIMITS': _limits_with(1, PoseEkfConfig().stamp_jitter ** 2)},
    ),
    'vibration of the mount': Mechanism(
        ('shaking mount',), ('update:mount_jacobian',), changes={'mount_vibration': 0.0}
    ),
    'scale of the gyroscope': Mechanism(('scale errors',), changes={'gyroscope_scale_std': 0.0}),
    'scale of the accelerometer': Mechanism(('scale errors',), changes={'accelerometer_scale_std': 0.0}),
    'delay of the accelerometer': Mechanism(('filtered apart',), changes={'accelerometer_delay_std': 0.0}),
    'floor of the vibration': Mechanism(('shaken',), ('imu_noise:NoiseFloor',), changes={'vibration': 0.0}),
    'noise in motion': Mechanism(
        ('nonlinear',),
        ('imu_noise:ImuNoiseMonitor._motion_of',),
        changes={'gyroscope_nonlinearity': 0.0, 'accelerometer_nonlinearity': 0.0},
    ),
    'what gaps hide': Mechanism(
        ('gaps of imu', 'stamped on arrival', 'carpet_slow_circle'),
        ('imu_noise:StructureFunction',),
        {'imu_noise:StructureFunction.interpolation_noise': lambda *_: (0.0, 0.0)},
    ),
    'saturation': Mechanism(('saturated',), off={'imu_noise:_SATURATED': (0.0, 0.0)}),
    'one bad sample': Mechanism(
        ('bad samples',), ('imu_input:Jumps',), {'imu_input:Jumps.is_corrupt': lambda *_: False}
    ),
    'frozen axes': Mechanism(('frozen',), ('imu_input:Axis',), {'imu_input:Axis.is_frozen': _first(False)}),
    'clock offset': Mechanism(
        ('slow and noisy', 'unknown clock at start'), changes={'estimate_time_offset': False, 'time_offset_std': 0.0}
    ),
    'second order of the clock offset': Mechanism(
        ('unknown clock at start', 'slow and noisy'), off={'update:_second_order_of_clock': lambda *_: 0.0}
    ),
    'covariance in the clock of the IMU': Mechanism(
        ('slow and noisy', 'unknown clock at start'),
        ('update:_in_clock_of_imu',),
        {'update:_in_clock_of_imu': lambda covariance, _: covariance},
    ),
    'errors in variables': Mechanism(
        ('slow and noisy',),
        ('evidence:ClockEvidence',),
        {'evidence:ClockEvidence.after': lambda *_: ClockEvidence(1.0)},
    ),
    'motion at a pose from 0.1 s': Mechanism(('slow and noisy',), off={'imu_buffer:_MOTION_SECONDS': 0.0}),
    'steps of the clock of the camera': Mechanism(
        ('stepping clock',), ('camera_clock:CameraClock',), {'camera_clock:CameraClock.proposed': _first(0)}
    ),
    'stamps off the grid of frames': Mechanism(
        ('small step of clock',), ('camera_clock:FrameGrid',), {'camera_clock:FrameGrid.off_grid': lambda *_: 0}
    ),
    'start about the learned clock offset': Mechanism(
        ('shaken start',),
        ('history:History._relinearise', 'hypotheses:relinearises'),
        {'history:relinearises': lambda *_: False},
    ),
    'second Gauss-Newton step': Mechanism(
        ('returning',),
        ('update:_iterated',),
        {'update:_iterated': lambda innovation, gain: gain @ innovation.value},
    ),
    'error of the extrinsics': Mechanism(
        ('carpet_mountain', 'carpet_slow_circle'),
        changes={'extrinsics_position_std': 0.0, 'extrinsics_orientation_std': 0.0},
    ),
    'tilt of the map': Mechanism(('tilted map',), changes={'map_tilt_std': 0.0}),
    'far poses need evidence': Mechanism(('twin marker', 'wrong poses'), off={'hypotheses:_ENOUGH_POSES': 0}),
    'contradiction in what is published': Mechanism(
        ('moved markers', 'stepping clock'),
        ('output:contradicting',),
        {'output:contradicting': lambda *_: None},
    ),
}


def main() -> None:
    """Print the table."""
    Study(FILTER, MECHANISMS, SCENES, NOTABLE, ACCEPTANCE).print(sys.argv[1:])


if __name__ == '__main__':
    main()
