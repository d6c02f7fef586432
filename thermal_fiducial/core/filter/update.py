"""Correction of an estimate by a camera pose. The covariance algebra is filterpy's, the state on the group ours."""

from copy import copy
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import PoseEkfConfig
from thermal_fiducial.core.filter.evidence import ClockEvidence
from thermal_fiducial.core.filter.imu_buffer import MotionAtPose
from thermal_fiducial.core.filter.kalman import ExtendedKalmanFilter
from thermal_fiducial.core.filter.pose_noise import BodyPose, displacement_of_body, PoseNoise, share_that_stays
from thermal_fiducial.core.filter.state import (
    CORE,
    embedded_core,
    Estimate,
    EXTRINSICS,
    GRAVITY,
    MARKERS,
    NavigationState,
    POSE,
    POSITION,
    ROTATION,
    SIZE,
    SYSTEMATIC,
    TIME_OFFSET,
    VELOCITY,
)
from thermal_fiducial.core.geometry.se3 import inverse, lever_arm, skew, so3_left_jacobian, so3_log
from thermal_fiducial.core.measurements import CameraPose
from thermal_fiducial.core.types import FloatArray, TINY

#: Share of ``lost_position_std`` that an estimate may give up to go on in the map of worse markers. Up to 0.2 random
#: rigs are alike, with 0.35 one of them is lost. Were it to give up nothing, the IMU would decide between maps that
#: hardly differ.
_LITTLE = 0.1
_SIX = np.arange(6)
#: Copied for every update, as an update leaves its results in the object.
_ALGEBRA = ExtendedKalmanFilter(dim_x=SIZE, dim_z=6)


class Innovation(NamedTuple):
    """A pose compared with an estimate of its instant."""

    estimate: Estimate
    pose: BodyPose
    motion: MotionAtPose
    #: the estimate, its systematic error propagated to the view of this pose
    prior: Estimate
    #: time derivative (9,) of the prior's core error coordinates
    derivative: FloatArray
    #: (3, 6, 6) covariances of the innovation by white errors of variance 1, in the order of :class:`PoseNoise`
    units: FloatArray
    #: (6,) the innovation, its covariance S (6, 6) and the inverse, Jacobian H (6, 55), measurement noise R (6, 6)
    value: FloatArray
    S: FloatArray
    S_inverse: FloatArray
    H: FloatArray
    R: FloatArray
    #: (55, 6) errors of the prior by a standard deviation of each of the extrinsics; S (6, 6) if these were exact
    of_extrinsics: FloatArray
    S_exact: FloatArray

    @property
    def nis(self) -> float:
        """Normalised innovation squared."""
        return float(self.value @ self.S_inverse @ self.value)


def body_pose(pose: CameraPose, T_body_camera: FloatArray, scale: float) -> BodyPose:
    """Pose of the robot by a camera pose whose standard deviations are multiplied by ``scale``."""
    T_map_body = pose.T_map_camera @ inverse(T_body_camera)
    J = displacement_of_body(T_map_body, about=pose.T_map_camera[:3, 3])
    relative = scale**2 * (J @ (pose.covariance - pose.map_covariance) @ J.T)
    to_origin = lever_arm(-pose.T_map_camera[:3, 3])
    return BodyPose(T_map_body, relative, to_origin @ pose.map_covariance @ to_origin.T)


def pose_error(state: NavigationState, T_map_body: FloatArray) -> FloatArray:
    """(6,) Log(X^-1 Z) on SE(3), rotation first: the left-invariant error of ``state`` if ``T_map_body`` is true."""
    rotation = so3_log(state.R_map_body.T @ T_map_body[:3, :3])
    offset = (T_map_body[:3, 3] - state.position) @ state.R_map_body
    return np.concatenate((rotation, np.linalg.solve(so3_left_jacobian(rotation), offset)))


def _unexplained(state: NavigationState, pose: BodyPose) -> FloatArray:
    """(6,) :func:`pose_error` of a measured pose without the errors that the ``state`` has of it."""
    return pose_error(state, inverse(state.T_map_markers) @ pose.T_map_body) - state.systematic


def mount_jacobian(state: NavigationState) -> FloatArray:
    """(6, 3) derivative of a measured pose by a rotation of the camera against the robot, about the camera [rad]."""
    return np.vstack((np.eye(3), skew(state.T_body_camera[:3, 3])))


