"""The known markers of a frame, and what they say of where the camera is: records of the localization."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from thermal_fiducial.core.error_model import positive
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.mapping.odometry_prior import PredictedCamera
from thermal_fiducial.core.measurements import CameraPose, Markers
from thermal_fiducial.core.types import BoolArray, FloatArray

#: Attitudes known no better than this [rad] are not published: their covariances, of first order, mean nothing.
VAGUE = 0.2


@dataclass(frozen=True)
class Sight:
    """The known markers of one frame, N of them."""

    markers: list[MapMarker]
    #: (N, 4, 2) [px]
    corners: FloatArray
    #: (N, 4, 2, 2) [px^2]
    covariances: FloatArray
    #: (N, 2, 4, 4) both branches of T_camera_marker, NaN where there is none
    branches: FloatArray

    def select(self, chosen: BoolArray) -> 'Sight':
        """The chosen (N,) markers alone."""
        markers = [marker for marker, keep in zip(self.markers, chosen, strict=True) if keep]
        return Sight(markers, self.corners[chosen], self.covariances[chosen], self.branches[chosen])

    @cached_property
    def T_map_marker(self) -> FloatArray:
        """(N, 4, 4)."""
        return np.stack([marker.T_map_marker for marker in self.markers])

    @cached_property
    def sizes(self) -> FloatArray:
        """(N,) [m]."""
        return np.array([marker.size for marker in self.markers])

    @cached_property
    def points(self) -> FloatArray:
        """(N, 4, 3) corners in the map [m]."""
        return corners_in_map(self.T_map_marker, self.sizes)

    @cached_property
    def map_covariances(self) -> FloatArray:
        """(N, 6, 6) of the markers' poses in the map."""
        return np.stack([marker.covariance for marker in self.markers])

    @cached_property
    def relative_covariances(self) -> FloatArray:
        """(N, 6, 6) the same without what the best-known one is uncertain by: the error that all of them share."""
        covariances = self.map_covariances
        best = covariances[np.argmin(np.trace(covariances, axis1=1, axis2=2))]
        return positive(covariances - best)


@dataclass(frozen=True)
class PoseErrors:
    """Covariances (6, 6) of a camera pose, ROS convention, by where its errors come from."""

    #: noise of the corners, new in each frame
    white: FloatArray
    #: the map, the scale, the lens and the bias of the corners: as good as the same in the frames that follow
    systematic: FloatArray
    #: noise, and the map without the error that all markers in view share: how well it is placed among them
    relative: FloatArray
    #: share of the variance of the corners' systematic errors that the residuals show: the pose takes up the rest
    visible: float = 0.0


@dataclass(frozen=True)
class Location:
    """Where the camera is."""

    T_map_camera: FloatArray
    errors: PoseErrors
    #: (N,) weights of the markers, 1 for one as good as the rest
    weights: FloatArray
    #: (N, 4, 2) measured minus predicted [px]
    residuals: FloatArray

    @property
    def rms_px(self) -> float:
        """Re-projection error, rms over the corners [px]."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=-1))))

    @property
    def covariance(self) -> FloatArray:
        """(6, 6), ROS convention, of all errors together."""
        return self.errors.white + self.errors.systematic


@dataclass(frozen=True)
class Refusal:
    """Why nobody knows where the camera is, in words."""

    reason: str
    #: (2, 4, 4) the two poses of an unsettled ambiguity, where it is that, and (2, 6, 6) their covariances
    alternatives: FloatArray | None = None
    covariances: FloatArray | None = None


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
