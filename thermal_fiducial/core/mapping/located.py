"""Records of localization: the known markers of a frame, their re-projection, and the located frame."""

from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np

from thermal_fiducial.core.error_model import arms_of_scale, drawn_sum, INCONSISTENT_PX, LATE_DRAWS, NO_DRAWS
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map, linearise
from thermal_fiducial.core.geometry.se3 import difference, lever_arm, so3_exp, turn_of_pose
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.mapping.marker_views import Viewpoint
from thermal_fiducial.core.measurements import CameraPose, LATE, Observations, VAGUE
from thermal_fiducial.core.motion_prior import PredictedCamera
from thermal_fiducial.core.two_poses import along_screw
from thermal_fiducial.core.types import BoolArray, FloatArray, Stacked
from thermal_fiducial.core.wording import listed, marker_names

#: Squared Mahalanobis distance (6 d.o.f.) beyond which markers and odometry contradict each other: ten sigma.
CONTRADICTION = 100.0


@dataclass(frozen=True, slots=True)
class Sight(Stacked):
    """The known markers of one frame, N of them."""

    observed: Observations
    #: (N,) standard deviation of a coordinate of the corners of each, rms [px]
    noise_px: FloatArray
    #: (N,) which of them are not in quarantine
    trusted: BoolArray
    #: (N, 4, 3) corners in the map [m]
    points: FloatArray
    #: (N, 4, 4), (N,) [m] and (N, 6, 6): poses, sides and covariances of the markers in the map
    T_map_marker: FloatArray
    sizes: FloatArray
    map_covariances: FloatArray
    #: (N, 3) derivative of their positions by the scale of the map [m]
    scale_arms: FloatArray
    #: (N, 6, K) joint draws of their errors
    draws: FloatArray
    #: (N,) which of them were surveyed one by one: their errors are independent
    surveyed: BoolArray

    @staticmethod
    def of(observed: Observations, marker_map: MarkerMap) -> 'Sight':
        """The observed markers, all in the map, with their entries there."""
        known = [marker_map.markers[key] for key in observed.ids.tolist()]
        sizes = np.array([marker.size for marker in known])
        T_map_marker = np.array([marker.T_map_marker for marker in known]).reshape(-1, 4, 4)
        covariances = np.array([marker.covariance for marker in known]).reshape(-1, 6, 6)
        positions = T_map_marker[:, :3, 3]
        given = not covariances.any()
        return Sight(
            observed,
            np.sqrt(np.einsum('nckk->n', observed.covariances) / 8.0),
            np.array([marker.trusted for marker in known], dtype=np.bool_),
            corners_in_map(T_map_marker, sizes),
            T_map_marker,
            sizes,
            covariances,
            np.zeros_like(positions) if given else arms_of_scale(positions, marker_map.anchors),
            np.array([marker.draws for marker in known]).reshape(-1, *NO_DRAWS.shape),
            np.array([marker.surveyed for marker in known], dtype=np.bool_),
        )

    @property
    def names(self) -> str:
        """The markers, in words."""
        return marker_names(self.observed.ids.tolist())

    def reprojected(self, camera: Camera, T_map_camera: FloatArray) -> 'Reprojected':
        """The map's markers projected into a camera at ``T_map_camera`` (4, 4)."""
        T = np.broadcast_to(T_map_camera, self.T_map_marker.shape)
        uv, J_camera, J_marker = linearise(camera, T, self.T_map_marker, self.sizes)
        return Reprojected(self.observed.corners - uv, J_camera, J_marker)


@dataclass(frozen=True)
class Reprojected:
    """Re-projection of N markers: residuals and Jacobians."""

    #: (N, 4, 2) measured minus predicted [px], NaN behind the camera
    residuals: FloatArray
    #: (N, 8, 6) derivatives of the predictions with respect to the camera's pose and the marker's
    J_camera: FloatArray
    J_marker: FloatArray

    @cached_property
    def errors_px(self) -> FloatArray:
        """Rms error (N,) [px] of each marker; NaN behind the camera."""
        return np.asarray(np.sqrt((self.residuals**2).sum(axis=(1, 2)) / 4.0))


