"""Samples, poses and the belief after each pose; late poses are inserted at their stamp, and later ones re-applied.

The belief after a pose depends on the samples and poses up to that instant, in the order of their stamps, not of their
arrival. The exception is ``MotionAtPose``, which also averages the few samples after the pose that have arrived.
"""

from bisect import bisect_left, bisect_right, insort
from collections.abc import Collection, Iterable
from dataclasses import replace
import math
from operator import attrgetter

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.belief import Belief, Hypothesis, PoseLog
from thermal_fiducial.core.filter.camera_clock import SMALLEST_STEP_NS
from thermal_fiducial.core.filter.hypotheses import belief_after, relinearises
from thermal_fiducial.core.filter.imu_buffer import ImuBuffer
from thermal_fiducial.core.filter.initialization import WINDOW_SECONDS
from thermal_fiducial.core.filter.propagation import propagated, random_walks
from thermal_fiducial.core.filter.state import clock_offset_derivative, embedded_core, Estimate, SIZE, TIME_OFFSET
from thermal_fiducial.core.filter.update import body_pose, Innovation, innovation_of
from thermal_fiducial.core.geometry.se3 import screw_difference
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.two_poses import DECISIVE, possible_poses, unknown_turn
from thermal_fiducial.core.types import SECOND_NS

#: Standard deviation of a suspected step of the IMU's clock as a share of its size: the clock has stepped by all of it,
#: or samples are lost and it has not stepped, with equal odds.
_STEP_OR_LOSS = 0.5
#: Share of the unusual steps between samples that are steps of all clocks, or of the IMU's by 35 ms and more: at all
#: recorded gaps samples were lost.
STEPS = 0.1
#: Error coordinates of 1 s of clock offset alone.
_OF_CLOCK_OFFSET = np.eye(SIZE)[TIME_OFFSET]
_stamp = attrgetter('stamp_ns')


