"""Image motion, and the bolometers' lag that it smears.

A bolometer answers the scene x with y, ``tau dy/dt + y = x``. While the image moves with velocity w, the pattern y is
carried along, ``dy/dt = -w . grad y``, so the scene at the very stamp is ``x = y - tau w . grad y``: one derivative of
the image undoes the smear, and corners come out where they were at the stamp, without the lag's delay.

The motion is that of a rigid scene seen from a camera with twist (v, omega) (F. Chaumette, S. Hutchinson, "Visual
servo control I", 2006, eq. 11). A Kalman filter holds the twist: predicted from the filter's odometry or the last
frame, corrected by how the markers' corners moved since.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray

# First derivative, exact up to the sixth order: on images blurred by a pixel's optics the eighth does not matter.
_DERIVATIVE = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0], dtype=np.float32) / 60.0
DERIVATIVE_REACH = 3
# Twist of which nothing is known: m/s and rad/s of a brisk flight.
_UNKNOWN = np.diag([1.5, 1.5, 1.5, 1.5, 1.5, 1.5]) ** 2
# How much it changes within a second: 5 m/s^2 and 10 rad/s^2 sustained for a frame.
_CHANGE_PER_S = np.diag([5.0, 5.0, 5.0, 10.0, 10.0, 10.0]) ** 2
_STALE_S = 0.15
# No camera that sees markers moves faster: such odometry tells nothing [m/s, rad/s].
_FASTEST, _FASTEST_TURN = 20.0, 30.0


@dataclass(frozen=True, slots=True)
class Twist:
    """Velocity of the camera in its own frame: (6,) v [m/s], omega [rad/s], and its covariance."""

    value: FloatArray
    covariance: FloatArray


def interaction(x: FloatArray, depth: FloatArray) -> FloatArray:
    """Derivative (..., 2, 6) of the velocity of normalised points (..., 2) at ``depth`` (...) [m] by the twist."""
    a, b, inverse = x[..., 0], x[..., 1], 1.0 / depth
    zero = np.zeros_like(a)
    first = np.stack([-inverse, zero, a * inverse, a * b, -(1.0 + a * a), b], axis=-1)
    second = np.stack([zero, -inverse, b * inverse, 1.0 + b * b, -a * b, -a], axis=-1)
    return np.stack([first, second], axis=-2)


def camera_twist(odometry: Odometry, T_body_camera: FloatArray) -> Twist:
    """Twist of the camera from that of the body."""
    R = T_body_camera[:3, :3].T
    transfer = np.zeros((6, 6))
    transfer[:3, :3] = transfer[3:, 3:] = R
    transfer[:3, 3:] = -R @ geometry.skew(T_body_camera[:3, 3])
    body = np.concatenate([odometry.velocity_body, odometry.angular_velocity_body])
    covariance = transfer @ odometry.twist_covariance @ transfer.T
    return Twist(transfer @ body, covariance)


class MotionTracker:
    """The camera's twist over the frames."""

    def __init__(self, T_body_camera: FloatArray) -> None:
        self._T_body_camera = T_body_camera
        self._stamp_ns: int | None = None
        self._twist: Twist | None = None
        self._ids: IntArray = np.zeros(0, dtype=np.int64)
        self._x: FloatArray = np.zeros((0, 4, 2))

    def predict(self, stamp_ns: int, odometry: Odometry | None) -> Twist | None:
        """Twist expected at a frame; None when nothing is known."""
        if odometry is not None and 0.0 <= abs(stamp_ns - odometry.stamp_ns) * 1e-9 < _STALE_S:
            twist = camera_twist(odometry, self._T_body_camera)
            if _plausible(twist):
                return Twist(twist.value, twist.covariance + self._drift(stamp_ns, odometry.stamp_ns))
        if self._twist is None or self._stamp_ns is None or not 0 < stamp_ns - self._stamp_ns < _STALE_S * 1e9:
            return None
        return Twist(self._twist.value, self._twist.covariance + self._drift(stamp_ns, self._stamp_ns))

    def correct(
        self, stamp_ns: int, predicted: Twist | None, ids: IntArray, x: FloatArray, depth: FloatArray, noise: FloatArray
    ) -> Twist | None:
        """Twist from how the corners moved since the last frame.

        Parameters
        ----------
        ids : (N,)
        x : (N, 4, 2) normalised corners, as they are without lag
        depth : (N, 4) [m]
        noise : (N,) standard deviation of a corner in normalised coordinates
        """
        twist = predicted
        common, now, before = np.intersect1d(ids, self._ids, return_indices=True)
        if len(common) and self._stamp_ns is not None and 0 < stamp_ns - self._stamp_ns < _STALE_S * 1e9:
            dt = (stamp_ns - self._stamp_ns) * 1e-9
            middle = 0.5 * (x[now] + self._x[before])
            A = interaction(middle, depth[now]).reshape(-1, 6)
            velocity = (x[now] - self._x[before]).reshape(-1) / dt
            weight = np.repeat((dt / (1.5 * noise[now])) ** 2, 8)
            prior = predicted or Twist(np.zeros(6), _UNKNOWN)
            information = np.linalg.inv(prior.covariance)
            posterior: FloatArray = np.asarray(np.linalg.inv(information + (A.T * weight) @ A))
            value = posterior @ (information @ prior.value + (A.T * weight) @ velocity)
            twist = Twist(np.asarray(value), np.asarray(posterior))
        return twist

    def remember(self, stamp_ns: int, twist: Twist | None, ids: IntArray, x: FloatArray) -> None:
        """Keep a frame's twist and normalised corners (N, 4, 2) for the next one."""
        self._stamp_ns, self._twist, self._ids, self._x = stamp_ns, twist, ids, x

    @staticmethod
    def _drift(stamp_ns: int, since_ns: int) -> FloatArray:
        return _CHANGE_PER_S * ((stamp_ns - since_ns) * 1e-9) ** 2