@dataclass(frozen=True)
class Location:
    """A located camera: its pose with covariance, and the linearised fit that it comes from."""

    pose: CameraPose
    #: the N markers of the fit, and their re-projection
    sight: Sight
    reprojection: Reprojected
    #: (N,) their weights, at most 1
    weights: FloatArray
    #: (N, 6, 6) derivative of the pose by the poses of the markers in the map
    map_gains: FloatArray
    #: errors of the lens at the corners (N, 4)
    lens: LensErrors
    #: by which the variance of the corners is scaled up
    noise_factor: float
    #: (6, 6) part of the covariance by noise of the corners, and (6,) the error by one standard deviation of the sides
    noise: FloatArray
    of_sides: FloatArray
    #: (4 N, 6, 2) derivative of the pose by each corner [1/px]
    corner_gains: FloatArray
    #: whether no other pose is possible
    settled: bool = True

    @property
    def compared(self) -> tuple[Sight, Reprojected]:
        """The markers, re-projected."""
        return self.sight, self.reprojection

    @property
    def rotation_std(self) -> float:
        """Standard deviation of the attitude [rad]."""
        return math.sqrt(self.pose.covariance[3:, 3:].trace())

    def unsettled(self, spread: FloatArray) -> 'Location':
        """The location, which may be another one, at a covariance that is larger by ``spread`` (6, 6)."""
        return replace(self, pose=self.pose.widened(spread), noise=self.noise + spread, settled=False)

    def moved(self, step: FloatArray, unknown: FloatArray) -> 'Location':
        """The location displaced by ``step`` (6,) along a screw, with what is ``unknown`` (6, 6) of it beside."""
        pose = along_screw(self.pose, step, self.pose.covariance - self.pose.map_covariance + unknown)
        with_camera = turn_of_pose(so3_exp(step[3:]))
        return replace(
            self,
            pose=pose,
            map_gains=lever_arm(pose.T_map_camera[:3, 3] - self.pose.T_map_camera[:3, 3]) @ self.map_gains,
            noise=with_camera @ (self.noise + unknown) @ with_camera.T,
            of_sides=with_camera @ self.of_sides,
            corner_gains=with_camera @ self.corner_gains,
        )

    @property
    def viewpoint(self) -> Viewpoint:
        """The camera as viewpoint of new markers: all but its noise is common to all views."""
        draws = self.lens.drawn_sum(self.corner_gains) + drawn_sum(self.map_gains, self.sight.draws)
        draws += drawn_sum(self.corner_gains, self.sight.observed.late_px.reshape(-1, 2, LATE)) @ LATE_DRAWS
        return Viewpoint.known(self.pose.T_map_camera, self.noise, draws, self.of_sides)


@dataclass(frozen=True)
class MisplacedMarker:
    """A marker that, alone in view, is not where the map and odometry have it: moved, or a second plate of its ID."""

    id: int
    #: stamp of the first such frame
    since_ns: int
    #: (4, 4) with T_map_camera by the marker = T_moved @ T_map_camera by odometry, in the first such frame
    T_moved: FloatArray
    #: between the marker and its place in the map [m], and its turn from there [rad]
    distance: float
    angle: float

    @property
    def reason(self) -> str:
        """Why there is no pose from it, in words."""
        apart = f'{self.distance:.1f} m, {math.degrees(self.angle):.0f} deg'
        return f'marker {self.id} alone is {apart} from its place: moved, or a second one of its ID?'


@dataclass(frozen=True)
class Refusal:
    """The reason, in words, for which a frame has no pose, or one of two."""

    reason: str
    #: where the reason is the planar ambiguity: the two possible poses, and one vague in the turn between them
    viewpoint: Viewpoint | None = None
    pose: CameraPose | None = None
    #: where that is the reason
    misplaced: MisplacedMarker | None = None
    #: where a pose was found that is not published alone: the markers re-projected at it, NaN behind the camera
    compared: tuple[Sight, Reprojected] | None = None


