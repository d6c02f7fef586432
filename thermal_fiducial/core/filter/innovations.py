"""Verdicts on poses with their normalised innovations: logged by the filter, published as text, read by the report."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice
import math
import re

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

#: Keys of the filter's diagnostics: normalised innovations; why the last pose was refused, until one is accepted.
INNOVATIONS, LAST_REFUSED = 'innovations', 'last refused pose'
#: Verdicts kept, and poses over which the diagnostics average the normalised innovation squared (NIS).
_KEPT, _NIS_POSES = 300, 30
_REFUSED = '!'
_ONE = re.compile(rf'(\d+):([\d.e+-]+)({_REFUSED}?)')


@dataclass(frozen=True, slots=True)
class PoseUpdate:
    """Verdict on a camera pose."""

    #: stamp of the camera, as it came
    stamp_ns: int
    #: whether it moved the estimate
    accepted: bool
    #: in words; empty when accepted, except for the pose that initialised or reset the filter
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
    """The latest verdicts, in the order in which they were given, and the numbers of accepted and refused poses."""

    def __init__(self) -> None:
        #: stamp of the camera to the latest verdict on its pose
        self.latest: dict[int, PoseUpdate] = {}
        self.accepted = self.refused = 0

    def add(self, updates: Iterable[PoseUpdate]) -> None:
        """Log verdicts; a pose that is applied again after a late one counts once."""
        for update in updates:
            known = self.latest.pop(update.stamp_ns, None)
            if known is None:
                self.accepted += update.accepted
                self.refused += update.refused
            self.latest[update.stamp_ns] = update
            if len(self.latest) > _KEPT:
                del self.latest[next(iter(self.latest))]

    def mean_nis(self) -> float:
        """Mean NIS per degree of freedom of the latest accepted poses: 1 is consistent, less conservative."""
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
    """Parse what :func:`innovations_text` wrote; anything else in ``text`` is skipped."""
    found = [match.groups() for match in _ONE.finditer(text)]
    return Innovations(
        np.array([int(stamp) for stamp, _, _ in found], np.int64),
        np.array([float(nis) for _, nis, _ in found]),
        np.array([mark != _REFUSED for _, _, mark in found], np.bool_),
    )
