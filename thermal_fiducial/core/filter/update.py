"""Correction of an estimate by a camera pose. The covariance algebra is filterpy's, the state on the group ours."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.kalman import ExtendedKalmanFilter
from thermal_fiducial.core.filter.pose_noise import BodyPose, PoseNoise
from thermal_fiducial.core.filter.state import (
    CORE,
    Estimate,
    EXTRINSICS,
    NavigationState,
    POSE,
    POSITION,
    ROTATION,
    SIZE,
    SYSTEMATIC,
    TIME_OFFSET,
    VELOCITY,
)
from thermal_fiducial.core.geometry.reprojection import lever_arm
from thermal_fiducial.core.geometry.se3 import inverse, skew, so3_left_jacobian_inverse, so3_log
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

#: The noise of the measured motion at a pose feigns information about the clock offset, 1 to 2 times its squared size
#: in units of the innovation, growing with the gain. Taking it away at most doubles the offset's variance in one step.
_FEIGNED, _LEAST_KEPT = 1.5, 0.5
_SIX = np.arange(6)


class Innovation(NamedTuple):
    """Innovation ``value`` (6,), inverse of its covariance S (6, 6), Jacobian H (6, 48), measurement noise R (6, 6)."""

    value: FloatArray
    S_inverse: FloatArray
    H: FloatArray
    R: FloatArray
    nis: float
    #: the estimate before the update, its systematic error already propagated to the view of this pose
    prior: Estimate
    #: time derivative (9,) of the prior's core error coordinates, as of :func:`core_derivative`
    core_derivative: FloatArray
    #: derivative (6, 3) of the pose by the camera's rotation against the robot, as of :func:`by_mount`
    by_mount: FloatArray


@dataclass(frozen=True, slots=True)
class MotionAtPose:
    """What the IMU shows of the motion at a pose's instant.

    Attributes
    ----------
    imu : (6,) mean of equally many samples before and after it: a one-sided mean would bias the clock offset
    rate_variance : white noise of one axis of the mean rate [rad^2/s^2]
    velocity_variance : what accelerometer noise has added to the velocity since the last accepted pose [m^2/s^2]
    turning : magnitude of the angular acceleration [rad/s^2]
    """

    imu: FloatArray
    rate_variance: float
    velocity_variance: float
    turning: float


def core_derivative(state: NavigationState, imu: FloatArray) -> FloatArray:
    """Time derivative (9,) of the core state for an IMU sample ``imu`` (6,): X(t + s) = X(t) Exp(derivative s)."""
    derivative, velocity = np.empty(9), state.velocity_body
    derivative[:6] = state.corrected(imu)
    derivative[VELOCITY] += state.gravity @ state.R_map_body - skew(derivative[ROTATION]) @ velocity
    derivative[POSITION] = velocity
    return derivative


def of_clock(derivative: FloatArray) -> FloatArray:
    """(48,) error by 1 s of clock offset with which the state at the camera's stamps is right.

    ``derivative`` (9,): of :func:`core_derivative`.
    """
    error = _of_core(-derivative)
    error[TIME_OFFSET] = 1.0
    return error


def with_clock_step(estimate: Estimate, imu: FloatArray, std: float) -> Estimate:
    """The estimate after an unknown step of the IMU's clock.

    The clock offset changes, and state and stamp of the IMU no longer belong together. Poses do not show it at once, as
    the state at their stamps stays the same.

    Parameters
    ----------
    imu : (6,) the sample before it
    std : standard deviation of the step [s]
    """
    error = of_clock(core_derivative(estimate.state, imu))
    return replace(estimate, covariance=estimate.covariance + std**2 * np.outer(error, error))


def with_camera_step(estimate: Estimate, std: float) -> Estimate:
    """The estimate after an unknown step of the camera's clock, of standard deviation ``std`` [s]."""
    covariance = estimate.covariance.copy()
    covariance[TIME_OFFSET, TIME_OFFSET] += std**2
    return replace(estimate, covariance=covariance)


def body_pose(pose: CameraPose, T_body_camera: FloatArray, scale: float) -> BodyPose:
    """Pose of the robot by a camera pose whose standard deviations are multiplied by ``scale``."""
    T_map_body = pose.T_map_camera @ inverse(T_body_camera)
    R = T_map_body[:3, :3]
    lever = T_map_body[:3, 3] - pose.T_map_camera[:3, 3]
    # d p_body = d p_camera + d theta x lever, both in the map; then into the robot frame, rotation first.
    J = np.zeros((6, 6))
    J[:3, 3:] = J[3:, :3] = R.T
    J[3:, 3:] = -R.T @ skew(lever)
    relative = scale**2 * (J @ (pose.covariance - pose.map_covariance) @ J.T)
    to_body = lever_arm(lever)
    return BodyPose(pose.stamp_ns, T_map_body, relative, to_body @ pose.map_covariance @ to_body.T)


