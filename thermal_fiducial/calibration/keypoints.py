"""Detection of candidate board points: saddles where squares meet, blobs at holes or spots.

Both are extrema of the determinant of the Hessian, compared with the noise of the frame's second derivatives. No
threshold on counts is needed, so hot or cold objects in the frame do not matter, and either polarity is found.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import cKDTree

from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray

# Search scales [px]; a fifth to a third of the point spacing is best.
_SCALES = (17.0, 10.0, 5.8, 3.4, 2.0, 1.2, 0.72)
#: Each is the next one times this.
SCALE_RATIO = 1.7
# Scales that are compared: perspective makes the points of a board differ in size, and a strong structure several times
# as large as a point is another object, behind it or beside it.
_COMPARED = 3
# Distance [scales] within which a point is part of a stronger structure: a disc's edge is 1.4 from its centre.
_APART = 1.5
# Structures wider than the scale by this factor are suppressed as background.
_WIDE = 4.0
_LEAST_SIDE = 8
_MOST_POINTS = 800
#: Least ratio of a second derivative to its noise.
NOISE_RATIO = 4.5
# Noise of second derivatives by the rounding of counts at blur s, times s^3.
_ROUNDING = 0.02
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
    scale : (N,) index of the search scale, from coarse to fine
    signal : (N,) second derivative relative to its white noise, at least :data:`NOISE_RATIO`
    alternate : whether neighbours on a board have opposite Hessians (chessboard corners) or similar ones (discs)
    """

    pixels: FloatArray
    hessians: FloatArray
    response: FloatArray
    scale: IntArray
    signal: FloatArray
    alternate: bool

    def rows(self, index: IntArray | BoolArray) -> 'Keypoints':
        """Some of them."""
        return Keypoints(
            self.pixels[index],
            self.hessians[index],
            self.response[index],
            self.scale[index],
            self.signal[index],
            self.alternate,
        )


def without_speckles(counts: Counts | Gray) -> Float32Array:
    """Frame (height, width) as float32, single pixels that stick out replaced by the median around them."""
    median = cv2.medianBlur(counts, 3).astype(np.float32)
    low, high = np.percentile(median[::2, ::2], (0.5, 99.5))
    image = counts.astype(np.float32)
    return np.where(np.abs(image - median) > _SPECKLE * (high - low) + 1.0, median, image)


def saddles(image: Float32Array) -> list[Keypoints]:
    """Saddle points of ``image``, as a list of one."""
    return [_strongest([_extrema(image, scale, saddle=True) for scale in range(len(_SCALES))])]


def blobs(image: Float32Array) -> list[Keypoints]:
    """Bright blobs of ``image``, and dark ones."""
    found = [_extrema(image, scale, saddle=False) for scale in range(len(_SCALES))]
    bright = [points.hessians[:, :2].sum(axis=1) < 0.0 for points in found]
    return [
        _strongest([points.rows(mask == sign) for points, mask in zip(found, bright, strict=True)])
        for sign in (True, False)
    ]


def _strongest(found: list[Keypoints]) -> Keypoints:
    """Points of all scales; of those of similar scales closer than the coarser one the strongest."""
    pixels, hessians, response, scale, signal = (
        np.concatenate([getattr(part, name) for part in found])
        for name in ('pixels', 'hessians', 'response', 'scale', 'signal')
    )
    kept = np.ones(len(pixels), dtype=np.bool_)
    trees = [cKDTree(part.pixels) if len(part.pixels) else None for part in found]
    first = np.cumsum([0, *(len(part.pixels) for part in found)])
    for coarse, tree in enumerate(trees):
        for fine in range(coarse, min(coarse + _COMPARED + 1, len(found))):
            other = trees[fine]
            if tree is None or other is None:
                continue
            pairs = tree.sparse_distance_matrix(other, _APART * _SCALES[coarse], output_type='ndarray')
            one, two = pairs['i'] + first[coarse], pairs['j'] + first[fine]
            kept[np.where(response[one] < response[two], one, two)[response[one] != response[two]]] = False
    every = Keypoints(pixels, hessians, response, scale, signal, found[0].alternate)
    return every.rows(np.flatnonzero(kept)[np.argsort(-response[kept], kind='stable')])


