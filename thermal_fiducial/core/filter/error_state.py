"""Prediction and correction of one estimate. Covariances are filterpy's work, the state on the group is ours."""

from dataclasses import dataclass, replace
import math

from filterpy.kalman import ExtendedKalmanFilter
import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.clock_steps import ClockSteps
from thermal_fiducial.core.filter.imu import ImuStep, rotation_integrals, Transition
from thermal_fiducial.core.filter.imu_noise import NoiseRange
from thermal_fiducial.core.filter.navigation_state import (
    ACCELEROMETER_BIAS,
    GYROSCOPE_BIAS,
    inject,
    Layout,
    NavigationState,
    POSE,
    POSITION,
    ROTATION,
    VELOCITY,
)
from thermal_fiducial.core.geometry.se3 import inverse, skew, so3_log
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

#: Root of the sum of the velocity variances [m/s] from which the time offset is estimated, and by how much the rate
#: [rad/s] and the velocity [m/s] may have changed until then.
_KNOWN_VELOCITY, _UNSEEN_CHANGE = 0.2, 0.5
#: A clock may step by more than was unknown of it at first: by two frames of a camera that lost them.
_STEP = 2.0
#: A rate is averaged over so many times (its noise density / its change)^(2/3) seconds, between these [s]. The best
#: single mean has 1.3: noise misleads the time offset always to the same side, what the rate changes does not.
_AVERAGING, _SHORTEST, _LONGEST = 14.0, 0.05, 0.5
#: A swing's acceleration is so many times [1/s] its rate, half a period later; squared, the least that counts.
_SWINGING, _LEAST_TURNING = 3.0, 1e-12
#: So much more than James and Stein shrink a rate's change: its noise is in the predicted attitude too, and misleads.
_SHRINKAGE = 4.0
_NO_NOISE = NoiseRange()
_SIX = np.arange(6)


@dataclass(frozen=True, slots=True)
class BodyPose:
    """A measured pose of the robot.

    ``covariance`` (6, 6): rotation, then position, of the error in the robot frame [rad, m].
    """

    T_map_body: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Motion:
    """What the IMU shows of the motion at a pose.

    Means over a window: the noise of one sample would count as motion that shows no clock error. As it is in the
    predicted attitude too, it would even show an error that isn't there.
    """

    #: (6,) rate [rad/s] and specific force [m/s^2]
    imu: FloatArray
    #: (3,) [rad/s^2]
    angular_acceleration: FloatArray
    #: how long before the pose the middle of the window is [s]
    age: float
    #: instant of the pose in the clock of the IMU
    time_ns: int = 0
    #: of the IMU then
    noise: NoiseRange = _NO_NOISE

    @classmethod
    def of(cls, samples: FloatArray, seconds: float, time_ns: int = 0, noise: NoiseRange | None = None) -> 'Motion':
        """Motion in samples (N, 6) of so many ``seconds``, the slope of their rate by least squares."""
        count = len(samples)
        place = np.arange(count) - 0.5 * (count - 1)
        slope = place @ samples[:, :3] * (count / seconds) / max(float(place @ place), 1.0)
        return cls(samples.mean(axis=0), slope, 0.5 * seconds, time_ns, noise or _NO_NOISE)

    def averaging_seconds(self, density: float) -> float:
        """Seconds over which to average a rate with white noise of ``density`` [rad/s/sqrt(Hz)] in such a motion.

        The noise of the mean falls with the root of them, the change of the rate in them grows: the best is a constant
        times (density / angular acceleration)^(2/3).
        """
        rate = self.imu[:3]
        turning = float(self.angular_acceleration @ self.angular_acceleration) + _SWINGING**2 * float(rate @ rate)
        best = _AVERAGING * float(np.cbrt(density**2 / max(turning, _LEAST_TURNING)))
        return min(max(best, _SHORTEST), _LONGEST)

    @property
    def turned(self) -> FloatArray:
        """How much the rate (3,) at the pose differs from the mean [rad/s], shrunk as its noise asks (James, Stein)."""
        turned = self.age * self.angular_acceleration
        # The end of a fitted line has three times the variance of the mean, on three axes.
        variance = 9.0 * self.noise.shaken[0] ** 2 / (2.0 * self.age)
        square = float(turned @ turned)
        return np.asarray(max(1.0 - _SHRINKAGE * variance / max(square, _LEAST_TURNING), 0.0) * turned)


