"""Motion of the camera from frame to frame, as markers and the filter tell it.

The motion is that of a rigid scene seen from a camera with twist (v, omega) (F. Chaumette, S. Hutchinson, "Visual
servo control I", 2006, eq. 11). A Kalman filter holds the twist and its change (R. Singer, "Estimating optimal tracking
filter performance for manned maneuvering targets", 1970): predicted from the last frame, corrected by the filter's
states round the frame and by how the markers' corners moved since.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.detection.ids import pairs
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Twist of which nothing is known: m/s and rad/s of a brisk flight.
_UNKNOWN = np.full(6, 1.5**2)
# Covariance of an acceleration of which nothing is known [m/s^2, rad/s^2], and how long it lasts [s].
_RANDOM, _LASTS_S = np.diag([3.0, 3.0, 3.0, 4.0, 4.0, 4.0]) ** 2, 0.4
_STALE_S = 0.15
# So many states of the filter tell the acceleration too, as well as the filter knows the vertical and its biases.
_ENOUGH_STATES, _UNSURE = 4, np.diag([0.3, 0.3, 0.3, 0.0, 0.0, 0.0]) ** 2
# Covariance of a twist that is said to be without error [m^2/s^2, rad^2/s^2].
_LEAST = 1e-6 * np.eye(6)
# Jitter of the camera's stamps [s].
_JITTER_S = 0.001
# How far corners that lag displaces may be off their mean delay, where the form of smeared edges is unknown [lag].
_DELAY_UNSURE = 0.5
# Mean square of a marker's residuals over what the noise of its corners makes of it, beyond which not all markers can
# be of one scene (two in a hundred of brisk flights); how often weights are adapted, and when they have settled.
_OUTLIER, _ROUNDS, _SETTLED = 12.0, 10, 0.02
# Of the corners of a marker.
_COORDINATES = 8
_EYE = np.eye(6)
# No camera that sees markers moves faster: such odometry tells nothing [m/s, rad/s].
_FASTEST, _FASTEST_TURN = 20.0, 30.0


@dataclass(frozen=True, slots=True)
class Twist:
    """Velocity of the camera in its own frame, and how it changes.

    Parameters
    ----------
    value : (6,) v [m/s], omega [rad/s] at a frame's stamp
    covariance : (6, 6) of the value, or (12, 12) of value and acceleration
    acceleration : (6,) of the value
    """

    value: FloatArray
    covariance: FloatArray
    acceleration: FloatArray = field(default_factory=lambda: np.zeros(6))

    def ago(self, seconds: float) -> FloatArray:
        """Value (6,) so many seconds before the stamp."""
        return self.value - seconds * self.acceleration

    def covariance_ago(self, seconds: float) -> FloatArray:
        """Covariance (6, 6) of :meth:`ago`."""
        P = self.covariance
        return P[:6, :6] - seconds * (P[:6, 6:] + P[6:, :6]) + seconds**2 * P[6:, 6:]


def interaction(x: FloatArray, depth: FloatArray) -> FloatArray:
    """Derivative (..., 2, 6) of the velocity of normalised points (..., 2) at ``depth`` (...) [m] by the twist."""
    a, b, inverse = x[..., 0], x[..., 1], 1.0 / depth
    J = np.zeros((*x.shape, 6))
    J[..., 0, 0] = J[..., 1, 1] = -inverse
    J[..., 2] = x * inverse[..., None]
    J[..., 0, 3], J[..., 1, 3] = a * b, 1.0 + b * b
    J[..., 0, 4], J[..., 1, 4] = -1.0 - a * a, -J[..., 0, 3]
    J[..., 0, 5], J[..., 1, 5] = b, -a
    return J


def camera_twist(odometry: Odometry, T_body_camera: FloatArray) -> Twist:
    """Twist of the camera from that of the body."""
    return _transferred(odometry, _from_body(T_body_camera))


def _transferred(odometry: Odometry, transfer: FloatArray) -> Twist:
    return Twist(transfer @ _body_twist(odometry), transfer @ odometry.twist_covariance @ transfer.T)


def _from_body(T_body_camera: FloatArray) -> FloatArray:
    """What makes a camera's twist (6,) of the body's."""
    R = T_body_camera[:3, :3].T
    transfer = np.zeros((6, 6))
    transfer[:3, :3] = transfer[3:, 3:] = R
    transfer[:3, 3:] = -R @ se3.skew(T_body_camera[:3, 3])
    return transfer


def _body_twist(odometry: Odometry) -> FloatArray:
    return np.concatenate([odometry.velocity_body, odometry.angular_velocity_body])


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


class _Flow(NamedTuple):
    """Velocities of the M = 8 N coordinates of N markers' corners.

    Parameters
    ----------
    A : (M, 6) derivative by the twist
    velocity : (M,) normalised
    stretch : (M,) by what all velocities may be off together, one standard deviation
    weight : (M,) inverse variance of what each may be off by itself
    """

    A: FloatArray
    velocity: FloatArray
    stretch: FloatArray
    weight: FloatArray

    def robust(self, start: Twist, ago: float) -> Twist:
        """The twist ``start`` corrected by the velocities so many seconds before.

        A marker that moves by itself, or whose corners went astray, shows by its residuals beside those of the others,
        and loses weight accordingly.
        """
        twist = _corrected(start, *self._told(self.weight), -ago)
        if self._chi2(twist.ago(ago), self.weight).max() <= _OUTLIER:
            return twist
        # Together with the others, those that are wrong hide among them: what was expected tells them apart.
        trust = _trusted(self._chi2(start.ago(ago), self.weight))
        for _ in range(_ROUNDS):
            weight = np.repeat(trust, _COORDINATES) * self.weight
            twist = _corrected(start, *self._told(weight), -ago)
            former, trust = trust, _trusted(self._chi2(twist.ago(ago), weight))
            if np.abs(trust - former).max() < _SETTLED:
                break
        return twist

    def _told(self, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information on the twist (6, 6), and times the twist (6,)."""
        weighted, stretched = self.A.T * weight, weight * self.stretch
        spread = weighted @ self.stretch
        share = spread / (1.0 + stretched @ self.stretch)
        information = weighted @ self.A - spread[:, None] * share
        return information, weighted @ self.velocity - share * (stretched @ self.velocity)

    def _chi2(self, twist: FloatArray, weight: FloatArray) -> FloatArray:
        """Squared residuals (N,) of markers from a twist (6,), per degree of freedom."""
        residual, stretched = self.velocity - self.A @ twist, weight * self.stretch
        residual = residual - (stretched @ residual) / (1.0 + stretched @ self.stretch) * self.stretch
        return np.asarray((self.weight * residual * residual).reshape(-1, _COORDINATES).sum(axis=1) / _COORDINATES)


