"""A frame, and what is known of it before anything is found."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from thermal_fiducial.core.detection.lag import MEMORY_AGE
from thermal_fiducial.core.detection.motion import interaction, Twist
from thermal_fiducial.core.detection.scratch import Scratch
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray


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
    #: for the image
    scratch: Scratch = field(default_factory=Scratch)

    @cached_property
    def image(self) -> Float32Array:
        """As floating-point numbers: a copy that few places of it are not worth."""
        if self.counts.dtype == np.float32:
            return np.asarray(self.counts, dtype=np.float32)
        image = self.scratch.floats('image', self.counts.shape)
        np.copyto(image, self.counts)
        return image

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

    def smear(self, twist: Twist, lag: float) -> FloatArray:
        """Mean displacement (N, 4, 2) [px] by a lag [s]."""
        return np.asarray(-lag * (self.flow @ twist.ago(lag)))

    def memory(self, twist: Twist, lag: float) -> FloatArray:
        """Displacement (N, 4, 2) [px] in so long a time as the lag, as it places the image's memory of the past."""
        return np.asarray(-lag * (self.flow @ twist.ago(MEMORY_AGE * lag)))

    def unknown(self, twist: Twist, lag: float) -> FloatArray:
        """Covariances (N, 4, 2, 2) [px^2] of the smear by what is unknown of the twist.

        What the corners of a marker have in common is no error of its shape.
        """
        by_twist = lag * (self.flow - 0.25 * self.flow.sum(axis=1, keepdims=True))
        return np.asarray(by_twist @ twist.covariance_ago(lag) @ by_twist.swapaxes(-1, -2))