class ErrorStateFilter:
    """Prediction by inertial steps, correction by poses, of :class:`NavigationState`."""

    def __init__(self, config: PoseEkfConfig) -> None:
        self.layout = Layout.of(config)
        self.configure(config)
        self._transition = Transition(self.layout.size, _random_walks(config, self.layout))
        self._algebra = ExtendedKalmanFilter(dim_x=self.layout.size, dim_z=6)
        self._H_pose = np.zeros((6, self.layout.size))
        self._H_pose[np.arange(6), POSE] = 1.0
        if self.layout.extrinsics:
            self._H_pose[:, self.layout.extrinsics] = np.eye(6)

    def configure(self, config: PoseEkfConfig) -> None:
        """Take over the live parameters of ``config``."""
        self._config = config
        self._clock_variance = 0.0 if config.estimate_time_offset else config.time_offset_std**2

    def predict(self, state: NavigationState, step: ImuStep) -> NavigationState:
        """State after an inertial step."""
        rate = step.imu[:3]
        rotation, dv, dp = self._transition.compute(step, np.concatenate((state.rate_error(rate), state.bias[3:])))
        dt = step.seconds
        R = state.R_map_body
        R_next = R @ rotation
        F = self._transition.F
        if self.layout.gravity:
            horizontal = R_next[:2].T
            F[VELOCITY, self.layout.gravity] = horizontal * dt
            F[POSITION, self.layout.gravity] = horizontal * (0.5 * dt * dt)
        if self.layout.gyroscope_scale:
            # The error that a share of the rate makes is that of a bias as large.
            F[:9, self.layout.gyroscope_scale] = np.multiply.outer(F[:9, GYROSCOPE_BIAS], rate).reshape(9, 9)
        algebra = self._algebra
        algebra.P, algebra.F, algebra.Q = state.covariance, F, self._transition.Q
        algebra.predict()
        fall = state.gravity * dt
        return NavigationState(
            R_next,
            state.velocity + fall + R @ dv,
            state.position + (state.velocity + 0.5 * fall) * dt + R @ dp,
            state.bias,
            state.gyroscope_scale,
            state.gravity,
            state.time_offset,
            state.clock_open,
            state.T_body_camera,
            state.stamp_jitter,
            state.aliasing,
            state.clock_steps.propagated(F),
            algebra.P,
        )

    def body_pose(self, pose: CameraPose, T_body_camera: FloatArray) -> BodyPose:
        """Pose of the robot that a camera pose stands for, its covariance with the lever arm's cross terms."""
        T_map_body = pose.T_map_camera @ inverse(T_body_camera)
        R = T_map_body[:3, :3]
        lever = T_map_body[:3, 3] - pose.T_map_camera[:3, 3]
        # d p_body = d p_camera + d theta x lever, both in the map; then into the robot frame, rotation first.
        J = np.zeros((6, 6))
        J[:3, 3:] = R.T
        J[3:, :3] = R.T
        J[3:, 3:] = -R.T @ skew(lever)
        return BodyPose(T_map_body, self._config.pose_noise_scale**2 * (J @ pose.covariance @ J.T))

    def correct(
        self, state: NavigationState, pose: BodyPose, motion: Motion, late: float = 0.0
    ) -> tuple[NavigationState, float]:
        """State corrected by a pose at its own instant, and the normalised innovation squared.

        ``late`` [s] is how much later the state is than the pose.
        """
        twist = np.concatenate((motion.imu[:3] - state.rate_error(motion.imu[:3]), state.velocity_body))
        H = self._H_pose
        if state.clock_open:
            H = H.copy()
            H[:, self.layout.time_offset] = twist
        noise = pose.covariance + self._clock_noise(state, twist, motion)
        noise[_SIX, _SIX] += self._floor(twist)
        innovation = pose_innovation(state, pose.T_map_body) - _travelled(state, twist, motion, -late)
        corrected, nis = self._update(state, innovation, H, noise)
        corrected = self._learned(corrected, innovation, twist, motion)
        if state.clock_open:
            corrected.clock_steps = self._clock_steps(state.clock_steps, innovation, H, motion, nis)
        return self._open_clock(corrected, motion.imu), nis

    def _learned(
        self, state: NavigationState, innovation: FloatArray, twist: FloatArray, motion: Motion
    ) -> NavigationState:
        """``state`` after the update by ``innovation``, with what that shows of the noise."""
        weighted, weighted_twist = np.stack((innovation, twist)) @ self._algebra.SI
        scale = self._config.pose_noise_scale
        return replace(
            state,
            stamp_jitter=state.stamp_jitter.after(twist, weighted_twist, innovation),
            aliasing=state.aliasing.after(motion.time_ns, innovation, weighted, motion.noise.doubt, scale),
        )

    def _clock_steps(
        self, steps: ClockSteps, innovation: FloatArray, H: FloatArray, motion: Motion, nis: float
    ) -> ClockSteps:
        """``steps`` after the update by ``innovation``, or after none where that is refused."""
        place, algebra, gate = self.layout.time_offset, self._algebra, self._config.gate
        assert place is not None
        shown = H @ steps.responses
        # What moves a pose is the rate at its instant: the mean of half a second before may be another.
        shown[:3] += np.outer(motion.turned, steps.responses[place])
        steps = steps.seen(innovation, shown, algebra.SI, gate)
        return steps.corrected(algebra.K, shown, place) if nis <= gate else steps

    def after_clock_step(self, state: NavigationState) -> NavigationState | None:
        """``state`` if the clock has stepped, as poses show that it has; None where they don't."""
        step = state.clock_steps.found_step()
        if step is None:
            return None
        moved = inject(state, step.error, state.covariance + step.covariance, self.layout)
        return replace(moved, clock_steps=ClockSteps.none(self.layout.size, state.clock_steps.found + 1))

    def _floor(self, twist: FloatArray) -> FloatArray:
        """Variances (6,) of what the corner covariances don't know: errors that all corners share, more in motion."""
        share = self._config.motion_floor**2
        rate, speed = float(twist[:3] @ twist[:3]), float(twist[3:] @ twist[3:])
        attitude = self._config.attitude_floor**2 + share * rate
        position = self._config.position_floor**2 + share * speed
        return np.array((attitude, attitude, attitude, position, position, position))

    def _clock_noise(self, state: NavigationState, twist: FloatArray, motion: Motion) -> FloatArray:
        """What a clock error that isn't in the state, or is there to first order only, makes of a pose (6, 6).

        A clock error moves a pose along the motion: the jitter of the stamps, and the offset where it isn't estimated,
        are noise correlated over all axes. Where it is, what is uncertain of it times what is uncertain of the motion,
        and half the acceleration a times its square, of variance 3/4 a^2 s^4, are left.
        """
        noise = (self._clock_variance + state.stamp_jitter.variance) * np.outer(twist, twist)
        place = self.layout.time_offset
        if place is None:
            return noise
        if not state.clock_open:
            noise[_SIX, _SIX] += (self._config.time_offset_std * _UNSEEN_CHANGE) ** 2
            return noise
        variance = float(state.covariance[place, place])
        turning = float(motion.angular_acceleration @ motion.angular_acceleration)
        force = _acceleration(state, twist, motion)
        second = 0.75 * variance**2
        attitude, position = (second + variance * motion.age**2) * turning, second * float(force @ force)
        noise[_SIX, _SIX] += (attitude, attitude, attitude, position, position, position)
        noise[3:, 3:] += variance * state.covariance[VELOCITY, VELOCITY]
        return noise

    def _open_clock(self, state: NavigationState, imu: FloatArray) -> NavigationState:
        """Begin to estimate the time offset once the velocity is known: before, it would multiply an unknown one."""
        if state.clock_open or self.layout.time_offset is None:
            return state
        if state.covariance[VELOCITY, VELOCITY].trace() > _KNOWN_VELOCITY**2:
            return state
        return replace(state, clock_open=True, covariance=self._slid_covariance(state, imu))

    def _slid_covariance(self, state: NavigationState, imu: FloatArray) -> FloatArray:
        """Covariance with the time offset in it, of a state that has followed the clock of the camera until now.

        It is off by what moves in the meantime, fully correlated with the offset s:
        X(t + s) = X(t) Exp((rate, acceleration, velocity) s).
        """
        slide = np.zeros(self.layout.size)
        slide[ROTATION] = state.rate_error(imu[:3]) - imu[:3]
        slide[VELOCITY] = state.bias[3:] - imu[3:] - state.gravity @ state.R_map_body
        slide[POSITION] = -state.velocity_body
        slide[self.layout.time_offset] = 1.0
        return np.asarray(state.covariance + self._config.time_offset_std**2 * np.outer(slide, slide))

    def in_clock_of_imu(self, state: NavigationState, imu: FloatArray) -> NavigationState:
        """``state`` with a covariance that counts the time offset even before that is estimated."""
        if state.clock_open or self.layout.time_offset is None:
            return state
        covariance = self._slid_covariance(state, imu)
        covariance[POSITION, POSITION] += self._config.time_offset_std**2 * state.covariance[VELOCITY, VELOCITY]
        return replace(state, covariance=covariance)

    def at_offset(self, state: NavigationState, time_offset: float) -> NavigationState:
        """``state`` if the time offset were ``time_offset`` [s]: what depends on it moves along, nothing is learned."""
        place = self.layout.time_offset
        assert place is not None
        column = state.covariance[:, place]
        error = column / column[place] * (time_offset - state.time_offset)
        moved = inject(state, error, state.covariance, self.layout)
        return replace(moved, clock_steps=ClockSteps.none(self.layout.size, state.clock_steps.found))

    def with_unknown_clock(self, state: NavigationState) -> NavigationState:
        """``state`` as good as it is, whose time offset is as unknown as after a step of the clock."""
        place, covariance = self.layout.time_offset, state.covariance.copy()
        assert place is not None
        covariance[place], covariance[:, place] = 0.0, 0.0
        covariance[place, place] = (_STEP * self._config.time_offset_std) ** 2
        steps = ClockSteps.none(self.layout.size, state.clock_steps.found)
        return replace(state, covariance=covariance, clock_steps=steps)

    def time_offset_std(self, state: NavigationState) -> float:
        """Of the estimate; before it is begun, and where there is none, what the parameter says [s]."""
        place = self.layout.time_offset
        if place is None or not state.clock_open:
            return self._config.time_offset_std
        return math.sqrt(state.covariance[place, place])

    def align(self, state: NavigationState, force: FloatArray, std: float) -> tuple[NavigationState, float]:
        """State corrected by the specific force (3,) of a robot at rest, known to ``std`` [m/s^2]."""
        expected = -state.gravity @ state.R_map_body
        H = np.zeros((3, self.layout.size))
        H[:, ROTATION] = skew(expected)
        H[:, ACCELEROMETER_BIAS] = np.eye(3)
        if self.layout.gravity:
            H[:, self.layout.gravity] = -state.R_map_body[:2].T
        return self._update(state, force - state.bias[3:] - expected, H, std**2 * np.eye(3))

    def settle(self, state: NavigationState, rate: FloatArray, std: float) -> tuple[NavigationState, float]:
        """State corrected by the angular rate (3,) of a robot at rest, known to ``std`` [rad/s]."""
        H = np.zeros((3, self.layout.size))
        H[:, GYROSCOPE_BIAS] = np.eye(3)
        return self._update(state, rate - state.rate_error(rate), H, std**2 * np.eye(3))

    def _update(
        self, state: NavigationState, innovation: FloatArray, H: FloatArray, noise: FloatArray
    ) -> tuple[NavigationState, float]:
        algebra = self._algebra
        algebra.x, algebra.P = np.zeros(self.layout.size), state.covariance
        algebra.update(innovation, lambda _: H, lambda _: np.zeros(len(innovation)), R=noise)
        covariance = 0.5 * (algebra.P + algebra.P.T)
        return inject(state, algebra.x, covariance, self.layout), float(algebra.mahalanobis**2)


