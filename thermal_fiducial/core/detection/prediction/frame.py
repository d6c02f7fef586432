"""A frame with its noise, and the model of displacement and blur by rolling shutter and bolometer lag.

Rolling shutter: the rows of a bolometer array are sampled one after the other. The stamp is that of the middle row; row
v is sampled d later, and moving points are displaced by then. Under constant motion that is an affine map of the image:
straight sides stay straight, and displacements of the corners describe it.

Lag: a bolometer responds to the scene x with y, ``tau dy/dt + y = x``. While the image moves with velocity w, the
pattern y moves along, ``dy/dt = -w . grad y``, so the scene at the stamp would be ``x = y - tau w . grad y``. Corners
must not depend that much on an exactly exponential response (renderers integrate the lag in a few steps, and a
derivative makes a ghost of every step). Only the response older than a time m, the lag tail, is removed: with
``b = exp(-m / tau)``, ``(y(t) - b y(t - m)) / (1 - b)``, where the older image is the present one, shifted. A little
motion blur remains, which the edge model contains, and a known mean delay.

With an acceleration a, the image of s ago lies s w - s^2 a / 2 behind. The mean delay of an exponential,
-tau w + tau^2 a, is therefore that of the velocity one time constant ago.
"""

from dataclasses import dataclass, replace
from functools import cached_property
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.camera_frames import pixel_noise, with_columns_corrected
from thermal_fiducial.core.detection.prediction.twist import Twist
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import interaction, Real
from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray, Pixels, Stacked

#: Least depth of points, used for those behind the camera [m].
LEAST_DEPTH = 1e-3
# Number of gray levels up to which a frame counts as a picture for a display.
_LEVELS = 256
# -1 for black, 1 for white.
_SIGNS = np.array([-1.0, *[0.0] * (_LEVELS - 2), 1.0], dtype=np.float32)
# Rows that are looked at for it are so far apart: the first one alone may be dead, or carry telemetry.
_ROW_STEP = 16
# Interpolation of lag tails where edges are measured: a linear one blurs them more than the image that they are taken
# from, a cubic one displaces them by up to 0.04 px.
_EXACT = cv2.INTER_LANCZOS4
# Age m from which on the response counts as lag tail, in time constants, and the weight b of the tail.
_TAIL = 0.75
_FORGOTTEN = math.exp(-_TAIL)
# Displacement of a corner by lag, about the blur of the optics, up to which it is modelled as symmetric blur [px].
# Beyond it, the lag tail is removed.
_HARDLY_PX = 0.6
# Weight of the present image when the lag tail is removed.
_GAIN = 1.0 / (1.0 - _FORGOTTEN)


#: Motion blur that remains, as shares of that by the whole lag: its mean displacement, and its standard deviation.
#: Of an exponential response, those of the ages below m.
REMAINING = 1.0 - _TAIL * _FORGOTTEN / (1.0 - _FORGOTTEN)
SPREAD = math.sqrt(1.0 - _TAIL**2 * _FORGOTTEN / (1.0 - _FORGOTTEN) ** 2)


def _by_levels(levels: Counts | Gray, table: Float32Array) -> Float32Array:
    """Values (height, width) of gray ``levels`` by a ``table`` (256,), whose last one is that of all beyond."""
    # In half the time of numpy's.
    return np.asarray(cv2.LUT(cv2.convertScaleAbs(levels), table[None]), dtype=np.float32)


@dataclass(frozen=True)
class Frame:
    """An image with its noise, calibration and the predicted twist of the camera."""

    stamp_ns: int
    #: (height, width) as received where columns keep their fixed pattern, else counts without it
    pixels: Pixels
    #: standard deviation of a pixel [counts]
    noise: float
    camera: Camera
    twist: Twist | None
    #: time constant of the bolometers, and time from the first row's sampling to the last's [s]
    lag: float
    readout: float
    #: standard deviation of the blur by optics and pixels [px]
    blur_px: float
    #: (height, width) as received
    received: Counts | Gray
    #: whether it is a picture for a display, whose gain control is a nonlinear function of the counts
    displayed: bool = False
    #: counts of black and of white in a picture for a display
    ends: tuple[float, float] = (0.0, _LEVELS - 1.0)

    @staticmethod
    def of(
        stamp_ns: int,
        counts: Counts | Gray,
        camera: Camera,
        twist: Twist | None,
        config: ArucoDetectorConfig,
        blur_px: float,
        *,
        keep_columns: bool,
    ) -> 'Frame':
        """A frame, blurred by ``blur_px``; the fixed pattern of its columns is removed unless ``keep_columns``."""
        noise, displayed = pixel_noise(counts), bool(counts[::_ROW_STEP].max() < _LEVELS)
        pixels = counts if keep_columns else with_columns_corrected(counts.astype(np.float32), noise)
        lag, readout = config.bolometer_lag, config.readout_time
        return Frame(stamp_ns, pixels, noise, camera, twist, lag, readout, blur_px, counts, displayed)

    @cached_property
    def image(self) -> Float32Array:
        """The pixels as floating-point numbers: where markers are followed, few of them are looked at."""
        return self.pixels.astype(np.float32, copy=False)

    @cached_property
    def saturation(self) -> 'Saturation | None':
        """Where its gray scale ends; None: nowhere, or raw counts."""
        return Saturation.of(self.received, *self.ends) if self.displayed else None

    def in_counts(self, counts_of_levels: FloatArray) -> 'Frame':
        """The frame with counts for the gray levels of a picture for a display, by those (256,) of each level.

        Columns differ by an offset of counts, which the scale bends.
        """
        image = _by_levels(self.received, counts_of_levels.astype(np.float32))
        noise, ends = pixel_noise(image), (counts_of_levels[0], counts_of_levels[-1])
        return replace(self, pixels=with_columns_corrected(image, noise), noise=noise, ends=ends)