def map_jacobian(state: NavigationState) -> FloatArray:
    """(55, 6) derivative of the state by a motion of the map: rotation and position in the robot frame [rad, m]."""
    J = np.zeros((SIZE, 6))
    J[POSE] = np.eye(6)
    J[VELOCITY, :3] = -skew(state.velocity_body)
    J[GRAVITY, :3] = -(skew(state.gravity) @ state.R_map_body)[:2]
    return J


def innovation_of(config: PoseEkfConfig, estimate: Estimate, pose: BodyPose, motion: MotionAtPose) -> Innovation:
    """Innovation of ``pose`` against ``estimate`` at the same instant."""
    pose = pose.turned_to(estimate.state.T_map_body)
    prior = _propagated_to_markers(config, _propagated_to_view(config, estimate, pose), pose)
    derivative = prior.state.derivative(motion.imu)
    H = np.zeros((6, SIZE))
    H[_SIX, POSE] = 1.0
    H[:, EXTRINSICS] = H[:, SYSTEMATIC] = np.eye(6)
    mount = mount_jacobian(prior.state)
    jitter = np.outer(derivative[POSE], derivative[POSE])
    units = np.stack((pose.shape, jitter, mount @ mount.T))
    R = np.asarray((prior.pose_noise.variances[:, None, None] * units).sum(axis=0))
    if config.estimate_time_offset:
        H[:, TIME_OFFSET] = derivative[POSE]
        R += _second_order_of_clock(prior, motion, derivative)
    else:
        R += config.time_offset_std**2 * jitter
    value = _unexplained(prior.state, pose)
    H[:, MARKERS] = displacement_of_body(prior.state.T_map_markers @ prior.state.T_map_body)
    S = H @ prior.covariance @ H.T + R
    if prior.covariance[MARKERS, MARKERS].any():
        # New markers may be off by decimetres: a derivative from where they are thought to be would show turns of the
        # map that nothing shows.
        error = prior.covariance @ H.T @ np.linalg.solve(S, value)
        state = prior.state.moved_in_map(error)
        H[:, MARKERS] = displacement_of_body(state.T_map_markers @ state.T_map_body)
        S = H @ prior.covariance @ H.T + R
    S_inverse = np.asarray(np.linalg.inv(S))
    of_extrinsics = prior.of_extrinsics
    shown = H @ of_extrinsics
    S_exact = S - shown @ shown.T
    return Innovation(
        estimate, pose, motion, prior, derivative, units, value, S, S_inverse, H, R, of_extrinsics, S_exact
    )


def with_covariance(config: PoseEkfConfig, innovation: Innovation, covariance: FloatArray) -> Innovation:
    """The innovation if the covariance (55, 55) of the estimate were another one."""
    estimate = replace(innovation.estimate, covariance=covariance)
    return innovation_of(config, estimate, innovation.pose, innovation.motion)


def corrected(config: PoseEkfConfig, innovation: Innovation) -> Estimate:
    """The estimate after an accepted pose."""
    prior, before = innovation.prior, innovation.derivative
    gain, covariance, clock = _gain_and_covariance(innovation)
    error = _iterated(innovation, gain)
    state = prior.state.plus(error)
    if config.estimate_time_offset:
        now = state.derivative(innovation.motion.imu)
        state = state.moved((before - now) * error[TIME_OFFSET])
        covariance = _in_clock_of_imu(covariance, before - now)
    last = innovation.pose.as_last(prior.pose_noise.last, state.T_map_body)
    noise = replace(adapted_noise(innovation), last=last, of_map=prior.pose_noise.of_map)
    by_rotation = innovation.H @ innovation.of_extrinsics[:, :3]
    mount = prior.mount.after(by_rotation, innovation.S_exact, innovation.value)
    return replace(prior, state=state, covariance=covariance, pose_noise=noise, mount=mount, clock=clock)


def adapted_noise(innovation: Innovation) -> PoseNoise:
    """The noise of poses adapted to the innovation of an accepted or refused one: otherwise it would stay refused.

    In the map of the estimate before: only an accepted pose moves it into that of its markers.
    """
    return innovation.estimate.pose_noise.adapted(innovation.units, innovation.value, innovation.S_exact)


