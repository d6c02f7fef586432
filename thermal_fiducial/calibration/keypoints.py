"""Detection of candidate board points: saddles where squares meet, blobs at holes or spots.

Both are extrema of the determinant of the Hessian, compared with the noise of the frame's second derivatives. No
threshold on counts is needed, so hot or cold objects in the frame do not matter, and either polarity is found.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from thermal_fiducial.core.types import Counts, Float32Array, FloatArray, Gray, IntArray

# Search scales [px], the fast coarse ones first; a fifth to a third of the point spacing is best.
_SCALES = (17.0, 10.0, 5.8, 3.4, 2.0, 1.2)
# Ratio of the finer to the coarser of the two scales of a blob search.
_FINER = 0.6
# Structures wider than the scale by this factor are suppressed as background.
_WIDE = 4.0
_LEAST_SIDE = 8
_MOST_POINTS = 800
# Least ratio of response to noise; and noise of second derivatives by the rounding of counts at blur s, times s^3.
_NOISE_RATIO, _ROUNDING = 4.5, 0.02
# Largest distance of a saddle from the stationary point, in blurs. At the outer corner of a board's last square, or
# where three surfaces meet, it is 1.2 or more.
_STATIONARY = 0.8
# A pixel this share of the frame's range away from the median of its neighbours is dead or stuck: optics blur over
# more than a pixel, so nothing in the scene looks like that.
_SPECKLE = 0.35


@dataclass(frozen=True)
class Keypoints:
    """Points of an image, strongest first.

    Parameters
    ----------
    pixels : (N, 2)
    hessians : (N, 3) unit vectors of Iuu, Ivv, sqrt(2) Iuv: which way a saddle lies
    response : (N,) determinant of the Hessian, free of scale
    alternate : whether neighbours on a board have opposite Hessians (chessboard corners) or similar ones (discs)
    look : index of the search scale, and for blobs of the sign
    """

    pixels: FloatArray
    hessians: FloatArray
    response: FloatArray
    alternate: bool
    look: int = 0

    def rows(self, index: IntArray) -> 'Keypoints':
        """Some of them."""
        return Keypoints(self.pixels[index], self.hessians[index], self.response[index], self.alternate, self.look)


def without_speckles(counts: Counts | Gray) -> Float32Array:
    """Frame (height, width) as float32, single pixels that stick out replaced by the median around them."""
    median = cv2.medianBlur(counts, 3).astype(np.float32)
    low, high = np.percentile(median[::2, ::2], (0.5, 99.5))
    image = counts.astype(np.float32)
    return np.where(np.abs(image - median) > _SPECKLE * (high - low) + 1.0, median, image)


def saddles(image: Float32Array, first: int = 0) -> Iterator[Keypoints]:
    """Saddle points of ``image``, one scale after the other, beginning with index ``first``."""
    for look in _beginning_with(first, len(_SCALES)):
        yield replace(_extrema(image, _SCALES[look], None), look=look)


def blobs(image: Float32Array, first: int = 0) -> Iterator[Keypoints]:
    """Bright or dark blobs of ``image``, as :func:`saddles`; perspective makes discs of a board differ in size."""
    for look in _beginning_with(first, 2 * len(_SCALES)):
        scale, sign = _SCALES[look // 2], -1.0 if look % 2 else 1.0
        found = _strongest([_extrema(image, size, sign) for size in (scale, _FINER * scale)], scale)
        yield replace(found, look=look)


def _beginning_with(first: int, count: int) -> list[int]:
    """Numbers below ``count`` in their order, but for ``first``."""
    return sorted(range(count), key=lambda number: number != first)


def _strongest(found: list[Keypoints], apart: float) -> Keypoints:
    """Points of several scales; of those closer than ``apart`` [px] the strongest."""
    pixels, hessians, response = (
        np.concatenate([getattr(part, name) for part in found]) for name in ('pixels', 'hessians', 'response')
    )
    near = cKDTree(pixels).query_ball_point(pixels, apart) if len(pixels) else []
    kept = np.array([index for index, others in enumerate(near) if response[index] >= response[others].max()], np.int64)
    every = Keypoints(pixels, hessians, response, found[0].alternate)
    return every.rows(kept[np.argsort(-response[kept], kind='stable')][:_MOST_POINTS])


def _extrema(image: Float32Array, scale: float, sign: float | None) -> Keypoints:
    """Saddles (``sign`` None), bright (1) or dark (-1) blobs of ``image`` blurred by ``scale`` [px]."""
    shrink = max(1, int(scale / 1.5))
    size = image.shape[1] // shrink, image.shape[0] // shrink
    if min(size) < _LEAST_SIDE:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), sign is None)
    if shrink > 1:
        image = cv2.resize(image[: size[1] * shrink, : size[0] * shrink], size, interpolation=cv2.INTER_AREA).astype(
            np.float32
        )
    sigma = scale / shrink
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    smooth = np.asarray(smooth - cv2.GaussianBlur(smooth, (0, 0), _WIDE * sigma), dtype=np.float32)
    uu, vv, uv = (np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order, scale=0.25)) for order in ((2, 0), (0, 2), (1, 1)))
    determinant = uu * vv - uv * uv
    response = -determinant if sign is None else np.where(-sign * (uu + vv) > 0.0, determinant, 0.0)
    # Of a normal distribution a quarter lies within 0.3186 standard deviations.
    noise = max(float(np.percentile(np.abs(uv), 25.0)) / 0.3186, _ROUNDING / sigma**3)
    peak = (response >= cv2.dilate(response, np.ones((3, 3), np.uint8))) & (response > (_NOISE_RATIO * noise) ** 2)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    v, u = np.nonzero(peak)
    hessians = np.stack([uu[v, u], vv[v, u], np.sqrt(2.0) * uv[v, u]], axis=1).astype(np.float64)
    step = _to_stationary(np.asarray(smooth, dtype=np.float64), v, u, hessians)
    still = np.linalg.norm(step, axis=1) < _STATIONARY * max(sigma, 1.0)
    hessians /= np.linalg.norm(hessians, axis=1, keepdims=True) + 1e-12
    pixels = (np.stack([u, v], axis=1) + step + 0.5) * shrink - 0.5
    found = Keypoints(pixels, hessians, response[v, u].astype(np.float64) * sigma**4, sign is None)
    found = found.rows(np.flatnonzero(still))
    return found.rows(np.argsort(-found.response, kind='stable')[:_MOST_POINTS])


def _to_stationary(smooth: FloatArray, v: IntArray, u: IntArray, hessians: FloatArray) -> FloatArray:
    """Steps (N, 2) from pixels to where the slope vanishes (Newton): far from the corner of a single square."""
    slope_u, slope_v = 0.5 * (smooth[v, u + 1] - smooth[v, u - 1]), 0.5 * (smooth[v + 1, u] - smooth[v - 1, u])
    uu, vv, uv = hessians[:, 0], hessians[:, 1], hessians[:, 2] / np.sqrt(2.0)
    determinant = uu * vv - uv * uv
    return np.asarray(
        np.stack([uv * slope_v - vv * slope_u, uv * slope_u - uu * slope_v], axis=1) / determinant[:, None]
    )