def _trusted(chi2: FloatArray) -> FloatArray:
    """Factors (N,) on the weights of markers, 1 for residuals like those of most (S. Geman, D. McClure, 1987)."""
    half = (len(chi2) - 1) // 2
    typical = max(float(np.partition(chi2, half)[half]), 1.0)
    return np.asarray(np.minimum(2.0 * typical / (typical + chi2), 1.0) ** 2)


class MotionTracker:
    """The camera's twist over the frames, and the markers that it saw."""

    def __init__(self, T_body_camera: FloatArray, lag: float = 0.0) -> None:
        self._from_body, self._lag = _from_body(T_body_camera), lag
        self._stamp_ns: int | None = None
        self._twist: Twist | None = None
        self._seen = Tracked.none()
        self._last_seen_ns: int | None = None

    def predict(
        self,
        stamp_ns: int,
        odometry: Sequence[Odometry],
        odometry_ns: int | None = None,
        clock_std_s: float = 0.0,
    ) -> Twist | None:
        """Twist expected at a frame; None when nothing is known.

        Parameters
        ----------
        odometry : states round the time that smears the frame, or the nearest that there is
        odometry_ns : the frame's stamp in their clock, if that is not the camera's
        clock_std_s : standard deviation of that stamp [s]
        """
        dt = self._since(stamp_ns)
        carried = None
        if self._twist is not None and dt is not None and self._saw_lately(stamp_ns):
            carried = _carried(self._twist, dt)
        odometry_ns = stamp_ns if odometry_ns is None else odometry_ns
        if len(odometry) >= _ENOUGH_STATES:
            observed = _line_through(odometry_ns, odometry, self._from_body)
            return _joined(carried or unknown_twist(), _of_unsure_stamp(observed, clock_std_s))
        if len(odometry) == 0 or abs(odometry_ns - odometry[-1].stamp_ns) * 1e-9 >= _STALE_S:
            return carried
        seen, later = _transferred(odometry[-1], self._from_body), (odometry[-1].stamp_ns - odometry_ns) * 1e-9
        unsure = (_growth(abs(later))[0] + clock_std_s**2) * _RANDOM
        information: FloatArray = np.asarray(np.linalg.inv(seen.covariance + unsure))
        return _corrected(carried or unknown_twist(), information, information @ seen.value, later)

    def expected(self, stamp_ns: int, twist: Twist) -> Tracked:
        """The last frame's markers where the camera's motion since has carried them."""
        dt = self._since(stamp_ns)
        if dt is None or self._twist is None or len(self._seen.ids) == 0:
            return Tracked.none()
        step = (0.5 * dt) * (twist.value + self._twist.value)
        moved = se3.inverse(se3.transform(se3.so3_exp(step[3:]), step[:3]))
        points = self._seen.depth[..., None] * (self._seen.x @ moved[:3, :2].T + moved[:3, 2]) + moved[:3, 3]
        depth = np.maximum(points[..., 2], 1e-3)
        return Tracked(self._seen.ids, points[..., :2] / depth[..., None], depth, self._seen.clarity)

    def correct(
        self,
        stamp_ns: int,
        predicted: Twist | None,
        ids: IntArray,
        x: FloatArray,
        depth: FloatArray,
        noise: FloatArray,
    ) -> Twist | None:
        """Twist from how the corners moved since the last frame.

        Parameters
        ----------
        ids : (N,)
        x : (N, 4, 2) normalised corners, where they would be without lag if the twist is predicted, and else as seen
        depth : (N, 4) [m]
        noise : (N,) standard deviation of a corner in normalised coordinates
        """
        now, before = pairs(ids, self._seen.ids)
        dt = self._since(stamp_ns)
        if len(now) == 0 or dt is None:
            return predicted
        begin, end = dt + (self._lag if self._twist is None else 0.0), self._lag if predicted is None else 0.0
        seconds, start = begin - end, predicted or unknown_twist()
        # Stamps that jitter stretch or shrink all velocities of a frame alike.
        unsure = 2.0 * _JITTER_S**2 + (0.0 if self._twist is not None else (_DELAY_UNSURE * self._lag) ** 2)
        A = interaction(0.5 * (x[now] + self._seen.x[before]), depth[now]).reshape(-1, 6)
        velocity = (x[now] - self._seen.x[before]).reshape(-1) / seconds
        stretch = A @ (np.zeros(6) if predicted is None else math.sqrt(unsure) / seconds * predicted.value)
        flow = _Flow(A, velocity, stretch, np.repeat((seconds / (1.5 * noise[now])) ** 2, _COORDINATES))
        return flow.robust(start, 0.5 * (begin + end))

    def all_clearer_than(self, clarity: float) -> bool:
        """Whether there were markers, all of more contrast over noise."""
        return len(self._seen.ids) > 0 and bool(np.abs(self._seen.clarity).min() > clarity)

    def remember(self, stamp_ns: int, twist: Twist | None, seen: Tracked) -> None:
        """Keep a frame's twist and markers for the next one; of one that comes late there is nothing to keep."""
        if self._stamp_ns is not None and 0 < self._stamp_ns - stamp_ns < _STALE_S * 1e9:
            return
        self._stamp_ns, self._twist, self._seen = stamp_ns, twist, seen
        if len(seen.ids):
            self._last_seen_ns = stamp_ns

    def _saw_lately(self, stamp_ns: int) -> bool:
        """Whether markers tell that the twist holds: one that went wrong would hide them from then on."""
        return self._last_seen_ns is not None and abs(stamp_ns - self._last_seen_ns) < _STALE_S * 1e9

    def _since(self, stamp_ns: int) -> float | None:
        """Time since the last frame [s], negative for one that comes late; None when that tells nothing of this one."""
        if self._stamp_ns is None or not 0 < abs(stamp_ns - self._stamp_ns) < _STALE_S * 1e9:
            return None
        return (stamp_ns - self._stamp_ns) * 1e-9


