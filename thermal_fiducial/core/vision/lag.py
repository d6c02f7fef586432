"""Image motion, and the bolometers' lag that smears it.

A bolometer answers the scene x with y, ``tau dy/dt + y = x``. While the image moves with velocity w, the pattern y is
carried along, ``dy/dt = -w . grad y``, so the scene at the very stamp is ``x = y - tau w . grad y``: the search for
markers takes that one derivative. Corners must not depend so much on the response being exactly exponential (renderers
integrate the lag in a few steps, and a derivative makes a ghost of every step). For them only what is older than a
time m is taken out, ``(y(t) - b y(t - m)) / (1 - b)`` with ``b = exp(-m / tau)``, where the older image is the present
one, shifted. What is left is a short blur along the motion, that the model of an edge knows, and its mean delay.

The motion is that of a rigid scene seen from a camera with twist (v, omega) (F. Chaumette, S. Hutchinson, "Visual
servo control I", 2006, eq. 11). A Kalman filter holds the twist: predicted from the filter's odometry or the last
frame, corrected by how the markers' corners moved since.
"""

from dataclasses import dataclass, replace
import math

import cv2
import numpy as np

from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray
from thermal_fiducial.core.vision.ids import pairs

# First derivative, exact up to the sixth order: on images blurred by a pixel's optics the eighth does not matter.
_DERIVATIVE = np.array([-1.0, 9.0, -45.0, 0.0, 45.0, -9.0, 1.0], dtype=np.float32) / 60.0
_WARP = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
# Twist of which nothing is known: m/s and rad/s of a brisk flight.
_UNKNOWN = np.diag([1.5, 1.5, 1.5, 1.5, 1.5, 1.5]) ** 2
# How much it changes within a second: 5 m/s^2 and 10 rad/s^2 sustained for a frame.
_CHANGE_PER_S = np.diag([5.0, 5.0, 5.0, 10.0, 10.0, 10.0]) ** 2
_STALE_S = 0.15
# How much of the past is taken out of the image, in time constants, and its weight.
_MEMORY = 0.75
_FORGOTTEN = math.exp(-_MEMORY)
_GAIN = 1.0 / (1.0 - _FORGOTTEN)
#: What is left of the smear: its mean, and its standard deviation about that, as shares of the whole.
REMAINING = 1.0 - _MEMORY * _FORGOTTEN * _GAIN
SPREAD = math.sqrt(1.0 - _MEMORY**2 * _FORGOTTEN * _GAIN**2)
# How far the time constant may be off, and the displacement of an edge by a response that is no exponential: a share of
# the smear, and one that grows with the cells that the smear covers.
_LAG_UNSURE = 0.35
_FORM_UNSURE, _FORM_UNSURE_IN_CELLS = 0.008, 0.010
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


@dataclass(frozen=True, slots=True)
class Tracked:
    """Markers of a frame that the next one should show.

    Parameters
    ----------
    ids : (N,)
    x : (N, 4, 2) normalised corners
    depth : (N, 4) [m]
    clarity : (N,) contrast over the noise of a pixel
    """

    ids: IntArray
    x: FloatArray
    depth: FloatArray
    clarity: FloatArray

    def only(self, keep: BoolArray) -> 'Tracked':
        """Those of the markers ``keep`` (N,)."""
        return Tracked(self.ids[keep], self.x[keep], self.depth[keep], self.clarity[keep])

    @staticmethod
    def none() -> 'Tracked':
        """No markers."""
        return Tracked(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros((0, 4)), np.zeros(0))