class History:
    """Buffers of IMU samples, camera poses, beliefs and verdicts.

    Parameters
    ----------
    camera_time_offset : prior of the clock offset t_imu - t_camera [s]
    """

    def __init__(self, config: PoseEkfConfig, camera_time_offset: float) -> None:
        #: dynamic parameters may change
        self.config = config
        #: (55,) squared densities of the random walks
        self.walks = random_walks(config)
        self._kept_ns = round((config.max_delay + WINDOW_SECONDS) * SECOND_NS)
        self._offset_ns = round(camera_time_offset * SECOND_NS)
        self.imu, self.log = ImuBuffer(), PoseLog()
        self._poses: list[CameraPose] = []
        #: after each pose; the first is before all poses that may still be inserted
        self._beliefs = [Belief()]
        #: suspected steps of the camera's clock [ns], by the stamp of the first pose behind them
        self._camera_steps: dict[int, int] = {}
        #: suspected steps of the IMU's clock: stamp of the sample before [ns], standard deviation [s]
        self._imu_steps: list[tuple[int, float]] = []
        #: the same of all clocks
        self._clock_steps: list[tuple[int, float]] = []
        #: main hypothesis of the latest belief, propagated to the newest sample
        self.main: Hypothesis | None = None
        #: the same if the last jump of the IMU's stamps is a step of its clock, until that is known
        self.stepped: Hypothesis | None = None

    @property
    def belief(self) -> Belief:
        """The latest belief."""
        return self._beliefs[-1]

    def due_ns(self, pose: CameraPose, hypothesis: Hypothesis | None, first_offset: float = 0.0) -> int:
        """Instant of a pose in the IMU's clock, by the clock offset of ``hypothesis``; without one ``first_offset``."""
        offset = hypothesis.estimate.state.time_offset if hypothesis else first_offset
        return pose.stamp_ns + self._offset_ns + round(offset * SECOND_NS)

    def untimely(self, pose: CameraPose, instead_of: Collection[int]) -> str:
        """Why a pose with this stamp cannot be inserted; empty if it can. It replaces poses with the stamps given."""
        if not self.imu:
            return 'refused: no IMU yet'
        newest_ns, due_ns = self.imu.newest_ns, self.due_ns(pose, self.main)
        if due_ns - newest_ns > self.config.max_imu_gap * SECOND_NS:
            return 'refused: far ahead of the IMU'
        oldest_ns = max(self.imu.oldest_ns, newest_ns - round(self.config.max_delay * SECOND_NS))
        if due_ns <= oldest_ns or pose.stamp_ns <= self._beliefs[0].verdict.stamp_ns:
            return 'refused: too late'
        known = {pose.stamp_ns for pose in self._poses}.difference(instead_of)
        return 'refused: stamp repeated' if pose.stamp_ns in known else ''

    def compared(self, pose: CameraPose) -> Innovation | None:
        """Innovation of a pose that is not inserted, against the estimate at its instant; None without one."""
        for belief in reversed(self._beliefs):
            time_ns = min(self.due_ns(pose, belief.main), self.imu.newest_ns)
            if belief.main and belief.main.estimate.stamp_ns <= time_ns:
                return self.innovation(belief.main, pose)
        return None

    # --- poses, and suspected steps of the clocks -----------------------------------------------------

    def insert(self, pose: CameraPose) -> None:
        """Add a pose; :meth:`take_in` applies it once the samples reach its instant."""
        insort(self._poses, pose, key=_stamp)
        self._undo_from(pose.stamp_ns)

    def discard(self, stamps_ns: Iterable[int]) -> None:
        """Remove poses by their stamps."""
        stamps = {pose.stamp_ns for pose in self._poses} & set(stamps_ns)
        self._poses = [pose for pose in self._poses if pose.stamp_ns not in stamps]
        if stamps:
            self._undo_from(min(stamps))

    def suspect_camera_step(self, stamp_ns: int, size_ns: int) -> None:
        """Allow for a step of the camera's clock by ``size_ns`` before the first kept pose from ``stamp_ns`` on.

        Without one, before a pose of that stamp.
        """
        since = bisect_left(self._poses, stamp_ns, key=_stamp)
        first_ns = self._poses[since].stamp_ns if since < len(self._poses) else stamp_ns
        self._camera_steps[first_ns] = max(size_ns, self._camera_steps.get(first_ns, 0))
        self._undo_from(first_ns)

    def suspect_steps(self, size_ns: int, *, jumped: bool) -> None:
        """Allow for steps ahead of the clocks by ``size_ns`` after the newest sample: or samples are lost there.

        One of all clocks shows at the next pose. A small one of the IMU's alone is left to the clock offset; after a
        large one, where its stamps have ``jumped``, the robot is at the end of the jump where it was at its beginning.
        """
        newest_ns = self.imu.newest_ns
        self._clock_steps.append((newest_ns, math.sqrt(STEPS) * size_ns / SECOND_NS))
        if size_ns < SMALLEST_STEP_NS:
            if self.config.estimate_time_offset:
                self._imu_steps.append((newest_ns, _STEP_OR_LOSS * size_ns / SECOND_NS))
        elif jumped and self.main:
            before = self.carried(self.main, newest_ns).estimate
            self.stepped = self.main._replace(estimate=replace(before, stamp_ns=before.stamp_ns + size_ns))

    def forget_poses(self) -> None:
        """Remove all poses and beliefs."""
        self._poses, self._beliefs, self.main, self.stepped = [], [Belief()], None, None

    def _undo_from(self, stamp_ns: int) -> None:
        """Remove the beliefs after poses of ``stamp_ns`` and later."""
        while len(self._beliefs) > 1 and self.belief.verdict.stamp_ns >= stamp_ns:
            del self._beliefs[-1]
            self.main = self.belief.main
        if not self.belief.hypotheses:
            # Another pose begins the initialisation.
            self._beliefs[-1] = self.belief._replace(first_offset=0.0)

    # --- taking in poses ------------------------------------------------------------------------------

    def take_in(self) -> None:
        """Apply all poses up to the newest sample, log the verdicts on them, and propagate to that sample."""
        while (pose := self._next_due()) is not None:
            belief = belief_after(self, pose)
            if self._relinearise(belief):
                continue
            self._beliefs.append(belief)
            self.main = belief.main
            self.log.add(belief.verdict)
        newest_ns = self.imu.newest_ns
        if self.stepped:
            self.stepped = self.carried(self.stepped, newest_ns)
        if self.main:
            self.main = self.carried(self.main, newest_ns)
        # Half of the buffer at a time: each removal moves the rest.
        if newest_ns - self.imu.oldest_ns > 2 * self._kept_ns:
            self._forget_old()

    def _next_due(self) -> CameraPose | None:
        """The next pose to apply, if the samples reach its instant."""
        belief = self.belief
        place = bisect_right(self._poses, belief.verdict.stamp_ns, key=_stamp)
        if place == len(self._poses):
            return None
        pose = self._poses[place]
        begin_ns = self.due_ns(pose, None, belief.first_offset)
        due_ns = max((self.due_ns(pose, h) for h in belief.hypotheses), default=begin_ns)
        return pose if due_ns <= self.imu.newest_ns else None

    def _relinearise(self, belief: Belief) -> bool:
        """Return to before an initialisation that ends with ``belief`` if it must begin once more; whether it must.

        A pose measures the state at the camera's stamp, to first order in the clock offset. In a brisk start with an
        offset of two standard deviations the second order is larger than the errors of the poses.
        """
        before = self.belief
        if before.main or belief.main is None or before.first_offset:
            return False
        forgotten = all(old.hypotheses for old in self._beliefs)
        if forgotten or not relinearises(belief.main, before.first_offset):
            return False
        while self.belief.hypotheses:
            del self._beliefs[-1]
        offset = belief.main.estimate.state.time_offset
        self._beliefs[-1] = self.belief._replace(first_offset=offset)
        return True

    def innovation(self, hypothesis: Hypothesis, pose: CameraPose) -> Innovation:
        """Innovation of a pose against a hypothesis at its instant; of two possible poses that of the nearer one.

        Where the estimate does not show which of the two it is, nothing is known of the turn between them.
        """
        estimate, possible = self._at_instant(hypothesis, pose), possible_poses(pose)
        motion = self.imu.motion(estimate.stamp_ns, hypothesis.accepted_ns)
        on_robot, scale = estimate.state.T_body_camera, self.config.pose_noise_scale
        bodies = [body_pose(measured, on_robot, scale) for measured in possible]
        innovations = [innovation_of(self.config, estimate, body, motion) for body in bodies]
        nearer, *farther = sorted(innovations, key=attrgetter('nis'))
        if farther and farther[0].nis - nearer.nis < DECISIVE:
            between = unknown_turn(screw_difference(possible[0].T_map_camera, pose.T_map_camera))
            unsure = body_pose(pose.widened(between), on_robot, scale)
            return innovation_of(self.config, estimate, unsure, motion)
        return nearer

    def _at_instant(self, hypothesis: Hypothesis, pose: CameraPose) -> Estimate:
        """The estimate of a hypothesis at the instant of a pose, widened by steps of the clocks that are suspected.

        Never earlier than where the hypothesis is now.
        """
        time_ns = max(self.due_ns(pose, hypothesis), hypothesis.estimate.stamp_ns)
        estimate = self.carried(hypothesis, min(time_ns, self.imu.newest_ns)).estimate
        if step_ns := self._camera_steps.get(pose.stamp_ns, 0):
            estimate = estimate.widened(_OF_CLOCK_OFFSET, step_ns / SECOND_NS)
        for begin_ns, std in self._clock_steps:
            if hypothesis.compared_ns <= begin_ns < estimate.stamp_ns:
                # Time did not pass.
                derivative = estimate.state.derivative(self.imu.at(estimate.stamp_ns))
                estimate = estimate.widened(embedded_core(derivative), std)
        return estimate

    def carried(self, hypothesis: Hypothesis, until_ns: int) -> Hypothesis:
        """A hypothesis propagated along the samples to an instant that is not later than the newest sample."""
        estimate = hypothesis.estimate
        if estimate.stamp_ns >= until_ns:
            return hypothesis
        for begin_ns, std in self._imu_steps:
            if not estimate.stamp_ns <= begin_ns < until_ns:
                continue
            if begin_ns > estimate.stamp_ns:
                estimate = propagated(estimate, self.imu.steps(estimate.stamp_ns, begin_ns), begin_ns, self.walks)
            # State and stamp of the IMU no longer belong together; the state at the camera's stamps stays the same.
            derivative = estimate.state.derivative(self.imu.at(begin_ns))
            estimate = estimate.widened(clock_offset_derivative(derivative), std)
        steps = self.imu.steps(estimate.stamp_ns, until_ns)
        return hypothesis._replace(estimate=propagated(estimate, steps, until_ns, self.walks))

    def _forget_old(self) -> None:
        """Remove what is older than any pose that may still be inserted."""
        horizon_ns = self.imu.newest_ns - self._kept_ns
        while len(self._beliefs) > 1 and self._beliefs[1].stamp_ns <= horizon_ns:
            del self._beliefs[0]
        oldest = self._beliefs[0]
        hypotheses = oldest.main, oldest.alternative, oldest.second
        main, other, second = (hypothesis and self.carried(hypothesis, horizon_ns) for hypothesis in hypotheses)
        self._beliefs[0] = oldest._replace(main=main, alternative=other, second=second)
        del self._poses[: bisect_right(self._poses, oldest.verdict.stamp_ns, key=_stamp)]
        self.imu.forget_before(horizon_ns)
        kept = {pose.stamp_ns for pose in self._poses}
        self._camera_steps = {stamp: step for stamp, step in self._camera_steps.items() if stamp in kept}
        self._imu_steps = [step for step in self._imu_steps if step[0] >= self.imu.oldest_ns]
        compared_ns = min((h.compared_ns for h in oldest.hypotheses), default=horizon_ns)
        self._clock_steps = [step for step in self._clock_steps if step[0] >= compared_ns]