def with_unknown_clock(config: PoseEkfConfig, covariance: FloatArray) -> FloatArray:
    """Covariance (55, 55) with a clock offset as uncertain as after a step of the camera's clock; all else stays."""
    covariance = covariance.copy()
    covariance[TIME_OFFSET], covariance[:, TIME_OFFSET] = 0.0, 0.0
    covariance[TIME_OFFSET, TIME_OFFSET] = (2.0 * config.time_offset_std) ** 2
    return covariance


def _propagated_to_view(config: PoseEkfConfig, estimate: Estimate, pose: BodyPose) -> Estimate:
    """The estimate with the systematic error of poses propagated to the view of ``pose``: first-order Markov."""
    # The estimate shows better than a noisy pose how the view changes.
    seen = replace(pose, T_map_body=estimate.state.T_map_body)
    correlation = seen.correlation(estimate.pose_noise.last, config.systematic_angle)
    claimed = estimate.pose_noise.lasting * config.systematic_pose_std**2 * pose.shape
    P = estimate.covariance.copy()
    stays = share_that_stays(P[SYSTEMATIC, SYSTEMATIC], claimed)
    kept = correlation * stays
    P[SYSTEMATIC] = kept @ P[SYSTEMATIC]
    P[:, SYSTEMATIC] = P[:, SYSTEMATIC] @ kept.T
    P[SYSTEMATIC, SYSTEMATIC] += claimed - correlation**2 * stays @ claimed
    state = replace(estimate.state, systematic=kept @ estimate.state.systematic)
    return replace(estimate, state=state, covariance=P)


def _propagated_to_markers(config: PoseEkfConfig, estimate: Estimate, pose: BodyPose) -> Estimate:
    """The estimate with the map's error propagated to the markers of ``pose``: a random walk from those of the last.

    The estimate goes on in the map as they have it where that is better than its own, or where little is lost by it.
    So poor markers take away nothing that it knows.
    """
    noise, P = estimate.pose_noise, estimate.covariance.copy()
    now = pose.as_last(noise.last, estimate.state.T_map_body)
    if not any(C.any() for C in (now.map_covariance, noise.of_map, P[MARKERS, MARKERS])):
        return estimate
    since_last, apart = now.map_changes(np.stack((noise.last.map_covariance, noise.of_map)))
    P[MARKERS, MARKERS] += since_last
    estimate = replace(estimate, covariance=P)
    of_change, own = now.moved_by(apart), P[POSITION, POSITION].trace()
    # In a map of its own the estimate would know its place by the markers and by itself, in theirs by them alone.
    cost = of_change - of_change * own / (of_change + own)
    is_worse = now.moved_by(now.map_covariance) > now.moved_by(noise.of_map)
    if is_worse and cost > (_LITTLE * config.lost_position_std) ** 2:
        return estimate
    if now.moved_by(P[MARKERS, MARKERS]) > now.moved_by(apart):
        # The random walk knows less than the two covariances: the markers in between were worse.
        P[MARKERS], P[:, MARKERS] = 0.0, 0.0
        P[MARKERS, MARKERS] = apart
        estimate = replace(estimate, state=replace(estimate.state, T_map_markers=np.eye(4)))
    return _in_map_of_markers(replace(estimate, pose_noise=replace(noise, of_map=now.map_covariance)))


def _in_map_of_markers(estimate: Estimate) -> Estimate:
    """The estimate in the map as the present markers have it."""
    state = estimate.state.in_moved_map(estimate.state.T_map_markers)
    moved = np.eye(SIZE)
    moved[:, MARKERS] = map_jacobian(state) @ displacement_of_body(state.T_map_body)
    moved[MARKERS] = 0.0
    covariance = moved @ estimate.covariance @ moved.T
    return replace(estimate, state=replace(state, T_map_markers=np.eye(4)), covariance=covariance)


def _second_order_of_clock(prior: Estimate, motion: MotionAtPose, derivative: FloatArray) -> FloatArray:
    """Covariance (6, 6) of the second order: clock offset times the error of the velocity, and its square.

    The square enters by half of the acceleration.
    """
    P = prior.covariance
    # Of the position in the coordinates of a measured pose, in the robot's turning frame.
    acceleration = derivative[VELOCITY] - skew(derivative[ROTATION]) @ derivative[POSITION]
    with_velocity, variance = P[VELOCITY, TIME_OFFSET], float(P[TIME_OFFSET, TIME_OFFSET])
    square = 0.75 * variance**2
    R = np.zeros((6, 6))
    R[_SIX[:3], _SIX[:3]] = square * motion.turning**2
    R[_SIX[3:], _SIX[3:]] = square * float(acceleration @ acceleration)
    R[3:, 3:] += variance * P[VELOCITY, VELOCITY] + np.outer(with_velocity, with_velocity)
    return R


