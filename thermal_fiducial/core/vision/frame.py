"""A frame, and what is known of it before anything is found."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray
from thermal_fiducial.core.vision.lag import MEMORY_AGE
from thermal_fiducial.core.vision.motion import interaction, Twist


@dataclass(frozen=True, slots=True)
class Frame:
    """An image, and what is known of the camera's motion at its stamp."""

    stamp_ns: int
    image: Float32Array
    #: standard deviation of a pixel [counts]
    noise: float
    camera: Camera
    twist: Twist | None
    #: time constant of the bolometers, and time from the first row's sampling to the last's [s]
    lag: float
    readout: float


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

    def velocity(self, twist: Twist) -> FloatArray:
        """Of the image (N, 4, 2) [px/s]."""
        return np.asarray(self.flow @ twist.value)

    def smear(self, twist: Twist, lag: float) -> FloatArray:
        """Mean displacement (N, 4, 2) [px] by a lag [s]."""
        return np.asarray(-lag * (self.flow @ twist.ago(lag)))

    def memory(self, twist: Twist, lag: float) -> FloatArray:
        """Displacement (N, 4, 2) [px] in so long a time as the lag, as it places the image's memory of the past."""
        return np.asarray(-lag * (self.flow @ twist.ago(MEMORY_AGE * lag)))
