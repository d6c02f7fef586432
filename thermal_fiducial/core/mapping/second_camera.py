"""A second camera on the robot: its poses, as poses of the first camera, are fused with those or replace them.

The filter has one camera, and models errors that its poses have in common from frame to frame as that camera's. Poses
of two cameras in turn would violate this. So both are fused to one pose per frame of the first, by covariance
intersection, which is consistent for any correlation (S. Julier, J. Uhlmann, "A non-divergent estimation algorithm in
the presence of unknown correlations", ACC 1997). Without a known marker in the first, the second's pose is published.
"""

from dataclasses import replace

import numpy as np

from thermal_fiducial.config import CHI2_OF_POSE
from thermal_fiducial.core.camera_frames import FramePeriod
from thermal_fiducial.core.error_model import CORRELATED_POSES, covariance_of_one_error
from thermal_fiducial.core.geometry.se3 import difference, inverse, lever_arm, retract
from thermal_fiducial.core.mapping.located import squared_distance
from thermal_fiducial.core.measurements import CameraPose, MOST_LATE_NS
from thermal_fiducial.core.motion_prior import MotionPrior, predicted_camera, PredictedCamera
from thermal_fiducial.core.types import FloatArray, SECOND_NS

#: A pose of the second camera is carried on to a frame of the first over at most this [ns]: two periods at 30 Hz. With
#: a slower first camera over a period of that: then each of its frames has one of the second to be fused with. The
#: longest is beyond the slowest cameras, of 7.5 Hz; a jerk of 10 m/s^3 displaces by 1.4 mm meanwhile.
_CARRIED_NS, _LONGEST_NS = 70_000_000, 150_000_000
#: The second camera stands in when the first has had no pose for a period and this long [ns]: what transport, its
#: detector and the difference of the clocks delay it by.
_LATE_NS = 87_000_000
#: Factor on its variance by poses that contradict each other: a clock may have stepped.
_DOUBT = 2.0
# Ratio of determinants below which one pose is better than both together: two that are as good are averaged.
_CLEARLY = 0.999


class SecondClock:
    """A scalar Kalman filter: t_first = t_second + ``seconds``.

    Parameters
    ----------
    std : standard deviation of the difference before any pose [s]; 0: the clocks are one
    random_walk : of the difference [s/sqrt(s)]: that of a camera's clock against the IMU's
    """

    def __init__(self, std: float, random_walk: float) -> None:
        self.seconds, self._random_walk = 0.0, random_walk
        self.variance = self._prior = std**2
        self._stamp_ns: int | None = None

    def add(self, stamp_ns: int, apart: FloatArray, velocity: FloatArray, covariance: FloatArray) -> None:
        """Update with both cameras' poses of one instant.

        Parameters
        ----------
        apart : (6,) difference, second less first, with the present ``seconds``
        velocity : (6,) of the camera in the map [m/s, rad/s]
        covariance : (6, 6) of ``apart`` by both poses; their errors last as long as the view
        """
        if self._stamp_ns is not None:
            walked = self._random_walk**2 * abs(stamp_ns - self._stamp_ns) / SECOND_NS
            self.variance = min(self.variance + walked, self._prior)
        self._stamp_ns = stamp_ns
        weighted = np.linalg.solve(CORRELATED_POSES * covariance, velocity)
        information = float(velocity @ weighted)
        gain = self.variance / (1.0 + self.variance * information)
        self.seconds += gain * float(weighted @ apart)
        self.variance = gain

    def doubt(self) -> None:
        """Widen the variance, as poses contradict each other."""
        self.variance = min(_DOUBT * self.variance, self._prior)


