"""Noise of the pixels of a frame, from the frame itself."""

import math

import cv2
import numpy as np

from thermal_fiducial.core.types import Counts, Float32Array, Gray, SIGMA_OF_MEDIAN


def pixel_noise(counts: Counts | Gray | Float32Array) -> float:
    """Standard deviation of pixel noise [counts]: median absolute difference of vertical neighbours, sparsely.

    Differences along a column leave the column pattern out. Of whole counts the median may be 0, of noise of up to half
    a count, which it is taken for then.
    """
    rows = counts[4::16, ::3]
    below = counts[5::16, ::3]
    count = min(len(rows), len(below))
    difference = cv2.absdiff(np.ascontiguousarray(rows[:count]), np.ascontiguousarray(below[:count])).ravel()
    middle = difference.size // 2
    return max(float(np.partition(difference, middle)[middle]) * SIGMA_OF_MEDIAN / math.sqrt(2.0), 0.5)