def unknown_twist() -> Twist:
    """That of a camera of which nothing is known."""
    return Twist(np.zeros(6), np.diag(np.concatenate([_UNKNOWN, _RANDOM.diagonal()])))


def _carried(twist: Twist, seconds: float) -> Twist:
    """Twist so much later, its acceleration having died down a little and changed at random; or as much earlier."""
    left, sign = math.exp(-abs(seconds) / _LASTS_S), math.copysign(1.0, seconds)
    lasting = sign * _LASTS_S * (1.0 - left)
    F = _of_blocks(1.0, lasting, 0.0, left, _IDENTITIES)
    own, both, change = _growth(abs(seconds))
    covariance = F @ twist.covariance @ F.T + _of_blocks(own, sign * both, sign * both, change, _RANDOMS)
    return Twist(twist.value + lasting * twist.acceleration, covariance, left * twist.acceleration)


def _growth(seconds: float) -> tuple[float, float, float]:
    """Times :data:`_RANDOM`: what a time adds to the covariance of the twist, to that with its acceleration, and of it.

    Singer, eq. 7.
    """
    t, left = seconds / _LASTS_S, math.exp(-seconds / _LASTS_S)
    own, both = _LASTS_S**2 * (2.0 * t - 3.0 + 4.0 * left - left**2), _LASTS_S * (1.0 - left) ** 2
    return own, both, 1.0 - left**2