class MotionTracker:
    """The camera's twist over the frames, and the markers that it saw."""

    def __init__(self, T_body_camera: FloatArray, lag: float = 0.0) -> None:
        self._T_body_camera, self._lag = T_body_camera, lag
        self._stamp_ns: int | None = None
        self._twist: Twist | None = None
        self._seen = Tracked.none()
        # The first twist comes from corners whose own lag nobody knew: it tells little of where they will be.
        self._settled = False

    def predict(self, stamp_ns: int, odometry: Odometry | None) -> Twist | None:
        """Twist expected at a frame; None when nothing is known."""
        if odometry is not None and 0.0 <= abs(stamp_ns - odometry.stamp_ns) * 1e-9 < _STALE_S:
            twist = camera_twist(odometry, self._T_body_camera)
            return Twist(twist.value, twist.covariance + self._drift(stamp_ns, odometry.stamp_ns))
        if self._twist is None or self._stamp_ns is None or self._since(stamp_ns) is None:
            return None
        return Twist(self._twist.value, self._twist.covariance + self._drift(stamp_ns, self._stamp_ns))

    def expected(self, stamp_ns: int, twist: Twist) -> Tracked:
        """The last frame's markers where the camera's motion since has carried them."""
        dt = self._since(stamp_ns)
        if dt is None or self._twist is None or not self._settled or len(self._seen.ids) == 0:
            return Tracked.none()
        step = (0.5 * dt) * (twist.value + self._twist.value)
        moved = geometry.inverse(geometry.transform(geometry.so3_exp(step[3:]), step[:3]))
        rays = np.concatenate([self._seen.x, np.ones((*self._seen.x.shape[:-1], 1))], axis=-1)
        points = (rays * self._seen.depth[..., None]) @ moved[:3, :3].T + moved[:3, 3]
        depth = np.maximum(points[..., 2], 1e-3)
        return replace(self._seen, x=points[..., :2] / depth[..., None], depth=depth)

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
        now, before = pairs(ids, self._seen.ids)
        dt = self._since(stamp_ns)
        if len(now) and dt is not None:
            middle = 0.5 * (x[now] + self._seen.x[before])
            A = interaction(middle, depth[now]).reshape(-1, 6)
            velocity = (x[now] - self._seen.x[before]).reshape(-1) / dt
            weight = np.repeat((dt / (1.5 * noise[now])) ** 2, 8)
            prior = predicted or Twist(np.zeros(6), _UNKNOWN)
            information = np.linalg.inv(prior.covariance)
            posterior: FloatArray = np.asarray(np.linalg.inv(information + (A.T * weight) @ A))
            value = posterior @ (information @ prior.value + (A.T * weight) @ velocity)
            if self._twist is not None and self._settled:
                # That was half a frame ago; what smears this one is the motion of one time constant ago.
                apart = 0.5 * dt + self._lag
                limit = apart * np.sqrt(np.diag(_CHANGE_PER_S))
                value = value + (0.5 * dt - self._lag) / apart * np.clip(value - self._twist.value, -limit, limit)
            twist = Twist(np.asarray(value), np.asarray(posterior))
        return twist

    def all_clearer_than(self, clarity: float) -> bool:
        """Whether there were markers, all of more contrast over noise."""
        return len(self._seen.ids) > 0 and bool(np.abs(self._seen.clarity).min() > clarity)

    def remember(self, stamp_ns: int, twist: Twist | None, seen: Tracked) -> None:
        """Keep a frame's twist and markers for the next one."""
        self._settled = self._twist is not None and self._since(stamp_ns) is not None
        self._stamp_ns, self._twist, self._seen = stamp_ns, twist, seen

    def _since(self, stamp_ns: int) -> float | None:
        """Time since the last frame [s]; None when that tells nothing of this one."""
        if self._stamp_ns is None or not 0 < stamp_ns - self._stamp_ns < _STALE_S * 1e9:
            return None
        return (stamp_ns - self._stamp_ns) * 1e-9

    @staticmethod
    def _drift(stamp_ns: int, since_ns: int) -> FloatArray:
        return _CHANGE_PER_S * ((stamp_ns - since_ns) * 1e-9) ** 2


def plausible(odometry: Odometry) -> bool:
    """Whether a camera that sees markers may move so: anything else tells nothing."""
    speed, turn = np.linalg.norm(odometry.velocity_body), np.linalg.norm(odometry.angular_velocity_body)
    finite = np.isfinite(odometry.T_map_body).all() and np.isfinite(odometry.twist_covariance).all()
    return bool(speed <= _FASTEST and turn <= _FASTEST_TURN and finite)


def smear_by_twist(x: FloatArray, J: FloatArray, depth: FloatArray, tau: float) -> FloatArray:
    """Derivative (..., 2, 6) of :func:`smear` by the twist, where distortion has the derivative J (..., 2, 2) [px]."""
    return np.asarray(-tau * J @ interaction(x, depth))


