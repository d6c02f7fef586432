"""Alignment of inaccurate outlines with the pattern of their marker.

The outline of a faint marker may have a corner or two wrong by up to a cell. With a hypothesis of the marker, the whole
pattern and its white surroundings are fitted to the image: Gauss-Newton on the four corners, together with contrast
and a quadratic background (B. Lucas, T. Kanade, "An iterative image registration technique", 1981).
"""

from functools import cache
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.patterns import Decoder, sampled
from thermal_fiducial.core.geometry.se3 import bilinear, diagonals, seen_between
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray, TINY

_STEPS = 3
# Smoothing of the image [px], so that gradients reach half a cell.
_SMOOTHING = 1.0
# Largest smoothing of images without noise [cells].
_SMOOTHING_CELLS = 0.4
# Samples along a cell, and one outside the sides, in cells.
_SAMPLES = (0.17, 0.5, 0.83)
_OUTSIDE = 0.35
# Blur of an edge by smoothing, optics and pixels [cells].
_BLUR = 0.25
# Damping: share of the information's diagonal that is added to it.
_DAMPING = 0.1
# Factor from a Sobel filter's sum to a gradient per pixel.
_SOBEL = 1 / 8
# Longest step of a corner [cells].
_LONGEST = 0.6


class _Samples(NamedTuple):
    """The P samples of a marker with m x m cells."""

    #: (4, P) of :func:`bilinear`: where they are, and by how much each moves with each corner
    weights: Float32Array
    #: (6, P) background: constant, slopes, curvatures
    smooth: Float32Array
    #: (sqrt(P), m + 2) of :func:`_blur`
    blur: FloatArray


@cache
def _grid(cells: int) -> _Samples:
    share = np.concatenate([[-_OUTSIDE], (np.arange(cells)[:, None] + _SAMPLES).ravel(), [cells + _OUTSIDE]])
    a, b = (axis.ravel() / cells for axis in np.meshgrid(share, share))
    x, y = a - 0.5, b - 0.5
    smooth = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y]).astype(np.float32)
    return _Samples(bilinear(a, b).astype(np.float32), smooth, _blur(share, cells))


def aligned(
    image: Float32Array,
    quads: FloatArray,
    ids: IntArray,
    turns: IntArray,
    decoder: Decoder,
    *,
    noisy: bool = True,
) -> FloatArray:
    """Quadrilaterals (Q, 4, 2) aligned with the patterns of the markers ``ids`` (Q,), in quarter ``turns`` (Q,).

    An image that is not ``noisy`` is smoothed by no more than a share of a typical cell.
    """
    grid = _grid(decoder.cells)
    cells = np.ones((len(ids), decoder.cells + 2, decoder.cells + 2))
    cells[:, 1:-1, 1:-1] = decoder.seen(ids, turns)
    J = np.empty((len(ids), 15, grid.weights.shape[1]), dtype=np.float32)
    J[:, 8:14] = grid.smooth
    J[:, 14] = (grid.blur @ cells @ grid.blur.T).reshape(len(ids), -1)
    cell = float(np.median(diagonals(quads))) / (math.sqrt(2.0) * decoder.cells)
    smoothing = _SMOOTHING if noisy else min(_SMOOTHING, _SMOOTHING_CELLS * cell)
    image, origin = _window(image, quads, decoder.cells)
    quads = quads - origin
    picture = cv2.GaussianBlur(image - np.float32(image.mean()), (0, 0), smoothing)
    slope_u = cv2.Sobel(picture, cv2.CV_32F, 1, 0, scale=_SOBEL)
    slope_v = cv2.Sobel(picture, cv2.CV_32F, 0, 1, scale=_SOBEL)
    planes: list[Float32Array] = [np.asarray(plane) for plane in (picture, slope_u, slope_v)]
    for _ in range(_STEPS):
        places = seen_between(quads, grid.weights)
        value, du, dv = (sampled(plane, places)[:, None] for plane in planes)
        np.multiply(du, grid.weights, out=J[:, :4])
        np.multiply(dv, grid.weights, out=J[:, 4:8])
        information = (J @ np.swapaxes(J, -1, -2)).astype(np.float64)
        diagonal = np.einsum('qii->qi', information)
        diagonal[:, :8] *= 1.0 + _DAMPING
        # Keeps the system solvable where the image has no gradient in some direction.
        diagonal += TINY * (1.0 + diagonal.max(axis=1, keepdims=True))
        step = -np.linalg.solve(information, J @ np.swapaxes(value, -1, -2))[:, :8, 0]
        longest = _LONGEST / decoder.cells * diagonals(quads)[:, None] / np.sqrt(2.0)
        quads = quads + np.swapaxes(np.clip(step, -longest, longest).reshape(-1, 2, 4), -1, -2)
    return quads + origin


def _window(image: Float32Array, quads: FloatArray, cells: int) -> tuple[Float32Array, FloatArray]:
    """The part of the image that quadrilaterals (Q, 4, 2) may reach in all steps, and its first pixel (2,)."""
    extent = np.ptp(quads, axis=1).max()
    reach = (_STEPS * _LONGEST + _OUTSIDE) / cells * extent + 4.0 * _SMOOTHING + 2.0
    height, width = image.shape
    first = np.clip(quads.min(axis=(0, 1)) - reach, 0, (width - 1, height - 1)).astype(int)
    last = np.clip(quads.max(axis=(0, 1)) + reach, first, (width - 1, height - 1)).astype(int)
    return image[first[1] : last[1] + 1, first[0] : last[0] + 1], first.astype(np.float64)


def _blur(places: FloatArray, cells: int) -> FloatArray:
    """Weights (P, cells + 2) of blurred cells at ``places`` (P,) [cells]; the outermost two reach on without end."""
    edges = np.concatenate([[-np.inf], np.arange(cells + 1), [np.inf]])
    below = [[math.erf(z) for z in row] for row in ((edges - places[:, None]) / (_BLUR * math.sqrt(2.0))).tolist()]
    return np.asarray(0.5 * np.diff(np.array(below), axis=1))
