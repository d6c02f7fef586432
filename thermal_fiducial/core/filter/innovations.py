"""What became of each pose, and how well it fitted what was expected: the filter says it, the report reads it."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
import math
import re

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

#: Name of that line among the filter's figures.
INNOVATIONS = 'innovations'
#: Verdicts that are kept, and poses over which the normalised innovation squared is averaged for the diagnostics.
_KEPT, _NIS_POSES = 300, 30
_REFUSED = '!'
_ONE = re.compile(rf'(\d+):([\d.e+-]+)({_REFUSED}?)')


@dataclass(frozen=True, slots=True)
class PoseUpdate:
    """What became of a camera pose."""

    #: stamp of the camera, as it came
    stamp_ns: int
    #: whether it moved the estimate
    accepted: bool
    #: in words; empty when accepted, but for a pose with which the filter started
    reason: str
    #: squared Mahalanobis distance (6 degrees of freedom), NaN where there was nothing to compare with
    nis: float
    #: whether it waits for the IMU samples of its instant; the final word is in ``PoseEkf.decided``
    pending: bool = False

    @property
    def refused(self) -> bool:
        """Whether it was compared with the estimate and found beyond the gate."""
        return not self.accepted and not math.isnan(self.nis)


class PoseLog:
    """The latest verdicts, in the order in which they were spoken, and how many there were."""

    def __init__(self) -> None:
        #: stamp of the camera to the latest verdict on its pose
        self.latest: dict[int, PoseUpdate] = {}
        self.accepted = self.refused = 0

    def add(self, update: PoseUpdate) -> None:
        """Take note of a verdict; a pose that is weighed again, as another one came late, counts once."""
        known = self.latest.pop(update.stamp_ns, None)
        if known is None:
            self.accepted += update.accepted
            self.refused += update.refused
        self.latest[update.stamp_ns] = update
        if len(self.latest) > _KEPT:
            del self.latest[next(iter(self.latest))]

    def mean_nis(self) -> float:
        """Of the latest accepted poses, per degree of freedom: 1 is consistent, less is cautious; NaN before any."""
        latest = islice(reversed(self.latest.values()), _NIS_POSES)
        values = [update.nis / 6.0 for update in latest if update.accepted and not math.isnan(update.nis)]
        return float(np.mean(values or math.nan))


@dataclass(frozen=True)
class Innovations:
    """Normalised innovations squared (N,) of poses at stamps (N,) [ns], and which of them were accepted (N,)."""

    stamps_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    nis: FloatArray = field(default_factory=lambda: np.zeros(0))
    accepted: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))


def innovations_text(updates: Iterable[PoseUpdate]) -> str:
    """``stamp:nis`` of each pose that was compared with something, ``!`` after a refused one."""
    compared = [update for update in updates if not math.isnan(update.nis)]
    return ' '.join(f'{u.stamp_ns}:{u.nis:.4g}{"" if u.accepted else _REFUSED}' for u in compared)


def innovations_of(text: str) -> Innovations:
    """What :func:`innovations_text` wrote; whatever else is in ``text`` doesn't count."""
    found = [match.groups() for match in _ONE.finditer(text)]
    return Innovations(
        np.array([int(stamp) for stamp, _, _ in found], np.int64),
        np.array([float(nis) for _, nis, _ in found]),
        np.array([mark != _REFUSED for _, _, mark in found], np.bool_),
    )
