"""Hypotheses: how they are initialised, and updated by poses that pass the gate."""

from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Hypothesis
from thermal_fiducial.core.filter.initialization import blank_state, start
from thermal_fiducial.core.filter.innovations import PoseUpdate
from thermal_fiducial.core.filter.pose_noise import BodyPose
from thermal_fiducial.core.filter.state import (
    ACCELEROMETER_BIAS,
    GYROSCOPE_BIAS,
    NavigationState,
    POSE,
    SIZE,
    TIME_OFFSET,
)
from thermal_fiducial.core.filter.update import body_pose, MotionAtPose, PoseUpdater
from thermal_fiducial.core.measurements import CameraPose, Condition
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: Standard deviation [s] below which the clock offset counts as known, and the least that an alternative hypothesis
#: begins with: in the fastest flights it moves a marker by a pixel or two.
KNOWN_OFFSET_STD = 0.003
#: Standard deviations by which the first poses must have moved the clock offset for them to be used once more.
_MOVED_OFFSET = 3.0
#: A pose is far if it fails the gate even with the estimate's standard deviations times _FAR_TOO_SURE and _FAR [rad, m]
#: added: probably a moved or duplicated marker. An alternative hypothesis that begins there needs as many poses as the
#: estimate has accepted, at most _ENOUGH_POSES. Nearer ones need fewer: coasting for long would do more harm.
_FAR_TOO_SURE, _FAR, _ENOUGH_POSES = 10.0, np.repeat([0.05, 0.2], 3), 300


