"""Smooth flights with analytic derivatives, for exact samples of the IMU."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError

GRAVITY = 9.80665
_DEGREE = 5
_KNOTS_PER_SECOND = 20


@dataclass(frozen=True)
class Motion:
    """Motion of the body at times t, in ``map`` unless the name says otherwise; leading dimension (N,)."""

    position: FloatArray
    rotation: Rotation
    velocity: FloatArray
    acceleration: FloatArray
    angular_velocity_body: FloatArray

    @property
    def T_map_body(self) -> FloatArray:
        """(N, 4, 4)."""
        return pose_matrix(self.rotation, self.position)


def pose_matrix(rotation: Rotation, position: npt.ArrayLike) -> FloatArray:
    """T_a_b (..., 4, 4) of a rotation or a stack of them and the origin of b in a."""
    R = rotation.as_matrix()
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, position, 1.0
    return T


class MotionPath(Protocol):
    """A path of a body."""

    def __call__(self, t: npt.ArrayLike, /) -> Motion:
        """The motion at times ``t`` (N,) [s]."""


class SplineTrajectory:
    """Quintic splines through poses: position, and the four-vector whose direction is the quaternion.

    Parameters
    ----------
    times : (N,) strictly increasing [s], at least six
    positions : (N, 3) of the body in ``map`` [m]
    rotations : N rotations, R_map_body

    Raises
    ------
    InputError
        Fewer than six poses, or times that don't increase.
    """

    def __init__(self, times: FloatArray, positions: FloatArray, rotations: Rotation) -> None:
        if len(times) <= _DEGREE or not np.all(np.diff(times) > 0):
            raise InputError(f'a trajectory needs more than {_DEGREE} poses, their stamps increasing')
        quaternions = rotations.as_quat()
        dots = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
        signs = np.cumprod(np.concatenate([[1.0], np.where(dots < 0.0, -1.0, 1.0)]))
        self.start, self.end = float(times[0]), float(times[-1])
        self._position: BSpline = make_interp_spline(times, positions, k=_DEGREE)
        self._quaternion: BSpline = make_interp_spline(times, quaternions * signs[:, None], k=_DEGREE)

    def __call__(self, t: npt.ArrayLike) -> Motion:
        """The motion at times ``t`` (N,) [s]; before the start and after the end the body stands still."""
        t = np.atleast_1d(np.asarray(t, dtype=np.float64))
        inside = np.clip(t, self.start, self.end)
        moving = (inside == t)[:, None]
        s, s_dot = self._quaternion(inside), self._quaternion(inside, 1) * moving
        rotation = Rotation.from_quat(s)
        return Motion(
            self._position(inside),
            rotation,
            self._position(inside, 1) * moving,
            self._position(inside, 2) * moving,
            _angular_velocity(s, s_dot),
        )


def _angular_velocity(s: FloatArray, s_dot: FloatArray) -> FloatArray:
    """Body rate of q = s/|s|: vector part of 2 conj(q) q_dot, independent of the component of s_dot along s."""
    s, s_dot = s.T, s_dot.T
    vector, w = s[:3], s[3]
    vector_dot, w_dot = s_dot[:3], s_dot[3]
    rate = w * vector_dot - w_dot * vector - np.cross(vector, vector_dot, axis=0)
    return np.asarray(2.0 * (rate / np.sum(s * s, axis=0)).T)


def smooth_step(t: FloatArray, start: float, duration: float) -> FloatArray:
    """Step from 0 to 1 over ``duration`` with three continuous derivatives (7th-degree polynomial)."""
    x = np.clip((t - start) / duration, 0.0, 1.0)
    return np.asarray(x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3))


@dataclass(frozen=True)
class Flight:
    """A flight that takes off, hovers, surveys and lands where it took off.

    Parameters
    ----------
    home : take-off point [m]
    height : hover above home [m]
    amplitude : of the oscillation about the hover point, x y z [m]
    period : of the oscillation of each axis [s]
    sway_deg, sway_period : amplitude [deg] and period [s] of the yaw oscillation during the survey
    turns : (start [s], duration [s], angle [deg]) of the yaw turns; a turn peaks at 2.19 angle / duration
    yaw_deg : heading at home
    ground_time, climb_time, hover_time : [s]
    """

    home: tuple[float, float, float] = (0.0, 0.0, 0.40)
    height: float = 0.9
    amplitude: tuple[float, float, float] = (0.5, 0.6, 0.25)
    period: tuple[float, float, float] = (9.0, 7.0, 5.0)
    sway_deg: float = 8.0
    sway_period: float = 6.0
    turns: tuple[tuple[float, float, float], ...] = ()
    yaw_deg: float = 0.0
    ground_time: float = 2.0
    climb_time: float = 2.5
    hover_time: float = 1.0

    def trajectory(self, seconds: float, seed: int) -> SplineTrajectory:
        """The flight of ``seed``, compressed into ``seconds``.

        Raises
        ------
        InputError
            Too short a time to take off and land, or a climb that no rotors can end.
        """
        margin = self.ground_time + self.climb_time + self.hover_time
        if seconds < 2 * margin:
            raise InputError(f'{seconds:g} s is too short for take-off and landing: at least {2 * margin:g} s')
        t = np.linspace(-0.5, seconds + 0.5, round(_KNOTS_PER_SECOND * (seconds + 1)) + 1)
        positions = self._positions(t, seconds, np.random.default_rng([seed, 1]))
        return SplineTrajectory(t, positions, _hover_attitude(t, positions, self._yaw(t, seconds)))

    def _envelope(self, t: FloatArray, seconds: float) -> FloatArray:
        start = self.ground_time + self.climb_time
        return smooth_step(t, start, 2.5) * (1.0 - smooth_step(t, seconds - start - 2.5, 2.5))

    def _positions(self, t: FloatArray, seconds: float, rng: np.random.Generator) -> FloatArray:
        ends = seconds - self.ground_time - self.climb_time
        up = smooth_step(t, self.ground_time, self.climb_time) * (1.0 - smooth_step(t, ends, self.climb_time))
        phases = rng.uniform(0.0, 2 * np.pi, 3)
        sway = np.sin(2 * np.pi * t[:, None] / np.array(self.period) + phases) * np.array(self.amplitude)
        positions = np.array(self.home) + sway * self._envelope(t, seconds)[:, None]
        positions[:, 2] += self.height * up
        return np.asarray(positions)

    def _yaw(self, t: FloatArray, seconds: float) -> FloatArray:
        yaw = self.sway_deg * np.sin(2 * np.pi * t / self.sway_period) * self._envelope(t, seconds)
        for start, duration, angle in self.turns:
            yaw = yaw + angle * smooth_step(t, start, duration)
        return np.asarray(np.radians(yaw + self.yaw_deg))


def _hover_attitude(t: FloatArray, positions: FloatArray, yaw: FloatArray) -> Rotation:
    """Attitude of a multirotor: thrust along acceleration minus gravity, heading ``yaw``."""
    acceleration = make_interp_spline(t, positions, k=_DEGREE)(t, 2)
    up = acceleration + np.array([0.0, 0.0, GRAVITY])
    # Rotors only push: to be slower than in free fall it would have to turn over.
    if np.min(up[:, 2]) <= 0.0:
        raise InputError('the flight falls faster than gravity pulls: a longer climb or less height is needed')
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    heading = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    left = np.cross(up, heading)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    return Rotation.from_matrix(np.stack([np.cross(left, up), left, up], axis=-1))
