"""The bolometers' lag that blurs what moves.

A bolometer answers the scene x with y, ``tau dy/dt + y = x``. While the image moves with velocity w, the pattern y is
carried along, ``dy/dt = -w . grad y``, so the scene at the very stamp would be ``x = y - tau w . grad y``. Corners must
not depend so much on the response being exactly exponential (renderers integrate the lag in a few steps, and a
derivative makes a ghost of every step). Only what is older than a time m is taken out: with ``b = exp(-m / tau)`` that
leaves ``(y(t) - b y(t - m)) / (1 - b)``, where the older image is the present one, shifted. It is blurred along the
motion by little, which the model of an edge knows, and late by a known mean delay.

While the velocity w changes by a, every age has one of its own: what was seen s ago lies s w - s^2 a / 2 behind. So the
mean delay of an exponential, -tau w + tau^2 a, is that of the velocity one time constant ago, and the lag tail
is as far from the image as the velocity of tau + m / 2 ago has carried it.
"""

import math

import cv2
import numpy as np

from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray

# Interpolation of lag tails where edges are measured: a linear one blurs them more than the image that they are taken
# from, a cubic one displaces them by up to 0.04 px.
_EXACT = cv2.INTER_LANCZOS4
# Pixels round a marker in which its edges and what surrounds it are looked at: 10 across its sides at most, and two
# that they may be off.
_MARGIN_PX = 12
# How much of the past is taken out of the image, in time constants, and its weight.
_TAIL = 0.75
_FORGOTTEN = math.exp(-_TAIL)
# The present's weight when the lag tail is taken out.
_GAIN = 1.0 / (1.0 - _FORGOTTEN)
#: What is left of the motion blur: its mean, and its standard deviation about that, as shares of the whole.
REMAINING = 1.0 - _TAIL * _FORGOTTEN * _GAIN
SPREAD = math.sqrt(1.0 - _TAIL**2 * _FORGOTTEN * _GAIN**2)
#: Age, in time constants, of the velocity that has carried the lag tail as far as it is from the image.
LAG_TAIL_AGE = 1.0 + 0.5 * _TAIL


def without_lag_tails(counts: Float32Array, pixel: IntArray, image: Float32Array, to_tails: FloatArray) -> Float32Array:
    """``counts`` (..., N Q) of pixels of the flat image, as many of each marker, without their lag tails.

    Of a few columns of pixels it takes a fourth of the time of the whole windows round the markers.

    Parameters
    ----------
    to_tails : (N, 2, 3) affine maps of pixels to where the image shows what these saw one lag tail's age ago
    """
    by_marker = pixel.reshape(-1, len(to_tails), pixel.shape[-1] // len(to_tails)).astype(np.int32)
    v, u = (places.astype(np.float32) for places in np.divmod(by_marker, np.int32(image.shape[1])))
    maps = to_tails.astype(np.float32)[..., None]
    to_u, to_v = (
        (maps[:, row, 0] * u + maps[:, row, 1] * v + maps[:, row, 2]).reshape(len(by_marker), -1) for row in (0, 1)
    )
    lag_tail = cv2.remap(image, to_u, to_v, _EXACT, borderMode=cv2.BORDER_REPLICATE).reshape(counts.shape)
    return np.asarray(counts + np.float32(_GAIN - 1.0) * (counts - lag_tail))


def markers_deblurred(image: Float32Array, corners_px: FloatArray, maps: FloatArray) -> Float32Array:
    """``image`` with the windows round N markers with corners (N, 4, 2) freed of lag tails, by ``maps`` to these.

    To read cells a cubic interpolation will do, which takes a fifth of the time of an exact one.
    """
    result, flags = image.copy(), cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    height, width = image.shape
    finite = np.isfinite(corners_px).all(axis=(1, 2)) & np.isfinite(maps).all(axis=(1, 2))
    corners_px, maps = corners_px[finite], maps[finite]
    low = np.floor(corners_px.min(axis=1)).astype(int) - _MARGIN_PX
    high = np.ceil(corners_px.max(axis=1)).astype(int) + _MARGIN_PX + 1
    low, high = np.maximum(low, 0), np.minimum(high, (width, height))
    seen = (low < high).all(axis=1)
    low, high, to_tail = low[seen], high[seen], maps[seen].astype(np.float32)
    to_tail[:, :, 2:] += to_tail[:, :, :2] @ low[..., None].astype(np.float32)
    for (u0, v0), (u1, v1), inverse in zip(low.tolist(), high.tolist(), to_tail, strict=True):
        lag_tail = cv2.warpAffine(image, inverse, (u1 - u0, v1 - v0), flags=flags, borderMode=cv2.BORDER_REPLICATE)
        cv2.addWeighted(image[v0:v1, u0:u1], _GAIN, lag_tail, 1.0 - _GAIN, 0.0, dst=result[v0:v1, u0:u1])
    return result


def lag_tail_maps(corners_px: FloatArray, lag_blur_px: FloatArray) -> FloatArray:
    """Affine maps (N, 2, 3) of the pixels round markers, (N, 4, 2) both, to where their lag tail lies.

    What a pixel saw earlier, the scene now has farther on: by least squares of the motion blur on (u, v, 1).
    """
    A = np.concatenate([corners_px, np.ones((len(corners_px), 4, 1))], axis=-1)
    A_T = A.swapaxes(1, 2)
    blur = np.linalg.solve(A_T @ A, A_T @ lag_blur_px).swapaxes(1, 2)
    return np.asarray(np.eye(2, 3) - _TAIL * blur)
