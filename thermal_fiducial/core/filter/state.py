"""What the filter estimates, and the coordinates of its error.

Pose and velocity are an element X = (R, v, p) of SE_2(3), the error is left-invariant, X_true = X Exp(xi): rotation,
velocity and position errors are expressed in the robot frame. A measured pose then has a constant Jacobian, and the
error's transition depends on the inertial increments alone.

Sources: A. Barrau, S. Bonnabel, "The Invariant Extended Kalman Filter as a Stable Observer", IEEE TAC 2017;
M. Brossard, A. Barrau, P. Chauchat, S. Bonnabel, "Associating Uncertainty to Extended Poses for on Lie Group IMU
Preintegration", IEEE T-RO 2022.
"""

from dataclasses import dataclass, field, replace
import math

import numpy as np

from thermal_fiducial.core.filter.evidence import ClockEvidence, MountEvidence
from thermal_fiducial.core.filter.pose_noise import PoseNoise
from thermal_fiducial.core.geometry.se3 import inverse, lever_arm, screwed, so3_exp, so3_left_jacobian, transform
from thermal_fiducial.core.types import FloatArray

#: Error coordinates by index. Core, expressed in the robot frame [rad, m/s, m],
ROTATION, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
#: biases of the IMU [rad/s, m/s^2],
GYROSCOPE_BIAS, ACCELEROMETER_BIAS, BIAS = slice(9, 12), slice(12, 15), slice(9, 15)
#: scale and cross-axis error matrices of gyroscope and accelerometer, row by row [1],
GYROSCOPE_MATRIX, ACCELEROMETER_MATRIX, SCALES = slice(15, 24), slice(24, 33), slice(15, 33)
#: delay of the accelerometer behind the gyroscope [s],
FORCE_DELAY = 33
#: horizontal components of gravity in the map [m/s^2],
GRAVITY = slice(34, 36)
#: clock offset [s],
TIME_OFFSET = 36
#: T_body_camera, perturbed from the left [rad, m]: consider parameters, whose values stay those of the parameters,
EXTRINSICS = slice(37, 43)
#: systematic error of the camera poses, which lasts as long as the view, in the robot frame [rad, m],
SYSTEMATIC = slice(43, 49)
#: T_map_markers, moved from the left along a screw [m, rad]: how the map's error of poses changes with their markers.
MARKERS = slice(49, 55)
SIZE = 55
#: Coordinates that an IMU step propagates, and coordinates that they are propagated from.
CORE, MOVED_BY = slice(0, 9), slice(0, 36)
#: Core and bias of the gyroscope, whose errors those of the published odometry are.
PUBLISHED = slice(0, 12)
#: Coordinates that a pose measures.
POSE = np.r_[ROTATION, POSITION]


@dataclass(frozen=True, slots=True)
class NavigationState:
    """State estimate at one instant, without its covariance."""

    #: (3, 3)
    R_map_body: FloatArray
    #: (3,) in the map [m/s]
    velocity: FloatArray
    #: (3,) in the map [m]
    position: FloatArray
    #: (6,) gyroscope [rad/s], then accelerometer [m/s^2]
    bias: FloatArray
    #: (2, 3, 3) errors of the measured rate and of the measured force, in shares of them
    scale: FloatArray
    #: of the accelerometer behind the gyroscope [s]
    force_delay: float
    #: (3,) in the map [m/s^2]
    gravity: FloatArray
    #: [s], t_imu = t_camera + camera_time_offset + time_offset
    time_offset: float
    #: (4, 4)
    T_body_camera: FloatArray
    #: (6,) systematic error of the camera poses, in the robot frame [rad, m]
    systematic: FloatArray
    #: (4, 4) the map as the markers of the last pose have it, in the map that the estimate is in
    T_map_markers: FloatArray

    @property
    def T_map_body(self) -> FloatArray:
        """(4, 4)."""
        return transform(self.R_map_body, self.position)

    @property
    def velocity_body(self) -> FloatArray:
        """(3,) velocity in the robot frame [m/s]."""
        return self.velocity @ self.R_map_body

    def corrected(self, imu: FloatArray) -> FloatArray:
        """Samples (..., 6) corrected for bias and scale errors [rad/s, m/s^2]."""
        return imu - self.bias - (self.scale @ imu.reshape(-1, 2, 3, 1)).reshape(imu.shape)

    def derivative(self, imu: FloatArray) -> FloatArray:
        """Time derivative (9,) of the core for a sample ``imu`` (6,): X(t + s) = X(t) Exp(derivative s)."""
        derivative = np.empty(9)
        derivative[:6] = self.corrected(imu)
        derivative[VELOCITY] += self.gravity @ self.R_map_body
        derivative[POSITION] = self.velocity_body
        return derivative

    def moved(self, error: FloatArray) -> 'NavigationState':
        """The state with its core corrected by ``error`` (9,): X Exp(xi)."""
        R_left = self.R_map_body @ so3_left_jacobian(error[ROTATION])
        return replace(
            self,
            R_map_body=orthonormal(self.R_map_body @ so3_exp(error[ROTATION])),
            velocity=self.velocity + R_left @ error[VELOCITY],
            position=self.position + R_left @ error[POSITION],
        )

    def moved_in_map(self, error: FloatArray) -> 'NavigationState':
        """The state with its core and the map of the markers corrected by ``error`` (55,)."""
        T_map_markers = screwed(np.eye(4), error[MARKERS]) @ self.T_map_markers
        return replace(self.moved(error[CORE]), T_map_markers=T_map_markers)

    def plus(self, error: FloatArray) -> 'NavigationState':
        """The state corrected by ``error`` (55,): X Exp(xi) for the group part, a sum for the rest.

        The extrinsics stay as they are.
        """
        return replace(
            self.moved_in_map(error),
            bias=self.bias + error[BIAS],
            scale=self.scale + error[SCALES].reshape(2, 3, 3),
            force_delay=self.force_delay + float(error[FORCE_DELAY]),
            gravity=with_horizontal(self.gravity, self.gravity[:2] + error[GRAVITY]),
            time_offset=self.time_offset + float(error[TIME_OFFSET]),
            systematic=self.systematic + error[SYSTEMATIC],
        )

    def in_moved_map(self, T_new_old: FloatArray) -> 'NavigationState':
        """The state in a map whose coordinates are moved by ``T_new_old`` (4, 4)."""
        R = T_new_old[:3, :3]
        return replace(
            self,
            T_map_markers=T_new_old @ self.T_map_markers @ inverse(T_new_old),
            R_map_body=orthonormal(R @ self.R_map_body),
            velocity=R @ self.velocity,
            position=R @ self.position + T_new_old[:3, 3],
            gravity=R @ self.gravity,
        )


