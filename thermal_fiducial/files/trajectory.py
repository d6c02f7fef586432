"""Trajectories as TUM files: ``t x y z qx qy qz qw`` a line, t in seconds; stamps keep their nanoseconds."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermal_fiducial.core.geometry import quaternion_from_rotation, transform_from_quaternion
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray
from thermal_fiducial.errors import InputError


@dataclass(frozen=True)
class Trajectory:
    """Poses at increasing stamps.

    Parameters
    ----------
    stamps_ns : (N,) int64, strictly increasing
    T_map_body : (N, 4, 4)
    """

    stamps_ns: IntArray
    T_map_body: FloatArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> FloatArray:
        """(N, 3) [m]."""
        return self.T_map_body[:, :3, 3]

    def take(self, index: IntArray | BoolArray) -> 'Trajectory':
        """The poses at ``index``."""
        return Trajectory(self.stamps_ns[index], self.T_map_body[index])


def load_tum(path: str | Path) -> Trajectory:
    """Read a trajectory; an empty one is fine.

    Raises
    ------
    InputError
        Unreadable, or a line that is no pose, or stamps that do not increase.
    """
    try:
        lines = Path(path).read_text(encoding='utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else 'not a text file'
        raise InputError(f'trajectory {path}: {reason}') from None
    numbered = [(number, line.split()) for number, line in enumerate(lines, 1) if line.strip() and line[0] != '#']
    stamps, rows = np.zeros(len(numbered), np.int64), np.zeros((len(numbered), 7))
    for index, (number, words) in enumerate(numbered):
        try:
            stamps[index], rows[index] = _nanoseconds(words[0]), [float(word) for word in words[1:]]
        except (ValueError, OverflowError):
            raise InputError(f'trajectory {path}, line {number}: not "t x y z qx qy qz qw"') from None
    _check(path, numbered, stamps, rows)
    return Trajectory(stamps, transform_from_quaternion(rows[:, :3], rows[:, 3:]))


def _check(path: str | Path, numbered: list[tuple[int, list[str]]], stamps: IntArray, rows: FloatArray) -> None:
    broken = ~np.all(np.isfinite(rows), axis=1) | (np.abs(np.linalg.norm(rows[:, 3:], axis=1) - 1.0) > 0.01)
    if np.any(broken):
        raise InputError(f'trajectory {path}, line {numbered[int(np.argmax(broken))][0]}: not a pose')
    backward = np.diff(stamps) <= 0
    if np.any(backward):
        raise InputError(
            f'trajectory {path}, line {numbered[int(np.argmax(backward)) + 1][0]}: stamp does not increase'
        )


def _nanoseconds(seconds: str) -> int:
    """Exact: a double has no nanoseconds left at the present time."""
    whole, _, fraction = seconds.partition('.')
    if not (whole.isdecimal() and (fraction or '0').isdecimal()):
        return round(float(seconds) * 1e9)
    return int(whole) * 1_000_000_000 + int(f'{fraction:0<9}'[:9])


def tum_lines(stamps_ns: IntArray, T_map_body: FloatArray) -> list[str]:
    """Lines of poses (N, 4, 4) at stamps (N,)."""
    q = quaternion_from_rotation(T_map_body[:, :3, :3])
    rows = np.concatenate([T_map_body[:, :3, 3], q], axis=1)
    return [
        f'{stamp // 1_000_000_000}.{stamp % 1_000_000_000:09d} ' + ' '.join(f'{value:.9f}' for value in row)
        for stamp, row in zip(stamps_ns.tolist(), rows.tolist(), strict=True)
    ]


def save_tum(path: str | Path, trajectory: Trajectory) -> None:
    """Write ``trajectory``."""
    lines = tum_lines(trajectory.stamps_ns, trajectory.T_map_body)
    Path(path).write_text(''.join(f'{line}\n' for line in lines), encoding='utf-8')