def doubted(state: NavigationState, other: NavigationState) -> NavigationState:
    """``state`` with a covariance that allows for ``other`` to be the truth."""
    error = np.zeros(len(state.covariance))
    innovation = pose_innovation(state, other.T_map_body)
    error[ROTATION], error[POSITION] = innovation[:3], innovation[3:]
    error[VELOCITY] = (other.velocity - state.velocity) @ state.R_map_body
    return replace(state, covariance=state.covariance + other.covariance + np.outer(error, error))


def _travelled(state: NavigationState, twist: FloatArray, motion: Motion, seconds: float) -> FloatArray:
    """Rotation and position (6,) that the robot covers in so many ``seconds``, to second order."""
    if seconds == 0.0:
        return np.zeros(6)
    turning = motion.angular_acceleration * (motion.age + 0.5 * seconds)
    return seconds * (twist + np.concatenate((turning, 0.5 * seconds * _acceleration(state, twist, motion))))


def _acceleration(state: NavigationState, twist: FloatArray, motion: Motion) -> FloatArray:
    """Change (3,) of the velocity in the robot frame [m/s^2]."""
    turned = skew(twist[:3]) @ twist[3:]
    return np.asarray(motion.imu[3:] - state.bias[3:] + state.gravity @ state.R_map_body - turned)


def pose_innovation(state: NavigationState, T_map_body: FloatArray) -> FloatArray:
    """Rotation and position (6,) of Log(X^-1 Z) on SE(3): exactly the error of ``state`` if ``T_map_body`` is true."""
    rotation = so3_log(state.R_map_body.T @ T_map_body[:3, :3])
    offset = (T_map_body[:3, 3] - state.position) @ state.R_map_body
    return np.concatenate((rotation, np.linalg.solve(rotation_integrals(rotation)[1], offset)))


def _random_walks(config: PoseEkfConfig, layout: Layout) -> FloatArray:
    walks = np.zeros(layout.size)
    walks[GYROSCOPE_BIAS] = config.imu.gyroscope_random_walk
    walks[ACCELEROMETER_BIAS] = config.imu.accelerometer_random_walk
    if layout.time_offset is not None:
        walks[layout.time_offset] = config.time_offset_random_walk
    return walks
