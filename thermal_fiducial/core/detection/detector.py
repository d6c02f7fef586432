"""Markers of a frame: predicted, found, refined, confirmed, both poses of each."""

from collections.abc import Collection, Mapping
from dataclasses import replace
import math

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig, size_overrides
from thermal_fiducial.core.detection.confirmation import confirmed
from thermal_fiducial.core.detection.corners.focus import Focus, shown_blur
from thermal_fiducial.core.detection.corners.gray_scale import GrayScale
from thermal_fiducial.core.detection.corners.refining import refine, RefinedMarkers
from thermal_fiducial.core.detection.finding.finder import FrameHistory, MarkerFinder
from thermal_fiducial.core.detection.partial.partial_markers import PartialMarkerSearch
from thermal_fiducial.core.detection.patterns import Decoder, Dictionary
from thermal_fiducial.core.detection.prediction.frame import Frame
from thermal_fiducial.core.detection.prediction.known_markers import (
    among,
    depths,
    ExpectedMarkers,
    FoundMarkers,
    KnownMarkers,
)
from thermal_fiducial.core.detection.prediction.tracking import Guide, MotionTrack, predict_frame
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.planar_pose import choose_branches, planar_poses, PlanarPoses, solve_marker_poses
from thermal_fiducial.core.geometry.reprojection import corners_of_faces
from thermal_fiducial.core.measurements import marker_rows, Markers, whole_ns
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.types import Counts, FloatArray, Gray, IntArray

# Contrast-to-noise ratio beyond which the array's column pattern does not displace sides.
_CLEARER_THAN_COLUMNS = 100.0
# Known markers wholly in view from which on partially visible ones would not improve the pose.
_ENOUGH_WHOLE = 2