class Hypotheses:
    """Initialises and updates hypotheses with the parameters of one filter."""

    def __init__(self, config: PoseEkfConfig) -> None:
        self._updater = PoseUpdater(config)
        #: (48,) squared densities of the random walks
        self.random_walks = _random_walks(config)
        self.configure(config)

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the dynamic parameters of ``config``."""
        self.config = config
        self._updater.config = config

    def weigh(self, hypothesis: Hypothesis, motion: MotionAtPose, pose: CameraPose) -> tuple[Hypothesis, PoseUpdate]:
        """A hypothesis after a pose at its instant, and the verdict on the pose.

        One that has coasted longer than ``reinitialise_after`` must not be corrected any more.
        """
        estimate = hypothesis.estimate
        measured = self._measured(pose, estimate.state)
        innovation = self._updater.innovation(estimate, measured, motion)
        coasted = (estimate.stamp_ns - hypothesis.accepted_ns) / SECOND_NS
        stale = coasted > self.config.reinitialise_after
        if innovation.nis <= self.config.gate and not stale:
            corrected = self._updater.correct(measured, innovation, motion)
            return hypothesis.accepting(corrected), PoseUpdate(pose.stamp_ns, True, '', innovation.nis)
        noise = self._updater.adapted(estimate.pose_noise, measured, innovation)
        refusing = hypothesis.refusing(replace(estimate, pose_noise=noise))
        why = f'after {coasted:.0f} s without one' if stale else f'{math.sqrt(innovation.nis):.1f} sigma'
        return refusing, PoseUpdate(pose.stamp_ns, False, f'refused: {why}', innovation.nis)

    def contradiction(self, hypothesis: Hypothesis, motion: MotionAtPose, pose: CameraPose) -> Condition:
        """Which sensor of the IMU a refused pose contradicts; ``hypothesis`` is at the pose's instant."""
        estimate = hypothesis.estimate
        measured = self._measured(pose, estimate.state)
        innovation = self._updater.innovation(estimate, measured, motion)
        turn, shift = innovation.value[:3], innovation.value[3:]
        seconds = (hypothesis.estimate.stamp_ns - hypothesis.accepted_ns) / SECOND_NS
        if turn @ np.linalg.solve(np.linalg.inv(innovation.S_inverse)[:3, :3], turn) > self.config.gate:
            apart = f'{math.degrees(np.linalg.norm(turn)):.0f} deg apart after {seconds:.2f} s'
            return Condition('poses contradict the gyroscope', f'{apart}; its units, axes, sign? camera_orientation?')
        apart = f'{np.linalg.norm(shift):.2f} m apart after {seconds:.2f} s'
        details = f'{apart}; its units, axes, sign? marker_size?'
        return Condition('poses contradict the accelerometer, or each other', details)

    def explains(self, hypothesis: Hypothesis, pose: CameraPose, motion: MotionAtPose) -> bool:
        """Whether a pose at a hypothesis's instant passes the gate once the clock offset is taken for unknown."""
        estimate = hypothesis.estimate
        measured = self._measured(pose, estimate.state)
        unclocked = self._updater.with_unknown_clock(estimate)
        return self._updater.innovation(unclocked, measured, motion).nis <= self.config.gate

    def _measured(self, pose: CameraPose, state: NavigationState) -> BodyPose:
        return body_pose(pose, state.T_body_camera, self.config.pose_noise_scale)

    def from_nothing(self, pose: CameraPose, time_ns: int, window: FloatArray, time_offset: float) -> Hypothesis | None:
        """A hypothesis initialised from a pose without prior; None where the pose contradicts gravity.

        Parameters
        ----------
        window : (N, 6) the latest samples up to the pose's instant ``time_ns``
        time_offset : clock offset [s], beyond the parameter's, about which to linearise
        """
        blank = replace(blank_state(self.config), time_offset=time_offset)
        return self._begun(pose, time_ns, window, blank, self.config.time_offset_std)

    def relinearises(self, begun: Hypothesis, first_offset: float) -> bool:
        """Whether a hypothesis that began at ``first_offset`` [s] has learned another clock offset."""
        estimate = begun.estimate
        moved = abs(estimate.state.time_offset - first_offset)
        return moved > max(KNOWN_OFFSET_STD, _MOVED_OFFSET * estimate.std(TIME_OFFSET))

    def alternative_to(
        self, main: Hypothesis, pose: CameraPose, time_ns: int, motion: MotionAtPose, window: FloatArray
    ) -> Hypothesis | None:
        """A hypothesis initialised from a pose that ``main``, at the same instant, refuses.

        Position and attitude are those of the pose; biases, scale errors and extrinsics are those of ``main``.
        """
        estimate = main.estimate
        measured = self._measured(pose, estimate.state)
        begun = self._begun(pose, time_ns, window, estimate.state, self._clock_std(main, pose, motion))
        if begun is None:
            return None
        widened = _far_covariance(estimate.covariance)
        far = self._updater.innovation(replace(estimate, covariance=widened), measured, motion)
        needed = 0 if far.nis <= self.config.gate else min(main.hits, _ENOUGH_POSES)
        return begun._replace(needed=needed)

    def _clock_std(self, main: Hypothesis, pose: CameraPose, motion: MotionAtPose) -> float:
        """Initial standard deviation of an alternative's clock offset [s].

        The parameter's where an unknown offset explains why ``main`` refuses the pose, else that of ``main``.
        """
        unknown = self.config.time_offset_std
        if self.explains(main, pose, motion):
            return unknown
        return min(unknown, math.hypot(main.estimate.std(TIME_OFFSET), KNOWN_OFFSET_STD))

    def _begun(
        self, pose: CameraPose, time_ns: int, window: FloatArray, prior: NavigationState, clock_std: float
    ) -> Hypothesis | None:
        config = replace(self.config, time_offset_std=clock_std)
        measured = self._measured(pose, prior)
        estimate = start(config, measured, time_ns, prior, window)
        if estimate is None:
            return None
        return Hypothesis(estimate, time_ns, time_ns)


def _far_covariance(covariance: FloatArray) -> FloatArray:
    """The covariance (48, 48) against which a pose counts as far, see ``_FAR_TOO_SURE`` and ``_FAR``."""
    widened = _FAR_TOO_SURE**2 * covariance
    widened[POSE, POSE] += np.square(_FAR)
    return widened


def _random_walks(config: PoseEkfConfig) -> FloatArray:
    """Squared densities (48,) of the random walks."""
    walks = np.zeros(SIZE)
    walks[GYROSCOPE_BIAS] = config.imu.gyroscope_random_walk
    walks[ACCELEROMETER_BIAS] = config.imu.accelerometer_random_walk
    walks[TIME_OFFSET] = config.time_offset_random_walk
    return np.square(walks)