class SecondCamera:
    """Takes poses of both cameras in the order of their arrival.

    Parameters
    ----------
    T_body_first, T_body_second : (4, 4) the cameras on the robot
    mount_covariance : (6, 6) of each of these places, see :func:`covariance_of_mount`
    time_offset_std, time_offset_random_walk : of the difference of their clocks, see :class:`SecondClock`
    """

    def __init__(
        self,
        T_body_first: FloatArray,
        T_body_second: FloatArray,
        mount_covariance: FloatArray,
        time_offset_std: float,
        time_offset_random_walk: float,
    ) -> None:
        self._T_body_first = T_body_first
        self._T_second_first = inverse(T_body_second) @ T_body_first
        self._mount_covariance = mount_covariance
        self._waiting: CameraPose | None = None
        #: stamps of the cameras' last poses, and period of the first one's
        self._first_ns: int | None = None
        self._second_ns = 0
        self._period = FramePeriod()
        self.clock = SecondClock(time_offset_std, time_offset_random_walk)
        #: number of fused frames, of the second's poses published alone, and of those that contradicted the first
        self.joined = self.alone = self.contradicted = 0

    def add_second(self, pose: CameraPose, prior: MotionPrior) -> CameraPose | None:
        """Add a pose of the second camera; returned as a pose of the first, in its clock, while that has none."""
        pose = self._of_first(pose)
        if pose.stamp_ns < self._second_ns - MOST_LATE_NS:
            # The clock was set back: the first one's last pose says nothing of now.
            self._first_ns = None
        self._second_ns = pose.stamp_ns
        if self._first_ns is None or pose.stamp_ns - self._first_ns > self._period_ns + _LATE_NS:
            self.alone += 1
            in_clock = self._in_clock_of_first(pose, pose.stamp_ns, prior)
            return pose if in_clock is None else in_clock[0]
        self._waiting = pose
        return None

    def _of_first(self, pose: CameraPose) -> CameraPose:
        """A pose of the second camera as one of the first: the errors of both mounts are between the two."""
        of_first = seen_from(pose.widened(self._mount_covariance), self._T_second_first)
        return of_first.widened(self._mount_covariance)

    def forget(self) -> None:
        """Drop the pose that waits for one of the first camera: it is in a map that was replaced."""
        self._waiting = None

    def with_second(self, pose: CameraPose, prior: MotionPrior) -> CameraPose:
        """A pose of the first camera fused with the latest of the second, extrapolated by odometry."""
        waiting, self._waiting = self._waiting, None
        self._first_ns = pose.stamp_ns
        self._period.add(pose.stamp_ns)
        if waiting is None or abs(pose.stamp_ns - waiting.stamp_ns) > max(_CARRIED_NS, self._period_ns):
            return pose
        in_clock = self._in_clock_of_first(waiting, pose.stamp_ns, prior)
        if in_clock is None:
            return pose
        there, moved, velocity = in_clock
        joint = intersection(pose, there)
        if joint is None:
            self.contradicted += 1
            self.clock.doubt()
            return pose
        self.joined += 1
        apart = difference(there.T_map_camera, pose.T_map_camera)
        self.clock.add(pose.stamp_ns, apart, velocity, pose.covariance + moved.covariance)
        return joint

    @property
    def _period_ns(self) -> int:
        return min(self._period.ns, _LONGEST_NS)

    def _in_clock_of_first(
        self, pose: CameraPose, stamp_ns: int, prior: MotionPrior
    ) -> tuple[CameraPose, CameraPose, FloatArray] | None:
        """A pose of the second camera at ``stamp_ns`` of the first one's clock, and the velocity (6,) there.

        First with the error of the clock in its covariance, then without it.
        """
        instant_ns = pose.stamp_ns + round(self.clock.seconds * SECOND_NS)
        middle_ns = (instant_ns + stamp_ns) // 2
        # No offset of the clocks widens this: it moves both ends alike.
        middle = predicted_camera(prior, middle_ns, self._T_body_first, 0.0)
        moved = moved_by_odometry(replace(pose, stamp_ns=instant_ns), stamp_ns, middle)
        if moved is None:
            return None
        velocity = np.zeros(6) if middle is None else middle.velocity
        of_clock = covariance_of_one_error(velocity, np.sqrt(self.clock.variance))
        return moved.widened(of_clock), moved, velocity


def seen_from(pose: CameraPose, T_camera_other: FloatArray) -> CameraPose:
    """The pose of something fixed at ``T_camera_other`` (4, 4) on the camera."""
    T_map_other = pose.T_map_camera @ T_camera_other
    J = lever_arm(T_map_other[:3, 3] - pose.T_map_camera[:3, 3])
    return replace(
        pose,
        T_map_camera=T_map_other,
        covariance=J @ pose.covariance @ J.T,
        map_covariance=J @ pose.map_covariance @ J.T,
    )


def intersection(first: CameraPose, second: CameraPose) -> CameraPose | None:
    """Both poses of one instant as one, each with half its information; None where they contradict each other.

    Half of each bounds the covariance for any correlation of their errors (S. Julier, J. Uhlmann, "A non-divergent
    estimation algorithm in the presence of unknown correlations", 1997), that of the map's errors in them, too. Where
    one of them is better alone, it is that one.
    """
    if squared_distance(first, second) > CHI2_OF_POSE:
        return None
    apart = difference(second.T_map_camera, first.T_map_camera)
    informations = [0.5 * np.linalg.inv(pose.covariance) for pose in (first, second)]
    covariance = np.linalg.inv(informations[0] + informations[1])
    better = min((first, second), key=lambda pose: float(np.linalg.det(pose.covariance)))
    if np.linalg.det(better.covariance) < _CLEARLY * np.linalg.det(covariance):
        return replace(
            first,
            T_map_camera=better.T_map_camera,
            covariance=better.covariance,
            map_covariance=better.map_covariance,
        )
    gains = [covariance @ information for information in informations]
    bounds = [2.0 * G @ pose.map_covariance @ G.T for G, pose in zip(gains, (first, second), strict=True)]
    return replace(
        first,
        T_map_camera=retract(first.T_map_camera, gains[1] @ apart),
        covariance=0.5 * (covariance + covariance.T),
        map_covariance=bounds[0] + bounds[1],
    )


def moved_by_odometry(pose: CameraPose, stamp_ns: int, middle: PredictedCamera | None) -> CameraPose | None:
    """``pose`` at another stamp, moved by the velocity of the odometry in the ``middle``; None where there is none.

    By one state of the odometry: between two states the filter may have corrected its pose, which is no motion.
    """
    if stamp_ns == pose.stamp_ns:
        return pose
    if middle is None:
        return None
    seconds = (stamp_ns - pose.stamp_ns) / SECOND_NS
    there = retract(pose.T_map_camera, seconds * middle.velocity)
    covariance = pose.covariance + middle.velocity_covariance(seconds)
    return replace(pose, stamp_ns=stamp_ns, T_map_camera=there, covariance=covariance)