@dataclass(frozen=True, slots=True)
class Estimate:
    """State and covariance (55, 55) of its error at an instant in the clock of the IMU."""

    stamp_ns: int
    state: NavigationState
    covariance: FloatArray
    #: noise of the camera poses, as adapted to the innovations
    pose_noise: PoseNoise
    mount: MountEvidence = field(default_factory=MountEvidence)
    clock: ClockEvidence = field(default_factory=ClockEvidence)

    def widened(self, error: FloatArray, std: float) -> 'Estimate':
        """The estimate with an unknown multiple of an ``error`` (55,), of standard deviation ``std``."""
        return replace(self, covariance=self.covariance + std**2 * np.outer(error, error))

    def std(self, place: slice | int) -> float:
        """Root of the sum of the variances of some coordinates: relative to the map, as poses show them."""
        return math.sqrt(float(self.covariance.diagonal()[place].sum()))

    @property
    def of_extrinsics(self) -> FloatArray:
        """(55, 6) errors of the estimate by a standard deviation of each of the extrinsics."""
        with_each = self.covariance[:, EXTRINSICS]
        stds = np.sqrt(with_each[EXTRINSICS].diagonal())
        return np.divide(with_each, stds, out=np.zeros_like(with_each), where=stds > 0.0)

    @property
    def position_std(self) -> float:
        """Root of the sum of the position variances, the map's error included [m]."""
        to_robot = lever_arm(self.state.position)[:3]
        of_map = to_robot @ self.pose_noise.of_map @ to_robot.T
        return math.hypot(self.std(POSITION), math.sqrt(float(of_map.trace())))


def embedded_core(error: FloatArray) -> FloatArray:
    """Error coordinates (55,) with the given core (9,), zero elsewhere."""
    whole = np.zeros(SIZE)
    whole[CORE] = error
    return whole


def clock_offset_derivative(derivative: FloatArray) -> FloatArray:
    """(55,) error coordinates of 1 s of clock offset that leaves the state at the camera's stamps as it is.

    ``derivative`` (9,): of the core, :meth:`NavigationState.derivative`.
    """
    error = embedded_core(-derivative)
    error[TIME_OFFSET] = 1.0
    return error


def with_horizontal(gravity: FloatArray, horizontal: FloatArray) -> FloatArray:
    """Downward vector as long as ``gravity`` (3,) with the given horizontal components (2,) [m/s^2]."""
    down = math.sqrt(max(float(gravity @ gravity - horizontal @ horizontal), 0.0))
    return np.array([horizontal[0], horizontal[1], -down])


def orthonormal(R: FloatArray) -> FloatArray:
    """The rotation next to a matrix (3, 3) that rounding has moved: one Newton step of the polar decomposition."""
    return np.asarray(1.5 * R - 0.5 * (R @ (R.T @ R)))