def _plausible(twist: Twist) -> bool:
    speed, turn = np.linalg.norm(twist.value[:3]), np.linalg.norm(twist.value[3:])
    return bool(speed <= _FASTEST and turn <= _FASTEST_TURN and np.all(np.isfinite(twist.covariance)))


def smear(camera: Camera, x: FloatArray, depth: FloatArray, twist: Twist, tau: float) -> tuple[FloatArray, FloatArray]:
    """Mean displacement by lag (..., 2) [px] at normalised points (..., 2), and its covariance (..., 2, 2)."""
    A = -tau * camera.distort_jacobian(x) @ interaction(x, depth)
    return np.asarray(A @ twist.value), A @ twist.covariance @ np.swapaxes(A, -1, -2)


def without_lag(image: Float32Array, smear_u: Float32Array, smear_v: Float32Array) -> Float32Array:
    """The scene at the stamp: ``image`` (height, width) plus smear (height, width) times gradient."""
    du = cv2.filter2D(image, cv2.CV_32F, _DERIVATIVE[None, :])
    dv = cv2.filter2D(image, cv2.CV_32F, _DERIVATIVE[:, None])
    return np.asarray(image + smear_u * du + smear_v * dv)


def markers_without_lag(
    image: Float32Array, corners_px: FloatArray, smear_px: FloatArray, margin_px: int
) -> Float32Array:
    """``image`` with the windows round N markers (corners (N, 4, 2), smear (N, 4, 2) [px]) freed of lag."""
    result = image.copy()
    height, width = image.shape
    finite = np.isfinite(corners_px).all(axis=(1, 2)) & np.isfinite(smear_px).all(axis=(1, 2))
    corners_px, smear_px = corners_px[finite], smear_px[finite]
    affine = np.linalg.pinv(np.concatenate([corners_px, np.ones((len(corners_px), 4, 1))], axis=-1)) @ smear_px
    low = np.floor(corners_px.min(axis=1)).astype(int) - margin_px
    high = np.ceil(corners_px.max(axis=1)).astype(int) + margin_px + 1
    low, high = np.maximum(low, 0), np.minimum(high, (width, height))
    seen = (low < high).all(axis=1)
    low, high, affine = low[seen], high[seen], affine[seen]
    for (u0, v0), (u1, v1), map_uv in zip(low.tolist(), high.tolist(), affine.astype(np.float32), strict=True):
        # The derivative at the window's rim looks outside, where there is image.
        outer = np.s_[max(v0 - 3, 0) : v1 + 3, max(u0 - 3, 0) : u1 + 3]
        inner = np.s_[v0 - outer[0].start : v1 - outer[0].start, u0 - outer[1].start : u1 - outer[1].start]
        u, v = np.arange(u0, u1, dtype=np.float32), np.arange(v0, v1, dtype=np.float32)[:, None]
        window = image[outer]
        du = cv2.filter2D(window, cv2.CV_32F, _DERIVATIVE[None, :])[inner]
        dv = cv2.filter2D(window, cv2.CV_32F, _DERIVATIVE[:, None])[inner]
        su = map_uv[0, 0] * u + map_uv[1, 0] * v + map_uv[2, 0]
        sv = map_uv[0, 1] * u + map_uv[1, 1] * v + map_uv[2, 1]
        result[v0:v1, u0:u1] += su * du + sv * dv
    return result


class SmearField:
    """Displacement by lag over the whole image, for a scene at one depth.

    Parameters
    ----------
    camera : whose image it is
    """

    _STEP = 16

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        u = (np.arange(-(-camera.width // self._STEP)) + 0.5) * self._STEP - 0.5
        v = (np.arange(-(-camera.height // self._STEP)) + 0.5) * self._STEP - 0.5
        self._x = camera.normalise(np.stack(np.meshgrid(u, v), axis=-1))
        self._J = camera.distort_jacobian(self._x)

    def at(self, twist: Twist, depth: float, tau: float) -> FloatArray:
        """Coarse field (rows, columns, 2) [px]."""
        velocity = interaction(self._x, np.full(self._x.shape[:-1], depth)) @ twist.value
        return np.asarray(-tau * (self._J @ velocity[..., None])[..., 0])

    def full(self, coarse: FloatArray) -> Float32Array:
        """Field (height, width, 2)."""
        rows, columns = coarse.shape[:2]
        size = (columns * self._STEP, rows * self._STEP)
        field = cv2.resize(coarse.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        return np.asarray(field[: self.camera.height, : self.camera.width])