def pose_innovation(state: NavigationState, T_map_body: FloatArray) -> FloatArray:
    """(6,) Log(X^-1 Z) on SE(3), rotation first: the left-invariant error of ``state`` if ``T_map_body`` is true."""
    rotation = so3_log(state.R_map_body.T @ T_map_body[:3, :3])
    offset = (T_map_body[:3, 3] - state.position) @ state.R_map_body
    return np.concatenate((rotation, so3_left_jacobian_inverse(rotation) @ offset))


def by_mount(state: NavigationState) -> FloatArray:
    """(6, 3) derivative of a measured pose by a rotation of the camera against the robot, about the camera [rad]."""
    return np.vstack((np.eye(3), skew(state.T_body_camera[:3, 3])))


class PoseUpdater:
    """Innovations of poses, and the corrections by them."""

    def __init__(self, config: PoseEkfConfig) -> None:
        self.config = config
        self._algebra = ExtendedKalmanFilter(dim_x=SIZE, dim_z=6)

    def innovation(self, estimate: Estimate, pose: BodyPose, motion: MotionAtPose) -> Innovation:
        """Innovation of ``pose`` against ``estimate`` at the same instant."""
        noise = estimate.pose_noise
        alike = noise.alike(pose, self.config.systematic_angle)
        systematic = self.config.systematic_pose_std**2 * pose.shape
        prior = _with_new_view(estimate, alike, (1.0 - alike**2) * systematic + pose.map_change(noise.last))
        H = np.zeros((6, SIZE))
        H[_SIX, POSE] = 1.0
        H[:, EXTRINSICS] = H[:, SYSTEMATIC] = np.eye(6)
        turning = by_mount(prior.state)
        R = prior.pose_noise.white * pose.shape + prior.pose_noise.vibration.value * (turning @ turning.T)
        derivative = core_derivative(prior.state, motion.imu)
        self._add_clock(prior, motion, derivative, H, R)
        value = pose_innovation(prior.state, pose.T_map_body) - prior.state.systematic
        S_inverse = np.asarray(np.linalg.inv(H @ prior.covariance @ H.T + R))
        return Innovation(value, S_inverse, H, R, float(value @ S_inverse @ value), prior, derivative, turning)

    def _add_clock(
        self, prior: Estimate, motion: MotionAtPose, derivative: FloatArray, H: FloatArray, R: FloatArray
    ) -> None:
        """Add errors of the camera's clock to H and R: stamp jitter, and the clock offset, estimated or not."""
        config = self.config
        twist, acceleration = derivative[POSE], derivative[VELOCITY]
        unknown = prior.pose_noise.jitter.value + (0.0 if config.estimate_time_offset else config.time_offset_std**2)
        R += unknown * np.outer(twist, twist)
        if not config.estimate_time_offset:
            return
        P = prior.covariance
        velocity, variance = P[VELOCITY, VELOCITY], float(P[TIME_OFFSET, TIME_OFFSET])
        H[:, TIME_OFFSET] = twist
        # Second order: offset times the error of rate and velocity, and half the acceleration times the offset squared.
        square = 0.75 * variance**2
        R[_SIX[:3], _SIX[:3]] += variance * motion.rate_variance + square * motion.turning**2
        R[_SIX[3:], _SIX[3:]] += square * float(acceleration @ acceleration)
        R[3:, 3:] += variance * velocity + np.outer(P[VELOCITY, TIME_OFFSET], P[VELOCITY, TIME_OFFSET])

    def correct(self, pose: BodyPose, innovation: Innovation, motion: MotionAtPose) -> Estimate:
        """The estimate after an accepted pose."""
        prior = innovation.prior
        error, covariance = self._gained(pose, innovation)
        state, before = prior.state.plus(error), innovation.core_derivative
        if self.config.estimate_time_offset:
            now = core_derivative(state, motion.imu)
            state = state.plus(_of_core((before - now) * error[TIME_OFFSET]))
            covariance = self._in_clock_of_imu(covariance, now - before, now, innovation, motion)
        noise = prior.pose_noise.with_stamps(before[POSE], innovation.value, innovation.S_inverse)
        noise = self.adapted(noise, pose, innovation)
        return replace(prior, state=state, covariance=covariance, pose_noise=replace(noise, last=pose))

    def adapted(self, noise: PoseNoise, pose: BodyPose, innovation: Innovation) -> PoseNoise:
        """``noise`` adapted to the innovation of an accepted or refused pose."""
        value, S_inverse = innovation.value, innovation.S_inverse
        noise = noise.with_vibration(innovation.by_mount, value, S_inverse)
        return noise.weighed(pose, value, S_inverse)

    def _in_clock_of_imu(
        self, P: FloatArray, change: FloatArray, derivative: FloatArray, innovation: Innovation, motion: MotionAtPose
    ) -> FloatArray:
        """The covariance after an update that changed the core's derivative by ``change`` (9,) to ``derivative`` (9,).

        A pose measures the state at the camera's stamp, X(t) Exp(derivative s). The error of that state does not depend
        on the linearisation point of the derivative, so the error of X(t) is shifted with it; otherwise each correction
        of the velocity would feign information about the offset s. (G. Huang, A. Mourikis, S. Roumeliotis,
        "Observability-based Rules for Designing Consistent EKF SLAM Estimators", IJRR 2010, keep other unobservable
        directions in the same way.)

        Noise of the derivative feigns information too (errors in variables): the offset's variance is widened by its
        worth.
        """
        with_offset = P[TIME_OFFSET]
        variance = float(with_offset[TIME_OFFSET])
        followed = _of_core(-change)
        half = np.outer(followed, with_offset + 0.5 * variance * followed)
        noise = np.repeat((motion.rate_variance, motion.velocity_variance), 3)
        feigned = _FEIGNED * float(innovation.S_inverse.diagonal() @ noise)
        widest = max(variance, self.config.time_offset_std**2)
        consistent = min(variance / max(1.0 - variance * feigned, _LEAST_KEPT), widest)
        by_offset = of_clock(derivative)
        return P + half + half.T + (consistent - variance) * np.outer(by_offset, by_offset)

    def _gained(self, pose: BodyPose, innovation: Innovation) -> tuple[FloatArray, FloatArray]:
        """Kalman update: the corrected error (48,) and the covariance (48, 48)."""
        algebra, P = self._algebra, innovation.prior.covariance
        algebra.x, algebra.P = np.zeros(SIZE), P
        algebra.update(innovation.value, lambda _: innovation.H, lambda _: np.zeros(6), R=innovation.R)
        gain, covariance = algebra.K, 0.5 * (algebra.P + algebra.P.T)
        if not self.config.estimate_extrinsics:
            # A consider parameter (S. Schmidt, 1966): its cross-covariances change, itself it does not.
            gain[EXTRINSICS] = 0.0
            covariance[EXTRINSICS, EXTRINSICS] = P[EXTRINSICS, EXTRINSICS]
        return _iterated(pose, innovation, gain), covariance

    def with_unknown_clock(self, estimate: Estimate) -> Estimate:
        """The estimate with a clock offset as uncertain as after a step of the camera's clock; all else stays."""
        covariance = estimate.covariance.copy()
        covariance[TIME_OFFSET], covariance[:, TIME_OFFSET] = 0.0, 0.0
        covariance[TIME_OFFSET, TIME_OFFSET] = (2.0 * self.config.time_offset_std) ** 2
        return replace(estimate, covariance=covariance)


