"""Paths of the body: a sway of sines, and smooth moves on top of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rigs.rig import pose, Rig, SECONDS

#: Speed [m/s] and rate [rad/s] of the sway of each style, about one sigma.
_SWAY = {
    'hover': (0.1, 0.05),
    'inspect': (0.4, 0.2),
    'brisk': (1.2, 0.6),
    'pan': (0.1, 1.0),
    'approach': (0.5, 0.2),
    'transit': (0.3, 0.15),
    'look away': (0.3, 0.1),
    'landing': (0.2, 0.15),
    'take-off': (0.6, 0.3),
}
#: Take-off [s]: rotors spin up for a second, then the sway grows.
ROTORS, LIFT_OFF, _RISE = 2.0, 3.0, 1.5
#: Share of the way to the nearest marker that the sway may go.
_FORWARD = 0.1
#: Steps of the numeric derivatives [s]: errors of 1e-6 of rates and forces at the fastest sway of 2.5 rad/s.
_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Move:
    """By ``by`` (6,) [m, rad], from ``begin`` on for ``seconds``."""

    begin: float
    seconds: float
    by: np.ndarray

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """Moved so far (N, 6)."""
        return smooth((t - self.begin) / self.seconds)[:, None] * self.by


@dataclass(frozen=True, eq=False)
class Path:
    """The body in the map: x ahead, to the wall; z up.

    Parameters
    ----------
    amplitude, rate, phase : (6, 4) of the sines of x, y, z [m], roll, pitch, yaw [rad]
    moves : on top
    lifts_off : when it begins to sway [s]; before that it is at rest
    """

    amplitude: np.ndarray
    rate: np.ndarray
    phase: np.ndarray
    moves: Sequence[Move]
    lifts_off: float

    def coordinates(self, t: np.ndarray) -> np.ndarray:
        """Position [m] and roll, pitch, yaw [rad] (N, 6) at times (N,) [s]."""
        sway = np.sum(self.amplitude * np.sin(self.rate * t[:, None, None] + self.phase), axis=-1)
        return sway * smooth((t - self.lifts_off) / _RISE)[:, None] + sum(move(t) for move in self.moves)

    def rotations(self, t: np.ndarray) -> Rotation:
        """R_map_body at times (N,)."""
        return Rotation.from_euler('ZYX', self.coordinates(t)[:, :2:-1])

    def T_map_body(self, t: float) -> np.ndarray:
        """(4, 4)."""
        at = np.array([t])
        return pose(self.rotations(at).as_matrix()[0], self.coordinates(at)[0, :3])

    def rates(self, t: np.ndarray) -> np.ndarray:
        """Angular velocity (N, 3) in the body [rad/s]."""
        between = self.rotations(t - _STEP).inv() * self.rotations(t + _STEP)
        return between.as_rotvec() / (2.0 * _STEP)

    def acceleration(self, t: np.ndarray) -> np.ndarray:
        """(N, 3) in the map [m/s^2]."""
        before, now, after = (self.coordinates(t + step)[:, :3] for step in (-_STEP, 0.0, _STEP))
        return (before - 2.0 * now + after) / _STEP**2


def smooth(share: np.ndarray) -> np.ndarray:
    """From 0 to 1 for shares from 0 to 1, with neither velocity nor acceleration at the ends."""
    x = np.clip(share, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def drawn(rig: Rig) -> Path:
    """The path of a rig, in its style."""
    rng = rig.rng('path')
    rate, phase = rng.uniform(0.5, 2.5, (6, 4)), rng.uniform(0.0, 2.0 * np.pi, (6, 4))
    speed, turn = _SWAY[rig.task.style]
    # Four sines of these amplitudes have the speed in three axes, and the rate in each.
    amplitude = np.repeat([speed / np.sqrt(3.0), turn], 3)[:, None] * np.sqrt(0.5) / rate
    if rig.task.style == 'pan':
        amplitude[3:5] *= 0.25
    amplitude[0] *= min(1.0, _FORWARD * rig.near / amplitude[0].sum())
    return Path(amplitude, rate, phase, _moves(rig, rng), LIFT_OFF if rig.task.style == 'take-off' else -_RISE)


def _moves(rig: Rig, rng: np.random.Generator) -> list[Move]:
    along = np.eye(6) * rig.near
    if rig.task.style == 'approach':
        return [Move(0.0, SECONDS, 0.5 * along[0])]
    if rig.task.style == 'landing':
        return [Move(3.0, SECONDS - 6.0, 0.65 * along[0])]
    if rig.task.style == 'transit':
        return [Move(2.0, 0.5 * SECONDS, 2.0 * along[1]), Move(0.5 * SECONDS + 2.0, 0.4 * SECONDS, -2.0 * along[1])]
    if rig.task.style == 'look away':
        return [move for begin in rng.uniform(3.0, SECONDS - 4.0, 2) for move in _glance(rng, begin)]
    return []


def _glance(rng: np.random.Generator, begin: float) -> list[Move]:
    """Away to the left or right, and back."""
    yaw = np.zeros(6)
    yaw[5] = rng.choice([-1.0, 1.0]) * rng.uniform(0.6, 1.3)
    return [Move(begin, 1.0, yaw), Move(begin + rng.uniform(2.0, 4.0), 1.0, -yaw)]
