"""A frame, and what is known of it before anything is found."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.contrast import noise_of, without_columns
from thermal_fiducial.core.detection.lag import LAG_TAIL_AGE
from thermal_fiducial.core.detection.twist import interaction, Twist
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray

# Largest number of gray levels of what is meant for a display.
_LEVELS = 256


@dataclass(frozen=True)
class Frame:
    """An image, and what is known of the camera's motion at its stamp."""

    stamp_ns: int
    counts: Counts | Gray | Float32Array
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
        if counts.dtype == np.uint8 or keep_columns:
            return Frame(stamp_ns, counts, noise, camera, twist, lag, readout, displayed)
        plain = without_columns(counts.astype(np.float32), noise)
        return Frame(stamp_ns, plain, noise, camera, twist, lag, readout, displayed)

    @cached_property
    def image(self) -> Float32Array:
        """As floating-point numbers: a copy that few places of it are not worth."""
        return np.asarray(self.counts, dtype=np.float32)

    @property
    def samples(self) -> Counts | Float32Array:
        """To be looked up in few places, interpolated to whole counts at worst."""
        return np.asarray(self.counts, dtype=np.uint16) if self.counts.dtype == np.uint16 else self.image


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

    def moved(self, at: ImagePoints) -> 'Places':
        """The same some pixels away."""
        return Places(at, self.depth, self.flow)

    def velocity(self, twist: Twist) -> FloatArray:
        """Of the image (N, 4, 2) [px/s]."""
        return np.asarray(self.flow @ twist.value)

    def lag_blur(self, twist: Twist, lag: float) -> FloatArray:
        """Mean displacement (N, 4, 2) [px] by a lag [s]."""
        return np.asarray(-lag * (self.flow @ twist.ago(lag)))

    def lag_tail(self, twist: Twist, lag: float) -> FloatArray:
        """Displacement (N, 4, 2) [px] in so long a time as the lag, as it places the image's lag tail."""
        return np.asarray(-lag * (self.flow @ twist.ago(LAG_TAIL_AGE * lag)))

    def unknown(self, twist: Twist, lag: float) -> FloatArray:
        """Covariances (N, 4, 2, 2) [px^2] of the motion blur by what is unknown of the twist.

        What the corners of a marker have in common is no error of its shape.
        """
        by_twist = lag * (self.flow - 0.25 * self.flow.sum(axis=1, keepdims=True))
        return np.asarray(by_twist @ twist.covariance_ago(lag) @ by_twist.swapaxes(-1, -2))
