"""Which of a frame's few markers are among others: comparing all with all costs less than sorting."""

import numpy as np

from thermal_fiducial.core.types import BoolArray, IntArray


def among(ids: IntArray, others: IntArray) -> BoolArray:
    """Which of ``ids`` (N,) are among ``others`` (M,)."""
    return np.asarray((ids[:, None] == others).any(axis=1))


def pairs(ids: IntArray, others: IntArray) -> tuple[IntArray, IntArray]:
    """Places, in ``ids`` (N,) and in ``others`` (M,), of the IDs that both have."""
    first, second = np.nonzero(ids[:, None] == others)
    return first, second
