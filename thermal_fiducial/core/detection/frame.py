"""A frame, and how what is seen in it moves: what is known before anything is found.

The rows of a bolometer array are sampled one after the other. The stamp is that of the middle row; row v is seen d
later, and what moves is carried on as far by then. Under constant motion that is an affine map of the image: straight
sides stay straight, and shifts of the corners say it all.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.lag import LAG_TAIL_AGE
from thermal_fiducial.core.detection.quads import noise_of, without_columns
from thermal_fiducial.core.detection.twist import interaction, Twist
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray

# Largest number of gray levels of what is meant for a display.
_LEVELS = 256


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
        noise, displayed = noise_of(counts), bool(counts[::64].max() < _LEVELS)
        lag, readout = config.bolometer_lag, config.readout_time
        image = counts.astype(np.float32)
        if counts.dtype != np.uint8 and not keep_columns:
            image = without_columns(image, noise)
        return Frame(stamp_ns, image, noise, camera, twist, lag, readout, displayed)


@dataclass(frozen=True, slots=True)
class Places:
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

    def only(self, keep: BoolArray | IntArray) -> 'Places':
        """Those of the markers ``keep``."""
        return Places(self.at.only(keep), self.depth[keep], self.flow[keep])

    def joined(self, others: 'Places') -> 'Places':
        """Those of ``others`` as well."""
        one, other = self.at, others.at
        pairs = (one.px, other.px), (one.x, other.x), (one.J, other.J), (one.inverse, other.inverse)
        at = ImagePoints(*(np.concatenate(pair) for pair in pairs))
        depth, flow = np.concatenate([self.depth, others.depth]), np.concatenate([self.flow, others.flow])
        return Places(at, depth, flow)

    def lag_blur(self, twist: Twist, lag: float) -> FloatArray:
        """Mean displacement (N, 4, 2) [px] by a lag [s]."""
        return np.asarray(-lag * (self.flow @ twist.ago(lag)))

    def unknown(self, twist: Twist, lag: float) -> FloatArray:
        """Covariances (N, 4, 2, 2) [px^2] of the motion blur by what is unknown of the twist.

        What the corners of a marker have in common is no error of its shape.
        """
        by_twist = lag * (self.flow - 0.25 * self.flow.sum(axis=1, keepdims=True))
        return np.asarray(by_twist @ twist.covariance_ago(lag) @ by_twist.swapaxes(-1, -2))


def delays(rows: FloatArray, frame: Frame) -> FloatArray:
    """How long after the stamp ``rows`` (...) are seen [s]."""
    return frame.readout * (rows / (frame.camera.height - 1) - 0.5)


def stretch(places: Places, twist: Twist, frame: Frame) -> FloatArray:
    """How much longer (N, 4) ways in the image are for what runs with the read-out, or shorter against it."""
    velocity = places.flow @ twist.value
    return np.asarray(1.0 / (1.0 - frame.readout / (frame.camera.height - 1) * velocity[..., 1]))


def lag_tail(places: Places, twist: Twist, frame: Frame) -> FloatArray:
    """Displacement (N, 4, 2) [px] in so long a time as the lag, as it places the image's lag tail."""
    still: FloatArray = np.asarray(-frame.lag * (places.flow @ twist.ago(LAG_TAIL_AGE * frame.lag)))
    return still * stretch(places, twist, frame)[..., None] if frame.readout > 0.0 else still


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
