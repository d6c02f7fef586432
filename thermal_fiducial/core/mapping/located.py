"""A frame whose camera has been located, or not: what the map has still to learn from it."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.localization import Location, Refusal, Sight
from thermal_fiducial.core.mapping.odometry_prior import PredictedCamera
from thermal_fiducial.core.measurements import CameraPose, Markers
from thermal_fiducial.core.types import BoolArray

#: Attitudes known no better than this [rad] are not published: their covariances, of first order, mean nothing.
VAGUE = 0.2


@dataclass(frozen=True)
class Located:
    """Where the camera was."""

    location: Location
    #: the same for others, with a covariance that allows for what lasts and for the camera's motion
    pose: CameraPose

    @property
    def reason(self) -> str:
        """Why the pose is not published, in words; empty where it is."""
        std = float(np.sqrt(np.trace(self.location.covariance[3:, 3:])))
        listed = ', '.join(str(key) for key in self.pose.marker_ids)
        return f'known to {np.rad2deg(std):.0f} degrees only, by marker {listed}' if std > VAGUE else ''


@dataclass(frozen=True)
class LocatedFrame:
    """Markers of a frame, and what they say of the camera."""

    stamp_ns: int
    camera: Camera
    #: (N,) of MARKER_DTYPE, and (N,) which of them are in the map
    rows: Markers
    is_known: BoolArray
    #: the K known ones, and (K,) which of them are trusted
    known: Sight
    trusted: BoolArray
    #: where odometry has the camera
    predicted: PredictedCamera | None
    outcome: Located | Refusal

    @property
    def new(self) -> Markers:
        """Rows of the markers that are not in the map."""
        return self.rows[~self.is_known]

    @property
    def pose(self) -> CameraPose | None:
        """The pose to publish; None where there is none, or one too vague."""
        return None if isinstance(self.outcome, Refusal) or self.outcome.reason else self.outcome.pose