class MarkerDetector:
    """Finds the markers of a dictionary in clean frames.

    Parameters
    ----------
    config : parameters; may be replaced while running
    dictionary : of the markers
    """

    def __init__(self, config: ArucoDetectorConfig, dictionary: Dictionary) -> None:
        self.config = config
        bits = dictionary.bits
        self._decoder = decoder = Decoder(bits, dictionary.correctable)
        overrides = size_overrides(config.marker_size_overrides)
        self._sizes = np.array([overrides.get(key, config.marker_size) for key in range(decoder.count)])
        self._finder = MarkerFinder(decoder)
        self._partial = PartialMarkerSearch(decoder, bits)
        self._known = KnownMarkers({}, self._sizes)
        self._mount(config)

    def configure(self, config: ArucoDetectorConfig) -> None:
        """Take over the dynamic parameters of ``config``, and the pose of the camera on the robot."""
        before, self.config = self.config, config
        if (config.camera_position, config.camera_orientation) != (before.camera_position, before.camera_orientation):
            self._mount(config)

    def _mount(self, config: ArucoDetectorConfig) -> None:
        track = MotionTrack(se3.camera_in_body(config), config.bolometer_lag)
        self._history = FrameHistory(track, Focus.as_declared(config.blur_px))

    def set_map(
        self, marker_map: Mapping[int, tuple[FloatArray, float]], quarantined: Collection[int] = frozenset()
    ) -> None:
        """Set the known markers: ID to (T_map_marker, side [m]), and the IDs that are not expected at their places."""
        self._known = KnownMarkers(marker_map, self._sizes, quarantined)

    @property
    def focus(self) -> Focus:
        """Of the camera, as far as markers have shown it."""
        return self._history.focus

    def size(self, marker_id: int) -> float:
        """Side of a marker [m]: from the map, else from the overrides, else the common one."""
        return float(self._known.sizes[marker_id])

    def detect(self, stamp_ns: int, counts: Counts | Gray, camera: Camera, prior: MotionPrior | None = None) -> Markers:
        """Markers of one frame, sorted by ID; an empty array when there are none.

        Parameters
        ----------
        stamp_ns : of the frame
        counts : (height, width), clean
        camera : its intrinsics
        prior : the filter's latest odometry and clock offset, if available

        Raises
        ------
        InputError
            The calibration is of another image size, the image is none, or its stamp is not an integer.
        """
        stamp_ns = whole_ns(stamp_ns, 'image')
        camera.require_size_of(counts)
        config, known, history = self.config, self._known, self._history
        twist, by_odometry = predict_frame(stamp_ns, prior, history.track, config.time_offset_std)
        guide = by_odometry if config.guided and len(known.ids) else None
        T_camera_map = None if by_odometry is None else by_odometry.T_camera_map
        keep_columns = history.track.all_clearer_than(_CLEARER_THAN_COLUMNS)
        frame = Frame.of(stamp_ns, counts, camera, twist, config, history.focus.blur_px, keep_columns=keep_columns)
        found, history = self._finder.find(frame, history, known, guide, config)
        refined, gray_scale = self._refined(frame, found, history)
        if len(found.ids) > 1 and not len(refined.ids) and refined.blur.to_tails is not None:
            # A filter that diverges, as with an IMU in degrees, has motion blur taken out of images that have none. A
            # single faint marker may be refuted by chance.
            unmoved = replace(frame, twist=None)
            again, other_scale = self._refined(unmoved, found, history)
            if len(again.ids):
                frame, guide, T_camera_map, refined, gray_scale = unmoved, None, None, again, other_scale
        ids, corners, points = refined.ids, refined.corners, refined.places.points
        poses = self._poses(ids, corners.covariances, points, T_camera_map)
        if config.plate_thickness > 0.0:
            points = corners_of_faces(points, poses.T_camera_marker[:, 0], known.sizes[ids], config.plate_thickness)
            poses = self._poses(ids, corners.covariances, points, T_camera_map)
        rows = marker_rows(ids, points.px, corners.covariances, poses, corners.contrast)
        if guide is not None and among(ids, known.ids).sum() < _ENOUGH_WHOLE:
            rows = self._with_partial(rows, frame, gray_scale, guide)
        # A twist by corners of which none was confirmed as a marker's is dropped.
        twist = refined.twist if len(ids) else frame.twist
        depth = depths(poses.T_camera_marker[:, 0], known.sizes[ids])
        markers = ExpectedMarkers(ids, refined.places.points.x, depth, corners.contrast / frame.noise)
        focus = self._focus(frame, refined, history.focus)
        self._history = history.after(stamp_ns, twist, markers, focus, gray_scale, saw_partial=len(rows) > len(ids))
        return rows

    def _refined(self, frame: Frame, found: FoundMarkers, history: FrameHistory) -> tuple[RefinedMarkers, GrayScale]:
        """Those of the markers ``found`` that are confirmed at their refined corners, and the gray scale."""
        refined, gray_scale = refine(frame, found, history.track, history.gray_scale, self._decoder)
        return confirmed(frame, found, refined, self._decoder, self.config), gray_scale

    def _focus(self, frame: Frame, refined: RefinedMarkers, focus: Focus) -> Focus:
        """The ``focus`` with what the markers of a frame show of it, where its motion and its gray scale are known."""
        if frame.displayed or refined.twist is None or not focus.due(frame.stamp_ns):
            return focus
        whole = refined.only(~refined.corners.small)
        if len(whole.ids) == 0:
            return focus
        corners = whole.places.points.at_pixels(whole.observed.corners_px)
        return focus.after(frame.stamp_ns, shown_blur(frame, corners, whole.blur, self._decoder.cells))

    def _poses(
        self, ids: IntArray, covariances: FloatArray, points: ImagePoints, T_camera_map: FloatArray | None
    ) -> PlanarPoses:
        """Both planar poses of each marker, the likelier first."""
        sizes = self._known.sizes[ids]
        poses = planar_poses(points, covariances, sizes)
        return choose_branches(poses, points, covariances, sizes, self._known.T_map_marker[ids], T_camera_map)

    def _with_partial(self, rows: Markers, frame: Frame, gray_scale: GrayScale, guide: Guide) -> Markers:
        """The rows of whole markers, and those of known ones that are partially visible from the ``guide``."""
        found_ids = rows['id'].astype(np.int64)
        candidates = self._known.partially_visible(guide.T_camera_map, frame.camera, found_ids)
        position_std_m = math.sqrt(np.trace(guide.covariance[:3, :3]))
        ids, corners = self._partial.find(frame, gray_scale, candidates, position_std_m, self.config)
        if len(ids) == 0:
            return rows
        points = ImagePoints.at(corners.corners_px, frame.camera)
        poses = self._poses(ids, corners.covariances, points, guide.T_camera_map)
        partial = marker_rows(ids, points.px, corners.covariances, poses, corners.contrast)
        rows = np.concatenate([rows, partial])
        return np.asarray(rows[np.argsort(rows['id'], kind='stable')])


def rows_from_corners(
    ids: IntArray, corners: FloatArray, covariances: FloatArray, sizes: FloatArray, camera: Camera
) -> Markers:
    """Rows (N,) of MARKER_DTYPE by rising ID of markers known by their corners alone, as in a file of detections.

    Parameters
    ----------
    ids, sizes : (N,), (N,) [m]
    corners, covariances : (N, 4, 2) [px], (N, 4, 2, 2) [px^2]
    """
    return marker_rows(ids, corners, covariances, solve_marker_poses(corners, covariances, sizes, camera))