class Saturation(NamedTuple):
    """Pixels that are as white or as black as a display shows: what they show is a bound of their counts."""

    #: (height, width) 1 for white, -1 for black, else 0
    sign: Float32Array
    #: counts of black and of white
    low: float
    high: float

    @staticmethod
    def of(levels: Counts | Gray, low: float, high: float) -> 'Saturation | None':
        """Of a picture of gray ``levels`` (height, width); None: it is neither black nor white anywhere."""
        if levels.min() > 0 and levels.max() < _LEVELS - 1:
            return None
        return Saturation(_by_levels(levels, _SIGNS), low, high)

    def at(self, places: Float32Array) -> Float32Array:
        """Signs (...) at places (2, ...) in the image, 0 where no neighbour is saturated."""
        u, v = places
        signs = cv2.remap(self.sign, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(signs, dtype=np.float32)

    def cut(self, counts: Float32Array) -> Float32Array:
        """``counts`` (...) that are no blacker than black, and no whiter than white."""
        return np.asarray(np.clip(counts, self.low, self.high), dtype=np.float32)

    def known(self, places: Float32Array, tails: Float32Array) -> BoolArray:
        """Which places (2, ...) are known without their lag tails at ``tails`` (2, ...), within ``low`` and ``high``.

        Where the tail is not saturated, a pixel that is stays so without it. Where both are, what made the pixel
        white may have left it just now; it will then have faded to less than a half in the time of a lag tail, which
        the place on the other side shows.
        """
        now, then, later = self.at(places), self.at(tails), self.at(2.0 * places - tails)
        return np.asarray((then == 0.0) | (now * then < 0.0) | ((now * then > 0.0) & (now * later > 0.0)))


@dataclass(frozen=True, slots=True)
class Places(Stacked):
    """Image points of the corners (N, 4) of markers at a frame's stamp, with depth and optical flow."""

    points: ImagePoints
    #: (N, 4) [m]
    depth: FloatArray
    #: (N, 4, 2, 6) Jacobian of the image velocity by the camera's twist [px/s]
    flow: FloatArray

    @staticmethod
    def of(points: ImagePoints, depth: FloatArray) -> 'Places':
        """Places of image points (N, 4) at ``depth`` (N, 4)."""
        return Places(points, depth, points.J @ interaction(points.x, depth))

    def lag_blur(self, twist: Twist | None, lag: float) -> FloatArray:
        """Mean displacement (N, 4, 2) [px] of the corners in a ``lag`` [s]; none by an unknown twist."""
        if twist is None:
            return np.zeros_like(self.points.px)
        return np.asarray(-lag * (self.flow @ twist.ago(lag)))


def delays(rows: FloatArray, frame: Frame) -> FloatArray:
    """Time after the stamp [s] at which ``rows`` (...) are sampled."""
    return frame.readout * frame.camera.readout_shares(rows)


def rolling_displacement(
    places: Places, twist: Twist | None, frame: Frame, rows: FloatArray | None = None
) -> FloatArray:
    """Displacement (N, 4, 2) [px] by the rolling shutter.

    ``rows`` (N, 4): in which the corners were observed; None: those that they are in at the stamp, lag included.
    """
    if frame.readout == 0.0 or twist is None:
        return np.zeros_like(places.points.px)
    if rows is None:
        rows = (places.points.px + places.lag_blur(twist, frame.lag))[..., 1]
    later = delays(rows, frame)[..., None]
    middle = places.points.x + 0.5 * later * (interaction(places.points.x, places.depth) @ twist.value)
    flow = Places.of(ImagePoints.seen_at(middle, frame.camera), places.depth).flow
    # A lagging image moves with the velocity of one time constant ago.
    return np.asarray(later * (flow @ twist.value - (frame.lag - 0.5 * later) * (flow @ twist.acceleration)))


def displacement_by_motion(places: Places, frame: Frame) -> FloatArray:
    """Displacement (N, 4, 2) [px] of the corners in the image from their places at the stamp: lag, rolling shutter."""
    return places.lag_blur(frame.twist, frame.lag) + rolling_displacement(places, frame.twist, frame)


def counts_of(pixel: IntArray, image: Pixels, to_tails: FloatArray | None = None) -> Float32Array:
    """Counts (M, C, 4 N, m) at the indices ``pixel`` of the flat image, lag tails removed; N markers in equal parts.

    Only these pixels are corrected, in a fourth of the time of the whole windows around the markers.

    Parameters
    ----------
    to_tails : (N, 2, 3) affine maps from pixels to their lag tails; None: nothing is removed
    """
    counts = image.ravel().take(pixel, mode='clip').astype(np.float32, copy=False)
    if to_tails is None:
        return counts
    width = np.float32(image.shape[1])
    by_marker = pixel.reshape(pixel.shape[0] * pixel.shape[1], len(to_tails), -1).astype(np.float32)
    # In the middle of a pixel, so that rounding does not change the row: integers take four times as long to divide.
    # In place: fresh memory takes as long as what is computed in it.
    v = by_marker + np.float32(0.5)
    v /= width
    np.floor(v, out=v)
    u = by_marker
    u -= width * v
    maps, tails = to_tails.astype(np.float32)[..., None], []
    for row in (0, 1):
        place = maps[:, row, 0] * u
        place += maps[:, row, 1] * v
        place += maps[:, row, 2]
        tails.append(place.reshape(len(by_marker), -1))
    to_u, to_v = tails
    lag_tails = np.asarray(cv2.remap(image, to_u, to_v, _EXACT, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32)
    return without_tails(counts, lag_tails.reshape(counts.shape))


def without_tails(counts: Float32Array, lag_tails: Float32Array) -> Float32Array:
    """``counts`` (...) at some places without the lag tails there, where ``lag_tails`` (...) are the image's."""
    return np.asarray(counts + np.float32(_GAIN - 1.0) * (counts - lag_tails))


def lag_tail_places(places: Real, to_tails: FloatArray) -> Real:
    """Places (2, N, P) of the lag tails of ``places`` (2, N, P), by maps (N, 2, 3) of :func:`lag_tail_maps`."""
    maps = to_tails.transpose(1, 2, 0)[..., None].astype(places.dtype)
    tails: Real = maps[:, 0] * places[0] + maps[:, 1] * places[1] + maps[:, 2]
    return tails


def lag_tail_maps(corners_px: FloatArray, lag_blur_px: FloatArray) -> FloatArray:
    """Affine maps (N, 2, 3) from pixels around N markers to their lag tails.

    A least-squares fit of the displacements ``lag_blur_px`` (N, 4, 2) of the corners (N, 4, 2) on (u, v, 1).
    """
    A = np.concatenate([corners_px, np.ones((len(corners_px), 4, 1))], axis=-1)
    A_T = A.swapaxes(1, 2)
    blur = np.linalg.solve(A_T @ A, A_T @ lag_blur_px).swapaxes(1, 2)
    return np.asarray(np.eye(2, 3) - _TAIL * blur)


@dataclass(frozen=True, slots=True)
class MotionBlur(Stacked):
    """Displacement and blur of N markers by motion, after the lag tail is removed where it is large."""

    #: (N, 2, 3) affine maps from pixels to their lag tails, which are removed; None: the blur is too small for that
    to_tails: FloatArray | None
    #: (N, 4, 2) displacement of the corners in the image from their places at the stamp [px]
    shift: FloatArray
    #: (N, 4, 2) part of the displacement that vanishes with the lag tail [px]
    removed: FloatArray
    #: (N, 2) standard deviation of the remaining motion blur, along the motion [px]
    spread: FloatArray
    #: (N, 4, 2) mean displacement by the whole lag [px]
    lag: FloatArray

    @property
    def spread_px(self) -> FloatArray:
        """Standard deviation (N,) of the remaining motion blur [px]."""
        return np.hypot(self.spread[:, 0], self.spread[:, 1])

    @property
    def rolling(self) -> FloatArray:
        """Displacement (N, 4, 2) of the corners by the rolling shutter alone [px]."""
        return self.shift - self.lag + self.removed

    @staticmethod
    def none(count: int) -> 'MotionBlur':
        """Of ``count`` markers at rest."""
        still = np.zeros((count, 4, 2))
        return MotionBlur(None, still, still, still[:, 0], still)


def motion_blur(frame: Frame, places: Places, twist: Twist | None) -> MotionBlur:
    """Motion blur of all markers; lag tails are removed if the largest displacement by lag is not small."""
    lag_blur, rolling = places.lag_blur(twist, frame.lag), rolling_displacement(places, twist, frame)
    mean = lag_blur.mean(axis=1)
    if (lag_blur * lag_blur).sum(axis=-1).max() <= _HARDLY_PX**2:
        return MotionBlur(None, lag_blur + rolling, np.zeros_like(lag_blur), mean, lag_blur)
    shift = REMAINING * lag_blur + rolling
    to_tails = lag_tail_maps(places.points.px + shift, lag_blur)
    return MotionBlur(to_tails, shift, (1.0 - REMAINING) * lag_blur, SPREAD * mean, lag_blur)
