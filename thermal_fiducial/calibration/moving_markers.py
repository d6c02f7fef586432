"""Views of markers that move, with the motion of their corners in the image.

Velocities are taken from the corners as they are in the images: with a rolling shutter they move by as much as the
pattern moves past a pixel, and they are late as the pattern is. So neither calibration nor clocks matter, nor places.
"""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.blurred_patterns import lens_bends
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.core.types import Counts, FloatArray, Gray, SECOND_NS
from thermal_fiducial.errors import InputError

#: Lag that is usual [s].
USUAL_LAG_S = ArucoDetectorConfig.bolometer_lag
# Gray levels of pictures for a display: their gain control bends counts, and tails with them.
_LEVELS = 256
# Frames that a velocity is taken from, weights of corners in it by all and by the middle three, and share of it that
# these may differ by: of a sine, that of five frames is off by a third of the square of that share.
_FRAMES, _UNEVEN = 5, 0.1
_BY_FIVE = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12.0
_BY_THREE = np.array([0.0, -0.5, 0.0, 0.5, 0.0])
# Weights of corners in their acceleration, and share of the velocity that it may change by in the usual lag: how late
# corners are is known to half of that lag.
_CHANGE, _UNSTEADY = np.array([0.0, 1.0, -2.0, 1.0, 0.0]), 0.05
# Difference of intervals between frames, as a share, beyond which a frame is missing.
_IRREGULAR = 0.3
# Range of motion that is of use for some lag [px/s].
_SPEEDS = 60.0, 600.0
# Most views, which a minute has.
_MOST = 1000
# Room around a marker beside half a cell: for tails, and for interpolation [px].
_MARGIN_PX = 8.0


class DetectedFrame(NamedTuple):
    """Raw counts with the markers in them, whose corners are where they are in the image."""

    stamp_ns: int
    counts: Counts | Gray
    rows: Markers


class MovingMarker(NamedTuple):
    """A view of a marker that moves."""

    marker_id: int
    #: (height, width) the part of the image around it
    counts: Counts | Gray
    #: (4, 2) in it [px], and their velocities [px/s]
    corners_px: FloatArray
    velocity: FloatArray
    #: (1, 2, 16) of :func:`lens_bends`
    bends: FloatArray

    @property
    def speed(self) -> float:
        """Of its middle [px/s]."""
        return _length(self.velocity)


def moving_markers(frames: Iterable[DetectedFrame], camera: Camera, cells: int) -> Iterator[MovingMarker]:
    """Of each frame, up to a thousand, the largest marker of m x m ``cells`` that moves evenly.

    Raises
    ------
    InputError
        Pictures of 8 bits.
    """
    last: deque[DetectedFrame] = deque(maxlen=_FRAMES)
    kept = 0
    for number, frame in enumerate(frames):
        if number == 0 and frame.counts.max() < _LEVELS:
            raise InputError('pictures of 8 bits, whose gray levels are no counts: record raw counts (mono16)')
        last.append(frame)
        view = _largest(list(last), camera, cells) if len(last) == _FRAMES else None
        if view is not None:
            yield view
            kept += 1
        if kept == _MOST:
            break


def _largest(frames: Sequence[DetectedFrame], camera: Camera, cells: int) -> MovingMarker | None:
    """The largest marker that moves evenly over five frames, in the middle one; None: there is none."""
    seconds = np.array([(frame.stamp_ns - frames[0].stamp_ns) / SECOND_NS for frame in frames])
    period = float(seconds[-1]) / (_FRAMES - 1)
    if not np.abs(np.diff(seconds) - period).max() < _IRREGULAR * period:
        return None
    corners = [dict(zip(frame.rows['id'].tolist(), corners_px(frame.rows), strict=True)) for frame in frames]
    middle = corners[_FRAMES // 2]
    common = set(middle).intersection(*corners)
    for marker_id in sorted(common, key=lambda key: -float(sides_px(middle[key][None])[0])):
        velocity = _velocity(np.stack([there[marker_id] for there in corners]), period)
        if velocity is not None:
            return _cut_out(frames[_FRAMES // 2], marker_id, middle[marker_id], velocity, camera, cells)
    return None


def _velocity(track: FloatArray, period: float) -> FloatArray | None:
    """Velocities (4, 2) [px/s] of corners in five frames (5, 4, 2); None: uneven, too slow or too fast."""
    velocity, of_three = (np.tensordot(weights, track, 1) / period for weights in (_BY_FIVE, _BY_THREE))
    change = np.tensordot(_CHANGE, track, 1) * (USUAL_LAG_S / period**2)
    speed = _length(velocity)
    even = _length(velocity - of_three) < _UNEVEN * speed and _length(change) < _UNSTEADY * speed
    return np.asarray(velocity) if even and _SPEEDS[0] < speed < _SPEEDS[1] else None


def _length(of_corners: FloatArray) -> float:
    """Length of the mean of vectors (4, 2)."""
    return float(np.hypot(*of_corners.mean(axis=0)))


def _cut_out(
    frame: DetectedFrame, marker_id: int, corners: FloatArray, velocity: FloatArray, camera: Camera, cells: int
) -> MovingMarker | None:
    """A view of a marker; None where the image ends."""
    margin = 0.5 * float(sides_px(corners[None])[0]) / cells + _MARGIN_PX
    low = np.floor(corners.min(axis=0) - margin).astype(np.int64)
    high = np.ceil(corners.max(axis=0) + margin).astype(np.int64) + 1
    if low.min() < 0 or np.any(high > frame.counts.shape[::-1]):
        return None
    # A copy: a part would keep the whole image in memory.
    counts = frame.counts[low[1] : high[1], low[0] : high[0]].copy()
    return MovingMarker(
        marker_id, counts, corners - low, velocity, lens_bends(ImagePoints.at(corners[None], camera), camera)
    )
