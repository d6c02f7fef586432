"""The filter: IMU samples and camera poses in, in any order of arrival; the robot's state at every IMU sample out."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Hypothesis, PoseUpdate
from thermal_fiducial.core.filter.camera_clock import CameraClock, FrameGrid, SMALLEST_STEP_NS
from thermal_fiducial.core.filter.history import History
from thermal_fiducial.core.filter.hypotheses import KNOWN_OFFSET_STD, passes_with_unknown_clock
from thermal_fiducial.core.filter.imu_input import CLOCK_EVIDENCE, ImuInput, Verdict
from thermal_fiducial.core.filter.imu_noise import ImuNoiseMonitor
from thermal_fiducial.core.filter.output import condition_of, figures_of, leaning_map, odometry
from thermal_fiducial.core.filter.propagation import usable_seconds
from thermal_fiducial.core.filter.state import Estimate, NavigationState, TIME_OFFSET
from thermal_fiducial.core.geometry.plausibility import checked_covariance, require_pose
from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.measurements import CameraPose, Condition, ImuSample, Odometry
from thermal_fiducial.core.types import FloatArray, SECOND_NS
from thermal_fiducial.errors import InputError

#: Reason of a reset after a jump of the IMU's stamps, and of poses that wait until it is explained.
CLOCK_JUMPED = 'samples of the IMU are missing, or its clock has jumped'


class PoseEkf:
    """Left-invariant error-state Kalman filter with delayed, gated corrections.

    ``condition`` is its condition in words, ``diagnostics()`` in numbers; ``decided`` has the latest verdicts on poses.
    """

    def __init__(self, config: PoseEkfConfig) -> None:
        self._config = config
        self._restart_reason = ''
        self.reset()

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the dynamic parameters of ``config``."""
        self._config = self._history.config = config

    def reset(self, reason: str = 'on request') -> None:
        """Discard the estimate and all samples and poses; the diagnostics give the ``reason``."""
        config, self._restart_reason = self._config, reason
        self._imu_refused = self._refused_in_row = 0
        self._input = ImuInput(config.max_imu_gap, config.imu.gyroscope_range, config.imu.accelerometer_range)
        self._camera_clock, self._frame_grid = CameraClock(), FrameGrid()
        self._begin(config.camera_time_offset)

    def _begin(self, camera_time_offset: float) -> None:
        config = self._config
        #: prior of the clock offset t_imu - t_camera [s]
        self._first_offset = camera_time_offset
        self._noise = ImuNoiseMonitor(config.imu)
        self._history = History(config, camera_time_offset)
        #: T_new_first of the map's corrections since the filter began; it keeps its first map, and outputs are moved
        self._T_map_first: FloatArray | None = None
        #: on the last IMU sample
        self._verdict = Verdict.USE

    # --- input ----------------------------------------------------------------------------------------

    def add_imu(self, sample: ImuSample) -> Odometry | None:
        """Propagate to an IMU sample.

        Returns
        -------
        State at the sample's stamp; None before the filter is initialised and for a refused sample (``condition``
        says why).
        """
        if not self.keep_imu(sample):
            return None
        history = self._history
        history.take_in()
        if history.main is None:
            return None
        published = odometry(history, history.main)
        return published if self._T_map_first is None else published.in_moved_map(self._T_map_first)

    def keep_imu(self, sample: ImuSample) -> bool:
        """Buffer an IMU sample without propagating to it: the next :meth:`add_imu` propagates over all buffered ones.

        Returns
        -------
        Whether the sample was taken (``condition`` says why not).
        """
        verdict = self._input.judge(sample)
        if verdict is Verdict.RESTART:
            self._begin_after_jump()
        self._verdict = verdict
        if verdict not in (Verdict.USE, Verdict.RESTART):
            self._imu_refused += 1
            self._refused_in_row += 1
            return False
        self._refused_in_row = 0
        if self._input.jump_ns:
            self._camera_clock.imu_jumped(self._input.jump_ns)
        if self._input.excess_ns:
            self._history.suspect_steps(self._input.excess_ns, jumped=self._input.jump_ns != 0)
        imu, buffer = np.concatenate((sample.angular_velocity, sample.linear_acceleration)), self._history.imu
        seconds = (sample.stamp_ns - buffer.newest_ns) / SECOND_NS
        densities = self._noise.densities(imu, seconds) if len(buffer) else np.zeros(6)
        buffer.append(sample.stamp_ns, imu, densities)
        buffer.white = self._noise.white
        return True

    def add_pose(self, pose: CameraPose) -> PoseUpdate:
        """Correct the state at the instant of a camera pose; a pose ahead of the IMU waits for the samples.

        ``pose.stamp_ns`` is in the camera's clock; the clock offset, parameter and estimate, is added here.
        """
        stamp_ns = pose.stamp_ns
        if fault := _fault_of(pose):
            return PoseUpdate(stamp_ns, False, f'refused: {fault}', np.nan)
        off_grid_ns = self._frame_grid.off_grid(stamp_ns) if self._config.estimate_time_offset else 0
        if self._T_map_first is not None:
            pose = pose.in_moved_map(inverse(self._T_map_first))
        pose = self._in_present_clock(pose)
        if reason := self._unusable(pose):
            return PoseUpdate(stamp_ns, False, reason, np.nan)
        if off_grid_ns:
            self._history.suspect_camera_step(pose.stamp_ns, off_grid_ns)
        self._history.insert(pose)
        self._history.take_in()
        waiting = PoseUpdate(stamp_ns, False, 'waits for the IMU', np.nan, pending=True)
        return replace(self.decided.get(pose.stamp_ns, waiting), stamp_ns=stamp_ns)

    def _unusable(self, pose: CameraPose, instead_of: Collection[int] = ()) -> str:
        """Why a pose cannot be used; empty if it can. It may take the place of poses with other stamps."""
        if self._history.main is None and self._camera_clock.in_question:
            return CLOCK_JUMPED
        return self._history.untimely(pose, instead_of)

    def move_map(self, T_new_old: FloatArray) -> None:
        """Follow a correction of the map: T_new = T_new_old @ T_old. Of an initialisation, poses in the old map go."""
        if self._history.main is None:
            self._history.forget_poses()
            return
        self._T_map_first = T_new_old if self._T_map_first is None else T_new_old @ self._T_map_first

    # --- steps of the clocks --------------------------------------------------------------------------

    def _in_present_clock(self, pose: CameraPose) -> CameraPose:
        """``pose`` with all steps of the camera's clock taken out of its stamp, a step that it reveals included."""
        history, clock, pose = self._history, self._camera_clock, self._camera_clock.stamped(pose)
        if not history.imu:
            return pose
        interval_ns = self._input.longest_short_ns
        step_ns = clock.proposed(pose, history.imu.newest_ns, interval_ns)
        if not clock.suspects_imu:
            # Poses show that samples were lost at the jump: the clock of the IMU has not stepped.
            history.stepped = None
        if not step_ns:
            return pose
        if abs(step_ns) < SMALLEST_STEP_NS:
            self._allow_for_step(abs(step_ns))
            return pose
        restamped = replace(pose, stamp_ns=pose.stamp_ns - step_ns)
        if clock.is_step_of_imu(step_ns):
            # Since the step the state was propagated over time that did not pass.
            clock.follow(step_ns)
            self._begin_after_jump()
            return restamped
        if not self._contradicts(pose) or not self._fits(restamped):
            return pose
        std_ns = clock.uncertainty_ns(interval_ns)
        history.discard(clock.suspects)
        clock.follow(step_ns)
        if self._config.estimate_time_offset:
            history.suspect_camera_step(restamped.stamp_ns, std_ns)
        history.take_in()
        return restamped

    def _begin_after_jump(self) -> None:
        """Reset, but keep the estimated clock offset: where stamps jump, mostly samples are missing."""
        self._restart_reason = CLOCK_JUMPED
        main, known = self._history.main, self.camera_time_offset is not None
        learned = main.estimate.state.time_offset if main and known else 0.0
        self._begin(self._first_offset + learned)

    def _allow_for_step(self, size_ns: int) -> None:
        """Leave a step of the camera's clock to the offset: since its first pose that may be off by ``size_ns``.

        Poses may be late or early by as much without a step, and may not contradict the estimate if there is one.
        """
        first_ns = self._camera_clock.take_for_usual()
        if self._config.estimate_time_offset:
            self._history.suspect_camera_step(first_ns, size_ns)
            self._history.take_in()

    def _contradicts(self, pose: CameraPose) -> bool:
        """Whether a pose cannot be used with this stamp: as the last one it is refused, or its stamp is out of range.

        A pose that can be used has come later than usual; another one before it was wrong.
        """
        main = self._history.main
        if main is None:
            return False
        if self._history.due_ns(pose, main) > self._history.imu.newest_ns or self._unusable(pose):
            return True
        innovation = self._history.compared(pose)
        return main.accepted_in_row == 0 and (innovation is None or innovation.nis > self._config.gate)

    def _fits(self, pose: CameraPose) -> bool:
        """Whether a pose can be used instead of those that suggest a step, and passes the gate of an unknown clock."""
        if self._unusable(pose, self._camera_clock.suspects):
            return False
        innovation = self._history.compared(pose)
        return innovation is not None and passes_with_unknown_clock(self._config, innovation)

    # --- output ---------------------------------------------------------------------------------------

    @property
    def decided(self) -> Mapping[int, PoseUpdate]:
        """Latest verdict on each of the latest poses, by camera stamp."""
        return self._history.log.latest

    @property
    def state(self) -> NavigationState | None:
        """Estimate at the newest IMU sample."""
        main = self._history.main
        if main is None:
            return None
        state = main.estimate.state
        return state if self._T_map_first is None else state.in_moved_map(self._T_map_first)

    @property
    def estimate(self) -> Estimate | None:
        """State and whole covariance at the newest IMU sample, in the map before its corrections."""
        main = self._history.main
        return main.estimate if main else None

    @property
    def camera_time_offset(self) -> float | None:
        """Estimate of t_imu - t_camera [s]; None while its standard deviation is above ``KNOWN_OFFSET_STD``."""
        main = self._history.main
        if main is None or self._time_offset_std(main) > KNOWN_OFFSET_STD:
            return None
        return self._clock_offset(main)

    def _clock_offset(self, main: Hypothesis) -> float:
        """Estimate of t_imu - t_camera [s], for stamps as the camera gives them."""
        steps = self._camera_clock.ahead_ns / SECOND_NS
        return self._first_offset + main.estimate.state.time_offset - steps

    def _time_offset_std(self, main: Hypothesis) -> float:
        """Standard deviation of the clock offset [s]: of the estimate, else of the parameter."""
        config = self._config
        return main.estimate.std(TIME_OFFSET) if config.estimate_time_offset else config.time_offset_std

    @property
    def resets(self) -> int:
        """Times that an alternative hypothesis has replaced the estimate."""
        return self._history.belief.resets

    @property
    def reset_reason(self) -> str:
        """Why the estimate was last replaced or discarded."""
        return self._history.belief.reset_reason or self._restart_reason

    @property
    def condition(self) -> Condition:
        """What the filter does, or what it lacks."""
        if self._verdict is not Verdict.USE:
            of_sample: Condition = self._verdict.value
            return of_sample
        return condition_of(self._history, self._config)

    @property
    def doubts(self) -> list[Condition]:
        """Parameters that the flight contradicts: the camera is turned on the robot, or the map leans."""
        main, state = self._history.main, self.state
        if main is None or state is None:
            return []
        turned = main.estimate.mount.contradiction(self._config.extrinsics_orientation_std)
        return [doubt for doubt in (turned, leaning_map(main.estimate, state, self._config)) if doubt is not None]

    @property
    def status(self) -> str:
        """The condition as text."""
        return str(self.condition)

    @property
    def lost(self) -> bool:
        """Whether not to fly on the pose: worse than ``lost_position_std``, contradicted by poses, or without IMU."""
        main, imu_failed = self._history.main, self._verdict is Verdict.FROZEN or self._refused_in_row >= CLOCK_EVIDENCE
        if main is None or imu_failed or main.in_doubt:
            return True
        return main.estimate.position_std > self._config.lost_position_std

    @property
    def usable_for(self) -> float:
        """Seconds [s] until the position is worse than ``lost_position_std`` if no further pose arrives."""
        history, main = self._history, self._history.main
        if main is None:
            return 0.0
        return usable_seconds(main.estimate, history.imu.last.densities, history.walks, self._config.lost_position_std)

    def diagnostics(self) -> dict[str, float]:
        """Condition of the filter in numbers (SI units)."""
        rate, force = self._noise.vibration
        numbers = {
            'poses accepted': float(self._history.log.accepted),
            'poses refused': float(self._history.log.refused),
            'IMU samples refused': float(self._imu_refused),
            'NIS per d.o.f.': self._history.log.mean_nis(),
            'gyroscope noise under vibration': rate,
            'accelerometer noise under vibration': force,
        }
        main, state = self._history.main, self.state
        if main is None or state is None:
            return numbers
        of_filter = {
            'resets': float(self.resets),
            'usable for': self.usable_for,
            'time offset': self._clock_offset(main),
            'time offset std': self._time_offset_std(main),
        }
        return numbers | of_filter | figures_of(self._history, main, state)


def _fault_of(pose: CameraPose) -> str:
    """What of a pose's numbers cannot be: whoever calls the library has no messages, which are checked; else empty."""
    try:
        require_pose(pose.T_map_camera, 'camera pose')
        checked_covariance(pose.covariance, 'covariance')
        checked_covariance(pose.map_covariance, 'map_covariance', partial=True)
        checked_covariance(pose.covariance - pose.map_covariance, 'covariance without map_covariance', partial=True)
    except InputError as error:
        return str(error)
    return ''