def _blocks(matrix: FloatArray) -> FloatArray:
    """Flat matrices (4, 144) that have a ``matrix`` (6, 6) as one of their four blocks."""
    return np.stack([np.kron(block.reshape(2, 2), matrix).ravel() for block in np.eye(4)])


def _of_blocks(a: float, b: float, c: float, d: float, blocks: FloatArray) -> FloatArray:
    """Matrix (12, 12) of such blocks times a, b; c, d."""
    return np.asarray((np.array([a, b, c, d]) @ blocks).reshape(12, 12))


_IDENTITIES, _RANDOMS = _blocks(np.eye(6)), _blocks(_RANDOM)


def _line_through(stamp_ns: int, odometry: Sequence[Odometry], transfer: FloatArray) -> Twist:
    """Twist that changes evenly through those of K states.

    The error of the velocity is the same in all, that of a turn rate, a gyroscope's noise, is new in each.
    """
    parts = [part for state in odometry for part in (state.velocity_body, state.angular_velocity_body)]
    values = np.concatenate(parts).reshape(-1, 6) @ transfer.T
    t = np.array([(state.stamp_ns - stamp_ns) * 1e-9 for state in odometry])
    middle = float(t.sum()) / len(t)
    off = t - middle
    square = float(off @ off)
    acceleration = (off / square) @ values
    typical = transfer @ (sum(state.twist_covariance for state in odometry) / len(t)) @ transfer.T
    noise = np.zeros((6, 6))
    noise[3:, 3:] = typical[3:, 3:]
    slope = noise / square + _growth(float(t[-1] - t[0]))[2] * _RANDOM + _UNSURE
    covariance = np.empty((12, 12))
    covariance[:6, :6] = noise / len(t) + middle**2 * slope + _LEAST
    covariance[:3, :3] += typical[:3, :3]
    covariance[:6, 6:] = covariance[6:, :6] = -middle * slope
    covariance[6:, 6:] = slope
    return Twist(values.sum(axis=0) / len(t) - middle * acceleration, covariance, acceleration)


def _of_unsure_stamp(twist: Twist, clock_std_s: float) -> Twist:
    """``twist`` with what the uncertainty of its stamp [s] makes of it by its acceleration, and of what that is."""
    covariance = twist.covariance.copy()
    square = np.outer(twist.acceleration, twist.acceleration) + covariance[6:, 6:]
    covariance[:6, :6] += clock_std_s**2 * square
    return Twist(twist.value, covariance, twist.acceleration)


def _joined(first: Twist, second: Twist) -> Twist:
    """What two independent estimates tell together: of covariances P and R the gain P inv(P + R)."""
    gain = np.linalg.solve(first.covariance + second.covariance, first.covariance).T
    change = gain @ np.concatenate([second.value - first.value, second.acceleration - first.acceleration])
    covariance = _symmetric(gain @ second.covariance)
    return Twist(first.value + change[:6], covariance, first.acceleration + change[6:])


def _corrected(twist: Twist, information: FloatArray, weighted: FloatArray, later: float) -> Twist:
    """Twist when its value so much later is known by ``information`` (6, 6), times the value ``weighted`` (6,).

    The update of a Kalman filter with H = [I, later I], ``P - P H^T inv(I + W H P H^T) W H P`` of an information W that
    need not be invertible.
    """
    P = twist.covariance
    HP = P[:6] + later * P[6:]
    S = _EYE + information @ (HP[:, :6] + later * HP[:, 6:])
    residual = weighted - information @ twist.ago(-later)
    solved = np.linalg.solve(S, np.concatenate([information @ HP, residual[:, None]], axis=1))
    change = HP.T @ solved
    mean = change[:, 12]
    return Twist(twist.value + mean[:6], _symmetric(P - change[:, :12]), twist.acceleration + mean[6:])


def _symmetric(P: FloatArray) -> FloatArray:
    """Without what rounding makes of a covariance."""
    return 0.5 * (P + P.T)


def plausible(odometry: Odometry) -> bool:
    """Whether a camera that sees markers may move so: anything else tells nothing."""
    v, w = odometry.velocity_body, odometry.angular_velocity_body
    if not (v @ v <= _FASTEST**2 and w @ w <= _FASTEST_TURN**2):
        return False
    # A sum of squares is finite when all numbers are.
    T, P = odometry.T_map_body, odometry.twist_covariance
    return math.isfinite(np.vdot(T, T) + np.vdot(P, P))
