"""A frame, and how what is seen in it moves: what is known before anything is found.

The rows of a bolometer array are sampled one after the other. The stamp is that of the middle row; row v is seen d
later, and what moves is carried on as far by then. Under constant motion that is an affine map of the image: straight
sides stay straight, and shifts of the corners say it all.

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

from dataclasses import dataclass
import math

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.quads import without_columns
from thermal_fiducial.core.detection.twist import interaction, Twist
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.pixel_noise import pixel_noise
from thermal_fiducial.core.types import Counts, Float32Array, FloatArray, Gray, IntArray, Stacked

#: Depth of points that are no longer in front of the camera [m].
LEAST_DEPTH = 1e-3
# Noise of frames that show none: that of rounding to whole counts [counts].
_LEAST_NOISE = 0.3
# Largest number of gray levels of what is meant for a display.
_LEVELS = 256
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


@dataclass(frozen=True)
class Frame:
    """An image, and what is known of the camera's motion at its stamp."""

    stamp_ns: int
    #: (height, width) counts as floating-point numbers
    image: Float32Array
    #: standard deviation of a pixel [counts]
    noise: float
    camera: Camera
    twist: Twist | None
    #: time constant of the bolometers, and time from the first row's sampling to the last's [s]
    lag: float
    readout: float
    #: whether it has gone through the camera's processing for a display, which bends the scale of counts
    displayed: bool = False

    @staticmethod
    def of(
        stamp_ns: int,
        counts: Counts | Gray,
        camera: Camera,
        twist: Twist | None,
        config: ArucoDetectorConfig,
        *,
        keep_columns: bool,
    ) -> 'Frame':
        """A frame without its columns' fixed pattern, unless that is kept or the frame has eight bits."""
        noise, displayed = pixel_noise(counts, _LEAST_NOISE), bool(counts[::64].max() < _LEVELS)
        lag, readout = config.bolometer_lag, config.readout_time
        image = counts.astype(np.float32)
        if counts.dtype != np.uint8 and not keep_columns:
            image = without_columns(image, noise)
        return Frame(stamp_ns, image, noise, camera, twist, lag, readout, displayed)


@dataclass(frozen=True, slots=True)
class Places(Stacked):
    """Where corners (N, 4) of markers are at a frame's stamp, and how the image moves there."""

    at: ImagePoints
    #: (N, 4) [m]
    depth: FloatArray
    #: (N, 4, 2, 6) derivative of the image's velocity by the camera's twist [px/s]
    flow: FloatArray

    @staticmethod
    def of(at: ImagePoints, depth: FloatArray) -> 'Places':
        """Those of points (N, 4) at ``depth`` (N, 4)."""
        return Places(at, depth, at.J @ interaction(at.x, depth))

    def lag_blur(self, twist: Twist, lag: float) -> FloatArray:
        """Mean displacement (N, 4, 2) [px] by a lag [s]."""
        return np.asarray(-lag * (self.flow @ twist.ago(lag)))


def delays(rows: FloatArray, frame: Frame) -> FloatArray:
    """How long after the stamp ``rows`` (...) are seen [s]."""
    return frame.readout * (rows / (frame.camera.height - 1) - 0.5)


def stretch(places: Places, twist: Twist, frame: Frame) -> FloatArray:
    """How much longer (N, 4) ways in the image are for what runs with the read-out, or shorter against it."""
    velocity = places.flow @ twist.value
    return np.asarray(1.0 / (1.0 - frame.readout / (frame.camera.height - 1) * velocity[..., 1]))


def displacement(places: Places, twist: Twist, frame: Frame, seconds: FloatArray) -> FloatArray:
    """By how much (N, 4, 2) corners appear farther on [px] when they are seen ``seconds`` (N, 4) after the stamp.

    What lag holds back has the velocity of one time constant earlier.
    """
    later = seconds[..., None]
    middle = places.at.x + 0.5 * later * (interaction(places.at.x, places.depth) @ twist.value)
    flow = Places.of(ImagePoints.seen_at(middle, frame.camera), places.depth).flow
    return np.asarray(later * (flow @ twist.value - (frame.lag - 0.5 * later) * (flow @ twist.acceleration)))


def rolling_displacement(
    places: Places, twist: Twist | None, frame: Frame, rows: FloatArray | None = None
) -> FloatArray:
    """The same (N, 4, 2) [px] for the ``rows`` (N, 4) in which corners are seen; None: will be seen, lag included."""
    if frame.readout == 0.0 or twist is None:
        return np.zeros_like(places.at.px)
    if rows is not None:
        return displacement(places, twist, frame, delays(rows, frame))
    lagging = places.at.px[..., 1] + places.lag_blur(twist, frame.lag)[..., 1]
    return displacement(places, twist, frame, delays(lagging, frame) * stretch(places, twist, frame))


def counts_of(pixel: IntArray, image: Float32Array, to_tails: FloatArray | None = None) -> Float32Array:
    """Counts (M, C, 4 N, m) of the pixels at these places of the flat image, as many of each of N markers.

    Lag tails are taken out of a few columns of pixels in a fourth of the time of the whole windows round the markers.

    Parameters
    ----------
    to_tails : (N, 2, 3) affine maps of pixels to where the image shows what these saw one lag tail's age ago, which is
        taken out; None: nothing is
    """
    counts = image.ravel().take(pixel, mode='clip')
    if to_tails is None:
        return counts
    by_marker = pixel.reshape(pixel.shape[0] * pixel.shape[1], len(to_tails), -1).astype(np.int32)
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
