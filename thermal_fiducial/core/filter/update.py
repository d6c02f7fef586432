"""Correction of an estimate by a camera pose. The covariance algebra is filterpy's, the state on the group ours."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.kalman import ExtendedKalmanFilter
from thermal_fiducial.core.filter.pose_noise import BodyPose
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
from thermal_fiducial.core.geometry.se3 import inverse, skew, so3_left_jacobian_inverse, so3_log
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray

#: Noise of the motion at a pose feigns information about the clock offset: once to twice what its square is worth, the
#: more the larger the gain is, since differences of the motion from pose to pose count. One pose takes at most half of
#: what is known.
_FEIGNED, _LEAST_KEPT = 1.5, 0.5
_SIX = np.arange(6)


class Innovation(NamedTuple):
    """Difference (6,) of a pose and the prediction, inverse of its covariance S, Jacobian H (6, 48), noise R (6, 6)."""

    value: FloatArray
    S_inverse: FloatArray
    H: FloatArray
    R: FloatArray
    nis: float
    #: the estimate that it was compared with, its systematic error as old as the pose's
    prior: Estimate
    #: change (9,) of that estimate's core with time
    slide: FloatArray


@dataclass(frozen=True, slots=True)
class MotionAtPose:
    """What the IMU shows of the motion at a pose's instant.

    ``imu`` (6,): mean of as many samples before it as after it, so that its noise is as often in the innovations of
    poses with one sign as with the other, and moves the clock offset to neither side; ``rate_variance`` [rad^2/s^2] of
    one axis of it; ``velocity_variance`` [m^2/s^2]: what the noise of the accelerometer has added to the velocity since
    the pose before; ``turning`` [rad/s^2]: size of the angular acceleration.
    """

    imu: FloatArray
    rate_variance: float
    velocity_variance: float
    turning: float


def slide(state: NavigationState, imu: FloatArray) -> FloatArray:
    """Change (9,) of the core with time: X(t + s) = X(t) Exp(slide s), as a sample ``imu`` (6,) shows it."""
    moved, velocity = np.empty(9), state.velocity_body
    moved[:6] = state.corrected(imu)
    moved[VELOCITY] += state.gravity @ state.R_map_body - skew(moved[ROTATION]) @ velocity
    moved[POSITION] = velocity
    return moved


def body_pose(pose: CameraPose, T_body_camera: FloatArray, scale: float) -> BodyPose:
    """Pose of the robot that a camera pose stands for; ``scale`` on its standard deviation."""
    T_map_body = pose.T_map_camera @ inverse(T_body_camera)
    R = T_map_body[:3, :3]
    lever = T_map_body[:3, 3] - pose.T_map_camera[:3, 3]
    # d p_body = d p_camera + d theta x lever, both in the map; then into the robot frame, rotation first.
    J = np.zeros((6, 6))
    J[:3, 3:] = J[3:, :3] = R.T
    J[3:, 3:] = -R.T @ skew(lever)
    relative = scale**2 * (J @ (pose.covariance - pose.map_covariance) @ J.T)
    to_body = np.eye(6)
    to_body[:3, 3:] = -skew(lever)
    return BodyPose(pose.stamp_ns, T_map_body, relative, to_body @ pose.map_covariance @ to_body.T)


def pose_innovation(state: NavigationState, T_map_body: FloatArray) -> FloatArray:
    """Rotation and position (6,) of Log(X^-1 Z) on SE(3): exactly the error of ``state`` if ``T_map_body`` is true."""
    rotation = so3_log(state.R_map_body.T @ T_map_body[:3, :3])
    offset = (T_map_body[:3, 3] - state.position) @ state.R_map_body
    return np.concatenate((rotation, so3_left_jacobian_inverse(rotation) @ offset))


class PoseUpdater:
    """Compares estimates with poses, and corrects them."""

    def __init__(self, config: PoseEkfConfig) -> None:
        self.config = config
        self._algebra = ExtendedKalmanFilter(dim_x=SIZE, dim_z=6)

    def innovation(self, estimate: Estimate, pose: BodyPose, motion: MotionAtPose) -> Innovation:
        """What ``pose`` says beyond ``estimate`` at its instant."""
        alike = estimate.pose_noise.alike(pose, self.config.systematic_angle)
        # The systematic error in the axes of the pose's own: those of the triangular root of its covariance.
        root = self.config.systematic_pose_std * np.linalg.cholesky(pose.shape)
        prior = _with_new_view(estimate, alike)
        to_units = np.linalg.inv(root)
        change = pose.map_change(estimate.pose_noise.last)
        prior.covariance[SYSTEMATIC, SYSTEMATIC] += to_units @ change @ to_units.T
        H = np.zeros((6, SIZE))
        H[_SIX, POSE] = 1.0
        H[:, EXTRINSICS] = np.eye(6)
        H[:, SYSTEMATIC] = root
        R = prior.pose_noise.white * pose.shape
        moved = slide(prior.state, motion.imu)
        self._add_clock(prior, motion, moved, H, R)
        value = pose_innovation(prior.state, pose.T_map_body) - root @ prior.state.systematic
        S_inverse = np.asarray(np.linalg.inv(H @ prior.covariance @ H.T + R))
        return Innovation(value, S_inverse, H, R, float(value @ S_inverse @ value), prior, moved)

    def _add_clock(
        self, prior: Estimate, motion: MotionAtPose, moved: FloatArray, H: FloatArray, R: FloatArray
    ) -> None:
        """What errors of the camera's clock do to a pose: jitter and, where it isn't estimated, the offset."""
        config = self.config
        twist, acceleration = moved[POSE], moved[VELOCITY]
        unknown = prior.pose_noise.jitter + (0.0 if config.estimate_time_offset else config.time_offset_std**2)
        R += unknown * np.outer(twist, twist)
        if not config.estimate_time_offset:
            return
        P = prior.covariance
        velocity, variance = P[VELOCITY, VELOCITY], float(P[TIME_OFFSET, TIME_OFFSET])
        H[:, TIME_OFFSET] = twist
        # Second order: offset times what is uncertain of the motion, and half the acceleration times its square.
        square = 0.75 * variance**2
        R[_SIX[:3], _SIX[:3]] += variance * motion.rate_variance + square * motion.turning**2
        R[_SIX[3:], _SIX[3:]] += square * float(acceleration @ acceleration)
        R[3:, 3:] += variance * velocity + np.outer(P[VELOCITY, TIME_OFFSET], P[VELOCITY, TIME_OFFSET])

    def correct(self, pose: BodyPose, innovation: Innovation, motion: MotionAtPose) -> Estimate:
        """The estimate after an accepted pose."""
        prior = innovation.prior
        error, covariance = self._gained(prior.covariance, innovation.value, innovation.H, innovation.R)
        state, before = prior.state.plus(error), innovation.slide
        if self.config.estimate_time_offset:
            now = slide(state, motion.imu)
            state = state.plus(_of_core((before - now) * error[TIME_OFFSET]))
            covariance = self._in_clock_of_imu(covariance, now - before, now, innovation, motion)
        noise = prior.pose_noise.with_stamps(before[POSE], innovation.value, innovation.S_inverse)
        noise = noise.weighed(pose, innovation.value, innovation.S_inverse)
        return replace(prior, state=state, covariance=covariance, pose_noise=replace(noise, last=pose))

    def _in_clock_of_imu(
        self, P: FloatArray, change: FloatArray, moved: FloatArray, innovation: Innovation, motion: MotionAtPose
    ) -> FloatArray:
        """The covariance after a pose that has changed by ``change`` (9,) what is known of the motion, now ``moved``.

        A pose is of the state at the stamp of the camera, X(t) Exp(slide s). That state's error has nothing to do with
        how well the slide is known, so the error of X(t) follows the slide; else each correction of the velocity would
        feign information about the offset s. (G. Huang, A. Mourikis, S. Roumeliotis, "Observability-based Rules for
        Designing Consistent EKF SLAM Estimators", IJRR 2010, have the like of other unobservable directions.)

        The square of the slide's noise feigns information too (errors in variables): what it is worth is taken away.
        """
        with_offset = P[TIME_OFFSET]
        variance = float(with_offset[TIME_OFFSET])
        followed = _of_core(-change)
        half = np.outer(followed, with_offset + 0.5 * variance * followed)
        noise = np.repeat((motion.rate_variance, motion.velocity_variance), 3)
        feigned = _FEIGNED * float(innovation.S_inverse.diagonal() @ noise)
        widest = max(variance, self.config.time_offset_std**2)
        consistent = min(variance / max(1.0 - variance * feigned, _LEAST_KEPT), widest)
        slid = _of_core(-moved)
        slid[TIME_OFFSET] = 1.0
        return P + half + half.T + (consistent - variance) * np.outer(slid, slid)

    def _gained(
        self, P: FloatArray, innovation: FloatArray, H: FloatArray, R: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Error (48,) that an innovation shows, and the covariance after it."""
        algebra = self._algebra
        algebra.x, algebra.P = np.zeros(SIZE), P
        algebra.update(innovation, lambda _: H, lambda _: np.zeros(len(innovation)), R=R)
        return algebra.x, 0.5 * (algebra.P + algebra.P.T)

    def with_unknown_clock(self, estimate: Estimate) -> Estimate:
        """The estimate as good as it is, its clock offset as unknown as after a step of the camera's clock."""
        covariance = estimate.covariance.copy()
        covariance[TIME_OFFSET], covariance[:, TIME_OFFSET] = 0.0, 0.0
        covariance[TIME_OFFSET, TIME_OFFSET] = (2.0 * self.config.time_offset_std) ** 2
        return replace(estimate, covariance=covariance)


def _with_new_view(estimate: Estimate, alike: float) -> Estimate:
    """The estimate whose systematic error is that of another view, correlated with the one before by ``alike``."""
    P = estimate.covariance.copy()
    P[SYSTEMATIC] *= alike
    P[:, SYSTEMATIC] *= alike
    P[SYSTEMATIC, SYSTEMATIC].flat[::7] += 1.0 - alike * alike
    state = replace(estimate.state, systematic=alike * estimate.state.systematic)
    return replace(estimate, state=state, covariance=P)


def _of_core(error: FloatArray) -> FloatArray:
    """An error (48,) of the core (9,) alone."""
    whole = np.zeros(SIZE)
    whole[CORE] = error
    return whole
