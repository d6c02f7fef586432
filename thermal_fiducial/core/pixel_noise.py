"""Noise of the pixels of a frame, from the frame itself."""

import math

import cv2
import numpy as np

from thermal_fiducial.core.types import Counts, Float32Array, Gray, SIGMA_OF_MEDIAN


def pixel_noise(counts: Counts | Gray | Float32Array) -> float:
    """Standard deviation of pixel noise [counts]: median absolute difference of vertical neighbours, sparsely.

    Differences along a column do not contain the column pattern. With whole counts and noise below half a count the
    median may be 0; the result is half a count then.
    """
    rows = counts[4::16, ::3]
    below = counts[5::16, ::3]
    count = min(len(rows), len(below))
    difference = cv2.absdiff(np.ascontiguousarray(rows[:count]), np.ascontiguousarray(below[:count])).ravel()
    middle = difference.size // 2
    return max(float(np.partition(difference, middle)[middle]) * SIGMA_OF_MEDIAN / math.sqrt(2.0), 0.5)