def _with_new_view(estimate: Estimate, alike: float, added: FloatArray) -> Estimate:
    """The estimate with its systematic error propagated to a new view: first-order Markov.

    Parameters
    ----------
    alike : correlation of the errors in both views
    added : covariance (6, 6) of what is new
    """
    P = estimate.covariance.copy()
    P[SYSTEMATIC] *= alike
    P[:, SYSTEMATIC] *= alike
    P[SYSTEMATIC, SYSTEMATIC] += added
    state = replace(estimate.state, systematic=alike * estimate.state.systematic)
    return replace(estimate, state=state, covariance=P)


def _iterated(pose: BodyPose, innovation: Innovation, gain: FloatArray) -> FloatArray:
    """The corrected error (48,) by ``gain`` (48, 6), after a second Gauss-Newton step from the same prior.

    After seconds without poses the position may be off by metres. Rotation times position, the second order of the
    first step, is then larger than what the pose claims. (B. Bell, F. Cathey, "The iterated Kalman filter update as a
    Gauss-Newton method", IEEE TAC 1993.)
    """
    error = gain @ innovation.value
    state = innovation.prior.state.plus(error)
    left = pose_innovation(state, pose.T_map_body) - state.systematic
    return np.asarray(gain @ (left + error[POSE] + error[SYSTEMATIC]))


def _of_core(error: FloatArray) -> FloatArray:
    """Error coordinates (48,) with the given core (9,), zero elsewhere."""
    whole = np.zeros(SIZE)
    whole[CORE] = error
    return whole