@dataclass(frozen=True)
class LocatedFrame:
    """Markers of a frame with the result of localization."""

    stamp_ns: int
    camera: Camera
    #: all N markers, as the detector has them, and without what is estimated of an undeclared readout and of the lens
    raw: Observations
    observed: Observations
    #: which (N,) are in the map, and these
    is_known: BoolArray
    known: Sight
    #: the camera pose by odometry
    predicted: PredictedCamera | None
    outcome: Location | Refusal
    #: whether most markers contradict the map
    contradicts_map: bool = False

    @property
    def pose(self) -> CameraPose | None:
        """To publish; None without one, from a contradicted map, or if its attitude is too uncertain."""
        withheld = self.contradicts_map or (self.reason and isinstance(self.outcome, Location))
        return None if withheld else self.outcome.pose

    @cached_property
    def reason(self) -> str:
        """Why there is no pose to publish, or one of two, in words; else empty."""
        if self.contradicts_map:
            return 'most markers contradict the map'
        if isinstance(self.outcome, Refusal):
            return self.outcome.reason
        std = self.outcome.rotation_std
        if self.predicted is not None or std <= VAGUE:
            return ''
        return f'known to {math.degrees(std):.0f} degrees only, by marker {listed(self.outcome.pose.marker_ids)}'

    @property
    def new(self) -> Observations:
        """The markers that are not in the map."""
        return self.observed.only(~self.is_known)

    @cached_property
    def contradicts_odometry(self) -> bool:
        """Whether pose and odometry contradict each other."""
        if self.predicted is None or isinstance(self.outcome, Refusal):
            return False
        return squared_distance(self.outcome.pose, self.predicted.pose) > CONTRADICTION

    @cached_property
    def known_errors(self) -> tuple[FloatArray, FloatArray]:
        """Rms errors (K,) [px] of the K known markers, and their standard deviations (K,) by noise, pose and map.

        That of a marker behind the camera is the image's width, and so is any larger one. NaN without a location.
        """
        known, location = self.known, self.outcome
        if isinstance(location, Refusal):
            return np.full(len(known.sizes), np.nan), np.full(len(known.sizes), np.nan)
        pose = location.pose
        reprojection = (
            location.reprojection if location.sight is known else known.reprojected(self.camera, pose.T_map_camera)
        )
        errors = np.fmin(reprojection.errors_px, float(self.camera.width))
        return errors, error_std_px(known, reprojection, pose.covariance)


def squared_distance(pose: CameraPose, predicted: CameraPose) -> float:
    """Squared Mahalanobis distance, six degrees of freedom, of two independent poses of a camera."""
    apart = difference(predicted.T_map_camera, pose.T_map_camera)
    return float(apart @ np.linalg.solve(pose.covariance + predicted.covariance, apart))


def error_std_px(sight: Sight, reprojection: Reprojected, camera_covariance: FloatArray) -> FloatArray:
    """Standard deviations (N,) of the rms re-projection errors [px] by noise, map and a camera known to (6, 6)."""
    by_camera = np.einsum('nri,nri->n', reprojection.J_camera @ camera_covariance, reprojection.J_camera)
    by_marker = np.einsum('nri,nri->n', reprojection.J_marker @ sight.map_covariances, reprojection.J_marker)
    variances = 2.0 * sight.noise_px**2 + np.nan_to_num(by_camera + by_marker) / 4.0 + INCONSISTENT_PX**2
    return np.asarray(np.sqrt(variances))


def not_taken_up(directions: FloatArray, errors: FloatArray) -> FloatArray:
    """``errors`` (n, ...) without their parts along orthonormal ``directions`` (n, 6), which a pose takes up."""
    return np.asarray(errors - directions @ (directions.T @ errors))
