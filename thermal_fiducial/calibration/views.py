"""8-bit views of raw thermal frames in which a board is found whatever the scene around it.

Scaling a frame by its extremes leaves a board a few grey levels next to anything hot, and a board may be warm on
cold or cold on warm. So several views are tried: with the local mean taken out and the local contrast divided by, at
two scales, of the counts and of their logarithm, of both polarities.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from thermal_fiducial.core.types import Counts, Float32Array, Gray

# Scales of the local statistics in shares of the image width: a square of a board, a quarter of a board.
_SCALES = (0.06, 0.2)
# Grey levels that one local standard deviation fills.
_GAIN = 50.0
# Noise of the counts below which local contrast is not amplified.
_NOISE_FLOOR = 1.5


# A pixel this share of the frame's range away from the median of its neighbours is dead or stuck: optics blur over
# more than a pixel, so nothing in the scene looks like that.
_SPECKLE = 0.35


def without_speckles(counts: Counts | Gray) -> Float32Array:
    """Frame (height, width) as float32, single pixels that stick out replaced by the median around them."""
    median = cv2.medianBlur(counts, 3).astype(np.float32)
    low, high = np.percentile(median[::2, ::2], (0.5, 99.5))
    image = counts.astype(np.float32)
    return np.where(np.abs(image - median) > _SPECKLE * (high - low) + 1.0, median, image)


def board_views(image: Float32Array) -> Iterator[Gray]:
    """8-bit views (height, width) of a frame without speckles, the likeliest to show a board first."""
    low, high = np.percentile(image, (0.5, 99.5))
    logarithm = np.log1p(np.maximum(image - low, 0.0)) * np.float32((high - low + 1.0) / np.log1p(high - low + 1.0))
    for source in (image, logarithm):
        for scale in _SCALES:
            view = _locally_normalised(source, scale)
            yield view
            yield 255 - view
    clipped = np.clip((image - low) * (255.0 / max(float(high - low), 1.0)), 0, 255).astype(np.uint8)
    yield clipped
    yield 255 - clipped


def _locally_normalised(image: Float32Array, scale: float) -> Gray:
    smooth = np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), dtype=np.float32)
    sigma = scale * image.shape[1]
    mean = _wide_blur(smooth, sigma)
    spread = np.sqrt(np.maximum(_wide_blur((smooth - mean) ** 2, sigma), _NOISE_FLOOR**2))
    return np.clip(128.0 + _GAIN * (smooth - mean) / spread, 0, 255).astype(np.uint8)


def _wide_blur(image: Float32Array, sigma: float) -> Float32Array:
    """Gaussian blur, computed at an eighth of the resolution."""
    small = cv2.resize(image, None, fx=0.125, fy=0.125, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), sigma / 8.0, borderType=cv2.BORDER_REPLICATE)
    wide = cv2.resize(blurred, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(wide, dtype=np.float32)
