"""Camera against IMU: rotation, lever arm, time offset and read-out time, from one recording before known markers.

A batch adjustment of the whole recording. Every camera pose has a body state (pose, velocity, biases); consecutive
states are linked by the preintegrated IMU samples between them, and to the map by the camera poses and the extrinsics.
The times of the states are the camera's stamps plus the offset; a change of the offset moves them along their velocity,
and the samples are preintegrated again. J. Rehder et al., "Extending kalibr", ICRA 2016, estimates the same quantities
with splines, including scale errors and misalignments of the IMU: neglected, half a per cent of these biases the lever
arm by millimetres, and so does an accelerometer that is filtered more than the gyroscope, 20 ms late. The read-out time
is observable in the corners of each frame, and in the delay of poses with the rows that they are computed from.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress

import numpy as np

from thermal_fiducial.calibration.batch_adjustment import Problem, root_information, Solution
from thermal_fiducial.calibration.preintegration import AXES, Densities, GYROSCOPE_AXES, ImuTrack
from thermal_fiducial.calibration.rig_state import first_state, LARGEST_OFFSET, State
from thermal_fiducial.calibration.rolling import FrameCorners, RowMoments, SolvedFrame
from thermal_fiducial.config import ImuNoise, PoseEkfConfig
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import BoolArray, FloatArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError

_LEAST_POSES = 100
# Significance (standard deviations from zero) above which a read-out time is reported.
_SIGNIFICANT = 3.0
# Re-projection error [px] of most frames beyond which the map is wrong: a read-out of 16 ms that is not known yet
# bends an image by as much at 100 deg/s, most of which a pose takes up.
_MISFIT_PX = 20.0
# Scale errors and misalignments of an IMU beyond which it and the camera contradict each other: ten times the usual.
_OFF_AXES = 0.1
# Corners are moved to the middle row's time and poses solved again until read-out time and jitter converge [s].
_ROUNDS, _SETTLED = 8, 2e-5


@dataclass(frozen=True)
class CameraImuCalibration:
    """Result.

    Parameters
    ----------
    T_body_camera : (4, 4)
    time_offset : t_imu = t_camera + offset [s]; the bolometers' lag is part of it where the poses carry it
    covariance : (7, 7) of the rotation about the camera's axes [rad], position [m], offset [s]
    readout_time : from the sampling of the first row to that of the last [s]; negative where the last row is the first;
        0 unless it is clearly another
    readout_sigma : its standard deviation [s]; inf when the corners were not given
    stamp_jitter : standard deviation of the camera's stamps about the time offset [s]
    gravity_map : (3,) [m/s^2]
    bias : (6,) mean gyroscope and accelerometer bias
    force_delay, force_delay_sigma : of the accelerometer behind the gyroscope [s], and its standard deviation
    axes : (15,) scale errors and misalignments of the IMU, as :func:`preintegration.axis_errors` has them
    axes_sigma : (15,) their standard deviations
    residuals : (N, 6) of the camera poses, position and rotation, in the map [m, rad]
    poses : number that was used
    scale : factor on the given covariances at which the residuals are what they should be
    """

    T_body_camera: FloatArray
    time_offset: float
    covariance: FloatArray
    readout_time: float
    readout_sigma: float
    stamp_jitter: float
    gravity_map: FloatArray
    bias: FloatArray
    force_delay: float
    force_delay_sigma: float
    axes: FloatArray
    axes_sigma: FloatArray
    residuals: FloatArray
    poses: int
    scale: float


def calibrate_camera_imu(
    poses: Sequence[CameraPose], imu: ImuTrack, start_ns: int, noise: ImuNoise
) -> CameraImuCalibration:
    """Estimate the extrinsics from poses, as if all rows were read out at once.

    Poses do not say what they owe to an error of the lens: the covariance is without it.

    Parameters
    ----------
    poses : of the camera in the map, stamped by the camera's clock, in order
    imu : samples; times are seconds of the IMU's clock since ``start_ns``
    noise : of the IMU at rest; where it shakes, the samples show how much more there is

    Raises
    ------
    InputError
        Too few poses, no IMU samples around them, motion that the answer cannot be read from, or samples of another
        motion.
    """
    recording = _RigRecording(imu, start_ns)
    poses = list(compress(poses, recording.covers(poses)))
    _, first = recording.solved(poses, noise)
    problem, second = recording.solved(poses, imu.noise(noise), first.jitter, first.state)
    return _answer(problem.repeated(second), np.inf)


def calibrate_rolling_camera_imu(
    frames: Sequence[FrameCorners],
    camera: Camera,
    imu: ImuTrack,
    start_ns: int,
    noise: ImuNoise,
) -> CameraImuCalibration:
    """Estimate the extrinsics and the read-out time from the corners of mapped markers.

    Parameters
    ----------
    frames : in order, stamped by the camera's clock
    imu, start_ns, noise : as for :func:`calibrate_camera_imu`

    Raises
    ------
    InputError
        As there, or corners that are not where map and calibration have them.
    """
    recording = _RigRecording(imu, start_ns)
    at_once = _solved(frames, camera)
    at_once = list(compress(at_once, recording.covers([frame.pose for frame in at_once])))
    _require_fit(at_once)
    solved, _, first = _rolling(recording, at_once, camera, noise)
    shaken = imu.noise(noise)
    _, problem, second = _rolling(recording, solved, camera, shaken, first.jitter, first.state)
    second = problem.repeated(second)
    sigma = float(np.sqrt(second.covariance[9, 9]))
    if abs(second.state.readout) <= _SIGNIFICANT * sigma:
        poses = [frame.pose for frame in at_once]
        systematic = [frame.systematic for frame in at_once]
        problem, second = recording.solved(poses, shaken, first.jitter, first.state, systematic)
        second = problem.repeated(second)
    return _answer(second, sigma)


def _rolling(
    recording: '_RigRecording',
    solved: list[SolvedFrame],
    camera: Camera,
    noise: Densities,
    jitter: float = 0.0,
    state: State | None = None,
) -> tuple[list[SolvedFrame], Problem, Solution]:
    """Frames corrected to a global shutter, the last adjustment, and its solution."""
    readout = 0.0 if state is None else state.readout
    for _ in range(_ROUNDS):
        poses, rows = [frame.pose for frame in solved], [frame.rows for frame in solved]
        systematic = [frame.systematic for frame in solved]
        problem, solution = recording.solved(poses, noise, jitter, state, systematic, rows, readout)
        state = solution.state
        if abs(state.readout - readout) < _SETTLED:
            break
        readout = state.readout
        corners = [frame.corners for frame in solved]
        shifts, initial = _row_shifts(corners, camera, problem, state), [pose.T_map_camera for pose in poses]
        # The camera has seen them: what takes them out of its view, or away from their marker, is no motion of it.
        shown = all(np.isfinite(shift).all() for shift in shifts)
        solved = _solved(corners, camera, shifts, initial) if shown else []
        if len(solved) < len(corners) / 2:
            raise _contradiction(state)
    return solved, problem, solution


def _solved(
    frames: Sequence[FrameCorners],
    camera: Camera,
    shifts: Sequence[FloatArray | None] | None = None,
    initial: Sequence[FloatArray] | None = None,
) -> list[SolvedFrame]:
    """Frames that have a pose once their corners are moved by ``shifts`` (markers, 4, 2) [px]."""
    solved: list[SolvedFrame] = []
    for index, frame in enumerate(frames):
        start = initial[index] if initial else solved[-1].pose.T_map_camera if solved else None
        try:
            solved.append(frame.solved(camera, shifts[index] if shifts else None, start))
        except InputError:
            continue
    return solved


def _require_fit(frames: Sequence[SolvedFrame]) -> None:
    """Raise InputError if the corners of most frames do not fit the map."""
    apart_px = float(np.median([frame.pose.rms_px for frame in frames])) if frames else 0.0
    if apart_px > _MISFIT_PX:
        raise InputError(
            f'corners are {apart_px:.0f} px from where the map has them, in the median of the frames: positions and '
            'sides of the map in metres, its dictionary, the calibration?'
        )


def _row_shifts(frames: Sequence[FrameCorners], camera: Camera, problem: Problem, state: State) -> list[FloatArray]:
    """Rolling-shutter displacement (markers, 4, 2) [px] of the corners to the time of the middle row."""
    points = np.concatenate([frame.points.reshape(-1, 3) for frame in frames])
    rows = np.concatenate([frame.corners_px[..., 1].ravel() for frame in frames])
    delays = state.readout * camera.readout_shares(rows)
    counts = [4 * len(frame.sizes) for frame in frames]
    index = np.repeat(np.arange(len(frames)), counts)

    def pixels(after: FloatArray) -> FloatArray:
        T_camera_map = se3.inverse(problem.camera_poses(state, index, after))
        return camera.project((T_camera_map[:, :3, :3] @ points[:, :, None])[:, :, 0] + T_camera_map[:, :3, 3])

    shifts = pixels(np.zeros_like(delays)) - pixels(delays)
    return [part.reshape(-1, 4, 2) for part in np.split(shifts, np.cumsum(counts)[:-1])]


@dataclass(frozen=True)
class _RigRecording:
    """The data of a recording that are the same in every iteration."""

    imu: ImuTrack
    start_ns: int

    def covers(self, poses: Sequence[CameraPose]) -> BoolArray:
        """Which poses have IMU samples around them.

        Raises
        ------
        InputError
            Too few, or an axis of the IMU that never changes.
        """
        self.imu.require_signals()
        stamps, margin = self._seconds(poses), LARGEST_OFFSET + 0.05
        inside = (stamps > self.imu.seconds[0] + margin) & (stamps < self.imu.seconds[-1] - margin)
        inside[1:] &= np.diff(stamps) > 1e-4
        if inside.sum() < _LEAST_POSES:
            count = f'{number_of(int(inside.sum()), "camera pose")} with IMU samples around them'
            raise InputError(f'{count}: {_LEAST_POSES} or more are needed')
        return np.asarray(inside)

    def solved(
        self,
        poses: Sequence[CameraPose],
        noise: Densities,
        jitter: float = 0.0,
        state: State | None = None,
        systematic: Sequence[FloatArray] | None = None,
        rows: Sequence[RowMoments] | None = None,
        readout: float = 0.0,
    ) -> tuple[Problem, Solution]:
        """The adjustment of all poses, ``rows`` about ``readout``, and its solution, iterated from ``state`` on.

        Parameters
        ----------
        systematic : (6, K) of each pose, as :class:`SolvedFrame` has it

        Raises
        ------
        InputError
            Too little motion.
        """
        stamps, measured = self._seconds(poses), np.stack([pose.T_map_camera for pose in poses])
        root = np.stack([root_information(pose.covariance) for pose in poses])
        moments = None if rows is None else RowMoments.stacked(rows)
        shared = None if systematic is None else np.stack(systematic)
        problem = Problem(stamps, measured, root, self.imu, noise, moments, readout, jitter, shared)
        if state is None or len(state.p) != len(poses):
            state = first_state(stamps, measured, self.imu, PoseEkfConfig.gravity)
        return problem, problem.solved(state)

    def _seconds(self, poses: Sequence[CameraPose]) -> FloatArray:
        return np.array([(pose.stamp_ns - self.start_ns) * 1e-9 for pose in poses])


def _contradiction(state: State) -> InputError:
    """That only an IMU that none is explains what the camera shows, and the sensor that is off by most."""
    worst = int(np.argmax(np.abs(state.axes)))
    sensor = 'gyroscope' if worst < GYROSCOPE_AXES else 'accelerometer'
    return InputError(
        f'IMU and camera contradict each other, the {sensor} by {100.0 * abs(state.axes[worst]):.0f} %: axes, sign '
        'and units of the IMU, two IMUs on its topic, sides and places of the map, the lens, clocks that are more '
        f'than {LARGEST_OFFSET:g} s apart?'
    )


def _answer(solution: Solution, readout_sigma: float) -> CameraImuCalibration:
    """The result; raises InputError where IMU and camera contradict each other."""
    state = solution.state
    if np.abs(state.axes).max() > _OFF_AXES:
        raise _contradiction(state)
    return CameraImuCalibration(
        se3.transform(state.R_body_camera, state.p_body_camera),
        state.offset,
        solution.covariance[:7, :7],
        state.readout,
        readout_sigma,
        solution.jitter,
        state.gravity,
        state.bias.mean(axis=0),
        state.force_delay,
        float(np.sqrt(solution.covariance[10, 10])),
        state.axes,
        np.sqrt(np.diag(solution.covariance)[-AXES:]),
        solution.residuals,
        len(solution.residuals),
        solution.scale,
    )