def smear(camera: Camera, x: FloatArray, depth: FloatArray, twist: Twist, tau: float) -> FloatArray:
    """Mean displacement by lag (..., 2) [px] at normalised points (..., 2)."""
    return np.asarray(smear_by_twist(x, camera.distort_jacobian(x), depth, tau) @ twist.value)


def image_velocity(camera: Camera, x: FloatArray, depth: FloatArray, twist: Twist) -> FloatArray:
    """Velocity (..., 2) [px/s] of normalised points (..., 2)."""
    return np.asarray(camera.distort_jacobian(x) @ (interaction(x, depth) @ twist.value)[..., None])[..., 0]


def model_error(smear_px: FloatArray, cell_px: FloatArray) -> FloatArray:
    """Covariances (N, 4, 2, 2) [px^2] of what is wrong with an exponential lag of this time constant.

    A wrong time constant displaces the corners along their smear (N, 4, 2). What they have in common no marker can
    tell, and covariances of single corners cannot say; it is a delay, and belongs to the filter's time offset. The
    differences change the marker's shape. So does a response of another form, and the more the farther it carries the
    neighbouring edges, one cell (N,) away, into one another.
    """
    common = smear_px.mean(axis=1)
    change = _LAG_UNSURE * (smear_px - common[:, None])
    square = np.sum(common**2, axis=1)
    form = (_FORM_UNSURE**2 + (_FORM_UNSURE_IN_CELLS / cell_px) ** 2 * square)[:, None, None]
    along = common[:, :, None] * common[:, None, :] + square[:, None, None] * np.eye(2)
    return np.asarray(change[..., :, None] * change[..., None, :] + 0.5 * (form * along)[:, None])


def without_lag(image: Float32Array, smear_u: Float32Array, smear_v: Float32Array) -> Float32Array:
    """The scene at the stamp: ``image`` (height, width) plus smear (height, width) times gradient."""
    du = cv2.filter2D(image, cv2.CV_32F, _DERIVATIVE[None, :])
    dv = cv2.filter2D(image, cv2.CV_32F, _DERIVATIVE[:, None])
    return np.asarray(image + smear_u * du + smear_v * dv)


def markers_sharpened(
    image: Float32Array,
    corners_px: FloatArray,
    smear_px: FloatArray,
    margin_px: int,
    result: Float32Array | None = None,
) -> Float32Array:
    """``image`` with the windows round N markers (corners (N, 4, 2), smear (N, 4, 2) [px]) freed of old memories.

    ``result`` is where it is put, if given.
    """
    result = np.empty_like(image) if result is None else result
    np.copyto(result, image)
    height, width = image.shape
    finite = np.isfinite(corners_px).all(axis=(1, 2)) & np.isfinite(smear_px).all(axis=(1, 2))
    corners_px, smear_px = corners_px[finite], smear_px[finite]
    affine = _affine(corners_px, smear_px)
    low = np.floor(corners_px.min(axis=1)).astype(int) - margin_px
    high = np.ceil(corners_px.max(axis=1)).astype(int) + margin_px + 1
    low, high = np.maximum(low, 0), np.minimum(high, (width, height))
    seen = (low < high).all(axis=1)
    low, high, affine = low[seen], high[seen], affine[seen]
    # Where the memory of a pixel lies: what it saw earlier, the scene now has farther on.
    to_memory = (-_MEMORY * np.swapaxes(affine, -1, -2) + np.eye(2, 3)).astype(np.float32)
    to_memory[:, :, 2:] += to_memory[:, :, :2] @ low[..., None].astype(np.float32)
    for (u0, v0), (u1, v1), inverse in zip(low.tolist(), high.tolist(), to_memory, strict=True):
        memory = cv2.warpAffine(image, inverse, (u1 - u0, v1 - v0), flags=_WARP, borderMode=cv2.BORDER_REPLICATE)
        cv2.addWeighted(image[v0:v1, u0:u1], _GAIN, memory, 1.0 - _GAIN, 0.0, dst=result[v0:v1, u0:u1])
    return result


def _affine(points: FloatArray, values: FloatArray) -> FloatArray:
    """Least squares (N, 3, 2) of values (N, 4, 2) on (u, v, 1) of points (N, 4, 2)."""
    A = np.concatenate([points, np.ones((len(points), 4, 1))], axis=-1)
    A_T = np.swapaxes(A, -1, -2)
    return np.asarray(np.linalg.solve(A_T @ A, A_T @ values))


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
