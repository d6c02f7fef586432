"""An 8-bit view of raw counts in which markers of any contrast look alike, and noise stays below the threshold.

The local mean is taken out and the local spread divided by, down to a floor of the order of the noise, below which the
view fades: next to strong structures little is amplified, a marker of twice the noise fills the range, a bare wall
stays gray.
"""

import cv2
import numpy as np

from thermal_fiducial.core.types import Float32Array, Gray

# Mean and spread are taken on a quarter of the resolution over 17 of its pixels: 68 px, a marker at working distance.
_SHRINK = 4
_LOCAL = 17
# Levels that one local standard deviation fills.
_GAIN = 60.0
# Half-resolution pixels along a row over which columns are compared.
_COLUMNS = 9
# Mean of Gaussian noise clipped at one standard deviation moves by 0.68 of a small offset.
_CLIPPED = 1.0 / 0.68
# 1 / (sqrt(2) * 0.6745): standard deviation from the median absolute difference of two pixels.
_MAD_OF_DIFFERENCE = 1.0484


def noise_of(counts: Float32Array) -> float:
    """Standard deviation of pixel noise [counts]: median absolute difference of vertical neighbours, sparsely.

    Differences along a column leave the column pattern out.
    """
    rows = counts[4::8, ::3]
    below = counts[5::8, ::3]
    count = min(len(rows), len(below))
    difference = np.abs(rows[:count] - below[:count]).ravel()
    middle = difference.size // 2
    # Whole counts: half a count of quantisation is what a median of 0 can mean.
    return max(float(np.partition(difference, middle)[middle]) * _MAD_OF_DIFFERENCE, 0.3)


def halved(counts: Float32Array) -> Float32Array:
    """Half the resolution: means of 2 x 2 pixels, with half the noise."""
    height, width = counts.shape
    return np.asarray(cv2.resize(counts, (width // 2, height // 2), interpolation=cv2.INTER_AREA))


def without_columns(counts: Float32Array, noise: float) -> Float32Array:
    """``counts`` without the offsets of its columns, as they show in the typical pixel of each against its neighbours.

    What the scene does to a column is bounded by the noise: no pixel counts for more than that.
    """
    deviation = counts - cv2.blur(counts, (_COLUMNS, 1))
    np.clip(deviation, -noise, noise, out=deviation)
    return np.asarray(counts - _CLIPPED * cv2.reduce(deviation, 0, cv2.REDUCE_AVG))


def normalise(counts: Float32Array, noise: float, smoothing_px: float, floor: float, shrink: int = _SHRINK) -> Gray:
    """8-bit view of ``counts``.

    Parameters
    ----------
    counts : (height, width) counts or gray levels
    noise : standard deviation of the noise of a pixel [counts]
    smoothing_px : standard deviation of the Gaussian before the search, 0 for none
    floor : spread below which it shows less and less, in standard deviations of the noise of a pixel
    shrink : by which mean and spread are taken at a lower resolution
    """
    smooth = cv2.GaussianBlur(counts, (0, 0), smoothing_px) if smoothing_px > 0 else counts
    height, width = counts.shape
    small = cv2.resize(counts, (width // shrink, height // shrink), interpolation=cv2.INTER_AREA)
    mean = cv2.blur(small, (_LOCAL, _LOCAL))
    deviation = small - mean
    variance = cv2.blur(deviation * deviation, (_LOCAL, _LOCAL))
    gain = _GAIN * np.sqrt(variance) / (variance + (floor * noise) ** 2)
    offset = 128.0 - mean * gain
    full_gain = cv2.resize(gain, (width, height), interpolation=cv2.INTER_LINEAR)
    full_offset = cv2.resize(offset, (width, height), interpolation=cv2.INTER_LINEAR)
    np.multiply(smooth, full_gain, out=full_gain)
    return np.asarray(cv2.add(full_gain, full_offset, dtype=cv2.CV_8U))