def _extrema(image: Float32Array, scale: int, *, saddle: bool) -> Keypoints:
    """Saddles or blobs of ``image`` at a search scale, given by its index."""
    blur = _SCALES[scale]
    shrink = max(1, int(blur / 1.5))
    size = image.shape[1] // shrink, image.shape[0] // shrink
    if min(size) < _LEAST_SIDE:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64), np.zeros(0), saddle)
    if shrink > 1:
        image = cv2.resize(image[: size[1] * shrink, : size[0] * shrink], size, interpolation=cv2.INTER_AREA).astype(
            np.float32
        )
    sigma = blur / shrink
    smooth = cv2.GaussianBlur(image, (0, 0), sigma)
    smooth = np.asarray(smooth - cv2.GaussianBlur(smooth, (0, 0), _WIDE * sigma), dtype=np.float32)
    uu, vv, uv = (
        np.asarray(cv2.Sobel(smooth, cv2.CV_32F, *order, scale=0.25), dtype=np.float32)
        for order in ((2, 0), (0, 2), (1, 1))
    )
    determinant = uu * vv - uv * uv
    response = -determinant if saddle else determinant
    white, noise = (max(level, _ROUNDING / sigma**3) for level in _noise(uu, vv, uv))
    peak = (response >= cv2.dilate(response, np.ones((3, 3), np.uint8))) & (response > (NOISE_RATIO * noise) ** 2)
    peak[[0, -1]] = peak[:, [0, -1]] = False
    v, u = np.nonzero(peak)
    hessians = np.stack([uu[v, u], vv[v, u], np.sqrt(2.0) * uv[v, u]], axis=1).astype(np.float64)
    step = _to_stationary(np.asarray(smooth, dtype=np.float64), v, u, hessians)
    still = np.linalg.norm(step, axis=1) < _STATIONARY * max(sigma, 1.0)
    hessians /= np.linalg.norm(hessians, axis=1, keepdims=True) + 1e-12
    pixels = (np.stack([u, v], axis=1) + step + 0.5) * shrink - 0.5
    strength = response[v, u].astype(np.float64) * sigma**4
    signal = np.sqrt(response[v, u].astype(np.float64)) / white
    every = Keypoints(pixels, hessians, strength, np.full(len(pixels), scale), signal, saddle)
    found = every.rows(np.flatnonzero(still))
    return found.rows(np.argsort(-found.response, kind='stable')[:_MOST_POINTS])


def _noise(uu: Float32Array, vv: Float32Array, uv: Float32Array) -> tuple[float, float]:
    """Standard deviation of uv, of which columns have none, and that of the determinant's root.

    White noise has three times as much variance in uu and vv as in uv; fixed-pattern noise of columns is only in uu.
    Of a normal distribution a quarter lies within 0.3186 standard deviations, a tenth within 0.1257: a board that fills
    the image leaves fewer places without uu or vv than without uv.
    """
    mixed = float(np.percentile(np.abs(uv), 25.0)) / 0.3186
    across, down = (float(np.percentile(np.abs(part), 10.0)) / 0.1257 for part in (uu, vv))
    return mixed, max(float(np.sqrt(across * down / 3.0)), mixed)


def _to_stationary(smooth: FloatArray, v: IntArray, u: IntArray, hessians: FloatArray) -> FloatArray:
    """Steps (N, 2) from pixels to where the slope vanishes (Newton): far from the corner of a single square."""
    slope_u, slope_v = 0.5 * (smooth[v, u + 1] - smooth[v, u - 1]), 0.5 * (smooth[v + 1, u] - smooth[v - 1, u])
    uu, vv, uv = hessians[:, 0], hessians[:, 1], hessians[:, 2] / np.sqrt(2.0)
    determinant = uu * vv - uv * uv
    return np.asarray(
        np.stack([uv * slope_v - vv * slope_u, uv * slope_u - uu * slope_v], axis=1) / determinant[:, None]
    )