def _in_clock_of_imu(P: FloatArray, followed: FloatArray) -> FloatArray:
    """The covariance after an update that changed the core's derivative by ``-followed`` (9,).

    A pose measures the state at the camera's stamp, X(t) Exp(derivative s). The error of that state does not depend on
    the linearisation point of the derivative, so the error of X(t) is shifted with it; otherwise each correction of the
    velocity would add spurious information about the offset s. (G. Huang, A. Mourikis, S. Roumeliotis,
    "Observability-based Rules for Designing Consistent EKF SLAM Estimators", IJRR 2010, keep other unobservable
    directions in the same way.)
    """
    with_offset = P[TIME_OFFSET]
    half = np.outer(followed, with_offset + 0.5 * with_offset[TIME_OFFSET] * embedded_core(followed))
    P = P.copy()
    P[CORE] += half
    P[:, CORE] += half.T
    return P


def _clock_evidence(innovation: Innovation, by_pose: float) -> ClockEvidence:
    """What this and the latest poses say of the clock offset, whose variance falls by ``by_pose`` [s^2] with this one.

    The derivative of a pose by the offset is a measured motion. Its white noise, of covariance N, adds spurious
    information (errors in variables): at once tr(S^-1 N), and by what the state has taken up of the noise at earlier
    poses. With the gain G = 1 - R S^-1 of a pose on itself that is G / (2 - G) times as much, in all
    2 tr((S + R)^-1 N).
    """
    variance = float(innovation.prior.covariance[TIME_OFFSET, TIME_OFFSET])
    information = by_pose / max(variance, TINY) ** 2
    spurious = 2.0 * float(np.linalg.inv(innovation.S_exact + innovation.R).diagonal() @ innovation.motion.white)
    return innovation.prior.clock.after(information, spurious)


def _gain_and_covariance(innovation: Innovation) -> tuple[FloatArray, FloatArray, ClockEvidence]:
    """Kalman update: the gain (55, 6), the covariance (55, 55), and what is known of the clock offset.

    The gain is that of exact extrinsics, so the estimate does not depend on how well they are said to be known; the
    covariance has all that their errors do to it.

    Of the information about the clock offset a part is that of noise. The offset is corrected by the share of the rest,
    the best linear estimate, and its variance falls by the square of it: the noise is in what the correction adds, and
    not in what it takes away.
    """
    algebra, of_extrinsics = copy(_ALGEBRA), innovation.of_extrinsics
    exact = innovation.prior.covariance - of_extrinsics @ of_extrinsics.T
    # Where rounding leaves variances below zero, they would grow with each update.
    exact[EXTRINSICS], exact[:, EXTRINSICS] = 0.0, 0.0
    algebra.x, algebra.P = np.zeros(SIZE), exact
    algebra.update(innovation.value, lambda _: innovation.H, lambda _: np.zeros(6), R=innovation.R)
    gain, covariance = algebra.K, 0.5 * (algebra.P + algebra.P.T)
    by_pose = float(gain[TIME_OFFSET] @ innovation.S_exact @ gain[TIME_OFFSET])
    clock = _clock_evidence(innovation, by_pose)
    covariance[TIME_OFFSET, TIME_OFFSET] += (1.0 - clock.share_of_motion**2) * by_pose
    gain[TIME_OFFSET] *= clock.share_of_motion
    of_extrinsics = of_extrinsics - gain @ (innovation.H @ of_extrinsics)
    return gain, covariance + of_extrinsics @ of_extrinsics.T, clock


def _iterated(innovation: Innovation, gain: FloatArray) -> FloatArray:
    """The corrected error (55,) by ``gain`` (55, 6), after a second Gauss-Newton step from the same prior.

    After seconds without poses the position may be off by metres. Rotation times position, the second order of the
    first step, is then larger than what the pose claims. (B. Bell, F. Cathey, "The iterated Kalman filter update as a
    Gauss-Newton method", IEEE TAC 1993.)
    """
    error = gain @ innovation.value
    left = _unexplained(innovation.prior.state.moved_in_map(error), innovation.pose)
    return np.asarray(gain @ (left + error[POSE] + innovation.H[:, MARKERS] @ error[MARKERS]))
