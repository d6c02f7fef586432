"""Points of a board to a few hundredths of a pixel, on raw counts."""

import cv2
import numpy as np

from thermal_fiducial.core.types import Float32Array, FloatArray

# Share of the distance to the nearest corner that a window reaches: no other edge may enter it.
_REACH = 0.45
_LEAST_REACH = 2.5
# Blur before the gradients [px]: less than the optics', so that it only tames the noise.
_BLUR = 0.7
_STEPS = 10
# The gradients need two pixels beyond the window.
_RIM = 2.0


def saddle_points(image: Float32Array, corners: FloatArray, spacing: FloatArray) -> FloatArray | None:
    """Corners (N, 2) of a chessboard; None when one of them runs away.

    At every edge through a corner the gradient g is perpendicular to the way to the corner c, so c solves
    sum w g g^T (x - c) = 0 over the pixels x of a round window (W. Foerstner, E. Guelch, "A fast operator for
    detection and precise location of distinct points, corners and centres of circular features", 1987). Gradients
    stay on their pixels; interpolating them, as ``cornerSubPix`` does, costs 0.02 px.

    Parameters
    ----------
    corners : (N, 2) within a pixel or two
    spacing : (N,) to the nearest other corner [px]
    """
    smooth = cv2.GaussianBlur(image, (0, 0), _BLUR)
    slopes = [np.asarray(cv2.Sobel(smooth, cv2.CV_64F, *order), dtype=np.float64) for order in ((1, 0), (0, 1))]
    gradient = np.stack(slopes, axis=-1)
    high = np.array([image.shape[1], image.shape[0]]) - 1.0 - _RIM
    refined = np.empty_like(corners)
    for index, (start, distance) in enumerate(zip(corners, spacing, strict=True)):
        corner = start
        for _ in range(_STEPS):
            reach = min(max(_LEAST_REACH, _REACH * distance), *(corner - _RIM), *(high - corner))
            moved = _gradient_intersection(gradient, corner, reach) if reach >= _LEAST_REACH else None
            if moved is None or np.linalg.norm(moved - start) > 0.5 * reach:
                return None
            step, corner = np.abs(moved - corner).max(), moved
            if step < 1e-4:
                break
        refined[index] = corner
    return refined


def _gradient_intersection(gradient: FloatArray, centre: FloatArray, reach: float) -> FloatArray | None:
    """Point (2,) that the edges within ``reach`` [px] of ``centre`` run through."""
    low, high = np.ceil(centre - reach).astype(int).tolist(), np.floor(centre + reach).astype(int).tolist()
    window = slice(low[1], high[1] + 1), slice(low[0], high[0] + 1)
    v, u = np.mgrid[window]
    away = np.stack([u, v], axis=-1) - centre
    weight = np.maximum(1.0 - np.sum(away**2, axis=-1) / reach**2, 0.0)
    g = gradient[window]
    weighted = (weight[..., None] * g).reshape(-1, 2)
    g, away = g.reshape(-1, 2), away.reshape(-1, 2)
    information = weighted.T @ g
    if np.linalg.det(information) <= 1e-6 * np.trace(information) ** 2:
        return None
    return np.asarray(centre + np.linalg.solve(information, weighted.T @ np.sum(g * away, axis=1)))


def centroids(image: Float32Array, centres: FloatArray, nearest: FloatArray, share: float) -> FloatArray:
    """Centroids (N, 2) of the counts above (or below) the ground between the circles; NaN where there is none.

    Within a window that ends half-way to the neighbours' rims the first moments of a blurred disc are those of the
    sharp one.

    Parameters
    ----------
    nearest : (N,) distance to the nearest other circle [px]
    share : diameter of a circle in that distance
    """
    pixels = np.full(centres.shape, np.nan)
    for index, (centre, distance) in enumerate(zip(centres, nearest, strict=True)):
        disc, outer = 0.5 * share * distance, distance * (1.0 - 0.5 * share) - 1.0
        moment: FloatArray | None = centre
        for _ in range(3):
            if moment is not None:
                moment = _first_moment(image, moment, disc, min(outer, disc + 3.0))
        if moment is not None and np.linalg.norm(moment - centre) < 0.3 * distance:
            pixels[index] = moment
    return pixels


def _first_moment(image: Float32Array, centre: FloatArray, disc: float, window: float) -> FloatArray | None:
    """Centroid within ``window`` [px] of ``centre``, over the ground seen just outside ``disc``; None off the image."""
    reach = int(np.ceil(window)) + 1
    u0, v0 = (np.rint(centre).astype(int) - reach).tolist()
    height, width = image.shape
    if u0 < 0 or v0 < 0 or u0 + 2 * reach + 1 > width or v0 + 2 * reach + 1 > height:
        return None
    patch = image[v0 : v0 + 2 * reach + 1, u0 : u0 + 2 * reach + 1].astype(np.float64)
    v, u = np.mgrid[v0 : v0 + 2 * reach + 1, u0 : u0 + 2 * reach + 1]
    radius = np.hypot(u - centre[0], v - centre[1])
    ring = (radius > disc + 1.5) & (radius <= window)
    if ring.sum() < 6:
        return None
    weight = (patch - np.median(patch[ring])) * np.clip(window + 0.5 - radius, 0.0, 1.0)
    total = weight.sum()
    if abs(total) < 1e-9:
        return None
    return np.array([np.sum(weight * u) / total, np.sum(weight * v) / total])
