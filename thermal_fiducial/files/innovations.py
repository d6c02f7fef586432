"""Normalised innovations of poses as text in the filter's diagnostics, which the report reads."""

from collections.abc import Iterable
from dataclasses import dataclass, field
import math
import re

import numpy as np

from thermal_fiducial.core.filter.belief import PoseUpdate
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

#: Keys of the filter's diagnostics: normalised innovations; why the last pose was refused, until one is accepted.
INNOVATIONS, LAST_REFUSED = 'innovations', 'last refused pose'
_REFUSED = '!'
_ONE = re.compile(rf'(\d+):([\d.e+-]+)({_REFUSED}?)')


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
