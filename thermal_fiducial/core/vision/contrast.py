"""What is darker than its surroundings, by a share of the local contrast: the same of markers of any contrast.

The local spread is the measure, down to a floor of the order of the noise, below which ever more is asked for: next to
strong structures little shows, of a marker of twice the noise all, of a bare wall nearly nothing.
"""

from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.types import Float32Array, Gray

# The spread is taken on a quarter of the resolution over 17 of its pixels: 68 px, a marker at working distance.
_LOCAL = 17
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


class Scale(NamedTuple):
    """How dark places are sought at one resolution."""

    #: standard deviation of the Gaussian before the search [px]
    smoothing_px: float
    #: odd width of the surroundings
    window_px: int
    #: how much darker than the mean of the surroundings, in local standard deviations
    depth: float
    #: spread below which it shows less and less, in standard deviations of the noise of a pixel
    floor: float
    #: by how much lower the resolution is at which the spread is taken
    shrink: int
    #: odd width of the median that takes out specks, 1 for none [px]
    specks_px: int = 1


def dark(counts: Float32Array, noise: float, scale: Scale) -> Gray:
    """Mask (height, width) of what is darker than its surroundings, 255 where it is.

    Parameters
    ----------
    counts : (height, width) counts or gray levels
    noise : standard deviation of the noise of a pixel [counts]
    """
    reach = 2 * round(2.5 * scale.smoothing_px) + 1
    smooth = cv2.GaussianBlur(counts, (reach, reach), scale.smoothing_px)
    around = cv2.blur(smooth, (scale.window_px, scale.window_px))
    height, width = counts.shape
    small = cv2.resize(counts, (width // scale.shrink, height // scale.shrink), interpolation=cv2.INTER_AREA)
    deviation = small - cv2.blur(small, (_LOCAL, _LOCAL))
    variance = np.maximum(cv2.blur(deviation * deviation, (_LOCAL, _LOCAL)), 1e-6)
    step = (scale.depth / np.sqrt(variance)) * (variance + (scale.floor * noise) ** 2)
    asked = cv2.resize(step, (width, height), interpolation=cv2.INTER_LINEAR)
    mask = cv2.compare(cv2.subtract(around, smooth, dst=around), asked, cv2.CMP_GT)
    return np.asarray(cv2.medianBlur(mask, scale.specks_px) if scale.specks_px > 1 else mask)
