"""Markers of a frame: found, identified, their corners refined, both poses of each."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig, size_overrides
from thermal_fiducial.core.detection.contrast import noise_of, without_columns
from thermal_fiducial.core.detection.corners.edges import edges_behind
from thermal_fiducial.core.detection.corners.refinement import RefinedCorners
from thermal_fiducial.core.detection.decoding import Decoder
from thermal_fiducial.core.detection.displayed import DisplayedSides, for_display
from thermal_fiducial.core.detection.following import Followed
from thermal_fiducial.core.detection.frame import Frame, Places
from thermal_fiducial.core.detection.guided import Expected, KnownMarkers, look
from thermal_fiducial.core.detection.ids import among, pairs
from thermal_fiducial.core.detection.lag import markers_sharpened, REMAINING, SmearField, without_lag
from thermal_fiducial.core.detection.local_corners import local_corners
from thermal_fiducial.core.detection.marker_rows import marker_rows
from thermal_fiducial.core.detection.motion import MotionTracker, Tracked, Twist
from thermal_fiducial.core.detection.partial import CutMarkerSearch
from thermal_fiducial.core.detection.patterns import marker_bits
from thermal_fiducial.core.detection.polarity import Polarity
from thermal_fiducial.core.detection.prediction import Predictor
from thermal_fiducial.core.detection.readout import expected_displacement, seen_displacement
from thermal_fiducial.core.detection.refining import (
    Refinement,
    Refiner,
    sides_px,
    SMEAR_THAT_MATTERS_PX,
    WINDOW_MARGIN_PX,
)
from thermal_fiducial.core.detection.scratch import Scratch
from thermal_fiducial.core.detection.search import BlindSearch, confirmed, Found, merged, Sought
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.planar_pose import (
    choose_branches,
    ippe_square,
    marker_corners,
    planar_poses,
    PlanarPoses,
)
from thermal_fiducial.core.measurements import MARKER_DTYPE, Markers
from thermal_fiducial.core.motion_prior import MotionPrior
from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray

# Smear by lag below which the search misses nothing [px].
_SMEAR_THAT_HIDES_PX = 2.0
# Share of the map's expected markers that, seen, shows that the prediction holds.
_ENOUGH = 0.5
# Contrast over noise beyond which the column pattern of the array displaces no side.
_CLEARER_THAN_COLUMNS = 100.0
# Contrast over noise beyond which a marker shows at full and at half the resolution.
_CLEAR = 20.0
# Nearer to the rim of the image than this a marker is not expected to be seen, or may be cut off [px].
_RIM_PX = 2.0
# So many known markers wholly in view tell the pose so well that those which the rim cuts are not worth a look.
_ENOUGH_WHOLE = 2
# A marker that was read off its corners by less than this need not be read again [cells].
_READ_THERE = 0.1
# Where not all markers are known, or not all seen that should be, a blind search follows at least every so many frames.
_INCOMPLETE = 2
# Corners of a marker of side 1 in its plane.
_FACE = marker_corners(1.0)[:, :2]
_NONE_FOUND, _NONE_FOLLOWED = Found.none(), Followed.none()
# Depth of the scene while no marker has told it [m].
_TYPICAL_DEPTH = 3.0


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV on one thread inside: at this image size threads cost more than they give."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


class MarkerDetector:
    """Finds the markers of a dictionary in clean frames.

    Parameters
    ----------
    config : parameters; may be replaced while running
    dictionary : of the markers
    """

    def __init__(self, config: ArucoDetectorConfig, dictionary: cv2.aruco.Dictionary) -> None:
        self.config = config
        self._sizes = size_overrides(config.marker_size_overrides)
        bits = marker_bits(dictionary)
        self._decoder = Decoder(bits, int(dictionary.maxCorrectionBits))
        T_body_camera = se3.transform(se3.rotation_from_quaternion(config.camera_orientation), config.camera_position)
        self._motion = MotionTracker(T_body_camera, config.bolometer_lag)
        self._predictor = Predictor(T_body_camera, config.bolometer_lag)
        self._scratch = Scratch()
        self._refiner = Refiner(edges_behind(bits), self._motion)
        self._displayed = DisplayedSides(bits)
        self._search = BlindSearch(self._decoder, self._scratch)
        self._cut = CutMarkerSearch(self._decoder, bits)
        self._polarity = Polarity()
        self._field: SmearField | None = None
        self._depth = _TYPICAL_DEPTH
        self._map: dict[int, tuple[FloatArray, float]] = {}
        self._known = KnownMarkers(self._map)
        self._since_blind = 0
        self._sought = Sought.ALL
        self._saw_cut = False

    def set_map(self, marker_map: Mapping[int, tuple[FloatArray, float]]) -> None:
        """Markers that are known: ID to (T_map_marker, side [m])."""
        count = self._decoder.count
        self._map = {marker_id: entry for marker_id, entry in marker_map.items() if 0 <= marker_id < count}
        self._known = KnownMarkers(self._map)

    def detect(
        self, stamp_ns: int, counts: Counts | Gray, camera: Camera, odometry: MotionPrior | None = None
    ) -> Markers:
        """Markers of one frame, sorted by ID; an empty array when there are none.

        Parameters
        ----------
        stamp_ns : of the frame
        counts : (height, width), clean
        camera : its intrinsics
        odometry : the filter's latest states and the offset of its clock, where there are any
        """
        with one_thread():
            prediction = self._predictor.predict(stamp_ns, odometry, self._motion, self.config.max_odometry_age)
            twist, T_camera_map = prediction.twist, prediction.T_camera_map if self._map else None
            frame = self._frame(stamp_ns, counts, camera, twist)
            in_map = None
            if T_camera_map is not None and self.config.guided:
                in_map = self._known.expected(T_camera_map, camera, self.config.min_side_px)
            found, followed = self._find(frame, in_map)
            whole = np.zeros(0, dtype=MARKER_DTYPE)
            if len(found.ids) == 0:
                self._motion.remember(stamp_ns, twist, Tracked.none())
                self._polarity.learn(np.zeros(0))
            else:
                whole = self._whole(counts, frame, found, followed, in_map, T_camera_map)
            self._saw_cut = False
            if in_map is None or T_camera_map is None:
                return whole
            return self._with_cut(whole, counts, frame, T_camera_map, prediction.position_std_m)

    def _whole(
        self,
        counts: Counts | Gray,
        frame: Frame,
        found: Found,
        followed: Followed,
        in_map: Expected | None,
        T_camera_map: FloatArray | None,
    ) -> Markers:
        """Rows of the markers that were found, refined."""
        ids, refinement = self._refined(frame, found, followed, in_map)
        corners, at = refinement.corners, refinement.places.at
        if self.config.refinement == 'subpix' or (self.config.refinement == 'auto' and counts.dtype == np.uint8):
            corners = local_corners(frame.image, corners, self._decoder.cells)
            at = ImagePoints.at(corners.corners_px, frame.camera)
        elif for_display(counts):
            corners = self._displayed.corrected(frame, ids, refinement, self.config.blur_px)
            at = ImagePoints.at(corners.corners_px, frame.camera)
        poses = self._poses(ids, corners, at, T_camera_map)
        self._remember(frame, ids, refinement, poses)
        return marker_rows(ids, corners.corners_px, corners.covariances, poses, corners.contrast)

    def _with_cut(
        self,
        whole: Markers,
        counts: Counts | Gray,
        frame: Frame,
        T_camera_map: FloatArray,
        position_std_m: float,
    ) -> Markers:
        """The rows of ``whole`` markers; where few of them are known, those of known ones that are cut as well."""
        seen = whole['id'].astype(np.int64)
        if among(seen, self._known.ids).sum() >= _ENOUGH_WHOLE:
            return whole
        cut = self._known.cut(T_camera_map, frame.camera, seen)
        ids, corners = self._cut.look(
            frame, cut, position_std_m, self._allowed(), self.config, bent=for_display(counts)
        )
        self._saw_cut = len(ids) > 0
        if not self._saw_cut:
            return whole
        poses = self._poses(ids, corners, ImagePoints.at(corners.corners_px, frame.camera), T_camera_map)
        rows = marker_rows(ids, corners.corners_px, corners.covariances, poses, corners.contrast)
        rows = np.concatenate([whole, rows])
        return np.asarray(rows[np.argsort(rows['id'], kind='stable')])

    def size(self, marker_id: int) -> float:
        """Side of a marker [m]: of the map, or of the overrides, or the common one."""
        if marker_id in self._map:
            return self._map[marker_id][1]
        return self._sizes.get(marker_id, self.config.marker_size)

    def _frame(self, stamp_ns: int, counts: Counts | Gray, camera: Camera, twist: Twist | None) -> Frame:
        """The frame, without the pattern of columns where that matters."""
        noise = noise_of(counts)
        frame = Frame(
            stamp_ns, counts, noise, camera, twist, self.config.bolometer_lag, self.config.readout_time, self._scratch
        )
        if counts.dtype != np.uint8 and not self._motion.all_clearer_than(_CLEARER_THAN_COLUMNS):
            return replace(frame, counts=without_columns(frame.image, noise, self._scratch))
        return frame

    def _find(self, frame: Frame, in_map: Expected | None) -> tuple[Found, Followed]:
        """Markers where they should be, and whatever a blind search shows, when that is due; and which are followed."""
        expected, followed, complete, holds = _NONE_FOUND, _NONE_FOLLOWED, False, False
        if frame.twist is not None and self.config.guided:
            last = Followed.of(self._motion.expected(frame.stamp_ns, frame.twist), frame)
            ids, corners, _, depth = self._expected(frame.camera, last, in_map)
            followed = last.only(among(last.ids, ids)).seen(frame, frame.twist, self._decoder, self.config)
            expected = followed.found()
            new = ~among(ids, followed.ids)
            if new.any():
                corners = corners + _common_shift(ids, corners, expected)
                expected = merged(expected, self._guided(frame, frame.twist, ids[new], corners[new], depth[new]))
            complete = len(expected.ids) >= len(ids) and (len(ids) > 0 or self._saw_cut)
            holds = len(ids) > 0 and len(expected.ids) >= _ENOUGH * len(ids)
        self._since_blind += 1
        interval = self.config.blind_interval
        if in_map is None or not complete:
            interval = min(interval, _INCOMPLETE)
        if (complete or (holds and in_map is not None)) and self._since_blind < interval:
            return expected, followed
        self._since_blind = 0
        self._sought = self._sought_next(complete=complete)
        scene = self._scene(frame.image, frame.camera, frame.twist)
        allowed = self._allowed()
        kinds = self._polarity.kinds(self.config.polarity)
        blind = self._search.search(
            frame.image, frame.noise, scene, allowed, self.config, expected, self._sought, kinds
        )
        blind = blind.only(self._polarity.possible(blind.clarity, self.config.polarity))
        return merged(expected, self._unrolled(frame, blind)), followed

    def _sought_next(self, *, complete: bool) -> Sought:
        """Both resolutions; where all that is expected is seen, so clearly that either shows it, only one, in turn."""
        if not (complete and self._motion.all_clearer_than(_CLEAR)):
            return Sought.ALL
        return Sought.FAINT if self._sought == Sought.FINE else Sought.FINE

    def _unrolled(self, frame: Frame, found: Found) -> Found:
        """Markers where they would be if all rows were seen at once."""
        if frame.readout == 0.0 or len(found.ids) == 0:
            return found
        rolled = seen_displacement(self._places(frame, found), frame.twist, frame, found.corners_px[..., 1])
        return replace(found, corners_px=found.corners_px - rolled)

    def _expected(self, camera: Camera, last: Followed, in_map: Expected | None) -> Expected:
        """The map's markers and the last frame's others."""
        at = last.places.at
        others = Expected(last.ids, at.px, at.x, last.places.depth)
        new: BoolArray = np.asarray(camera.contains(at.px, _RIM_PX).all(axis=1))
        if in_map is None:
            return others.only(new)
        new &= ~among(last.ids, self._known.ids)
        return in_map.joined(others.only(new)) if new.any() else in_map

    def _guided(self, frame: Frame, twist: Twist, ids: IntArray, corners: FloatArray, depth: FloatArray) -> Found:
        """Known markers that are seen near where the map and the filter say."""
        camera, image, noise = frame.camera, frame.image, frame.noise
        places = Places.of(ImagePoints.at(corners, camera), depth)
        shift, rolled = places.smear(twist, frame.lag), expected_displacement(places, twist, frame)
        corners = corners + rolled
        blurred = np.abs(shift).max(axis=(1, 2)) > SMEAR_THAT_MATTERS_PX
        scene = markers_sharpened(image, corners[blurred], shift[blurred], WINDOW_MARGIN_PX)
        still = np.where(blurred[:, None, None], REMAINING * shift, shift)
        found, seen = look(scene, self._scratch, ids, corners + still, self._decoder, noise, self.config)
        found = replace(found, corners_px=found.corners_px - (still + rolled)[seen])
        faint = np.flatnonzero(blurred & ~seen)
        if len(faint) == 0:
            return found
        # Freeing a faint marker of its lag may have drowned it in noise.
        also, there = look(
            image, self._scratch, ids[faint], (corners + shift)[faint], self._decoder, noise, self.config
        )
        return merged(found, replace(also, corners_px=also.corners_px - (shift + rolled)[faint[there]]))

    def _allowed(self) -> BoolArray:
        """Which IDs of the dictionary may be found."""
        wanted = list(self._map) if self._map and self.config.whitelist_from_map else list(self.config.whitelist)
        if not wanted:
            return np.ones(self._decoder.count, dtype=bool)
        return np.asarray(np.isin(np.arange(self._decoder.count), wanted))

    def _scene(self, image: Float32Array, camera: Camera, twist: Twist | None) -> Float32Array:
        """The frame as the search sees it, freed of lag where motion is fast enough to matter there."""
        if twist is None or self.config.bolometer_lag <= 0.0:
            return image
        if self._field is None or self._field.camera is not camera:
            self._field = SmearField(camera)
        smear = twist, self._depth, self.config.bolometer_lag
        if self._field.longest(*smear) < _SMEAR_THAT_HIDES_PX:
            return image
        field = self._field.full(self._field.at(*smear))
        return without_lag(image, field[..., 0], field[..., 1])

    def _refined(
        self, frame: Frame, found: Found, followed: Followed, in_map: Expected | None
    ) -> tuple[IntArray, Refinement]:
        """IDs and refined corners of the markers that these confirm."""
        near = among(found.ids, followed.ids)
        if len(followed.ids) == len(found.ids) and near.all():
            places = followed.places
        else:
            known = [] if in_map is None else [(in_map.ids, in_map.depth)]
            places = self._places(frame, found, *known, (followed.ids, followed.places.depth))
        self._depth = float(places.depth.sum()) / places.depth.size
        refinement = self._refiner.refine(frame, found, places, near, self.config)
        keep = self._confirmed(frame, found, refinement, followed)
        return found.ids[keep], refinement.only(keep)

    def _places(self, frame: Frame, found: Found, *known: tuple[IntArray, FloatArray]) -> Places:
        """Where markers are: of those that are ``known``, by ID, the corners' depths; the others may be tilted wrongly.

        Seen obliquely and approached, a marker that is tilted the wrong way would be smeared across instead of along.
        """
        at = ImagePoints.at(found.corners_px, frame.camera)
        sizes = self._sizes_of(found.ids)
        depth = _depths(ippe_square(at.x, sizes)[:, 0], sizes)
        for ids, depth_of_known in known:
            one, other = pairs(ids, found.ids)
            depth[other] = depth_of_known[one]
        return Places.of(at, depth)

    def _confirmed(self, frame: Frame, found: Found, refinement: Refinement, followed: Followed) -> BoolArray:
        """Which markers look like themselves at their refined corners: how the motion is known does not matter."""
        view, seen = refinement.view, refinement.seen
        there = found.corners_px + view.shift
        off = np.abs(seen.corners_px - there).max(axis=(1, 2))
        read = off < _READ_THERE / self._decoder.cells * sides_px(found.corners_px)
        keep = read & among(found.ids, followed.ids[followed.certain])
        others = np.flatnonzero(~keep)
        if len(others):
            sharp = view.sharp(seen.corners_px, others, self._scratch)
            sought = replace(found, corners_px=there).only(others)
            keep[others] = confirmed(sharp, self._scratch, sought, seen.only(others), self._decoder, self.config)
        return np.asarray(keep & frame.camera.contains(seen.corners_px, 0.5 * _RIM_PX).all(axis=1))

    def _poses(
        self, ids: IntArray, corners: RefinedCorners, at: ImagePoints, T_camera_map: FloatArray | None
    ) -> PlanarPoses:
        """Both poses of each marker, the likelier first."""
        poses = planar_poses(at, corners.covariances, self._sizes_of(ids))
        in_map = [self._map.get(marker_id) for marker_id in ids.tolist()]
        return choose_branches(poses, at, corners.covariances, in_map, T_camera_map)

    def _remember(self, frame: Frame, ids: IntArray, refinement: Refinement, poses: PlanarPoses) -> None:
        """What the next frame starts from."""
        self._polarity.learn(refinement.corners.contrast)
        clarity = refinement.corners.contrast / frame.noise
        depth = _depths(poses.T_camera_marker[:, 0], self._sizes_of(ids))
        # Motion that was told by what turned out to be no markers is none.
        twist = refinement.twist if len(ids) else frame.twist
        self._motion.remember(frame.stamp_ns, twist, Tracked(ids, refinement.places.at.x, depth, clarity))

    def _sizes_of(self, ids: IntArray) -> FloatArray:
        return np.array([self.size(marker_id) for marker_id in ids.tolist()])


def _common_shift(ids: IntArray, corners: FloatArray, seen: Found) -> FloatArray:
    """By how much (2,) markers are off their predicted corners (N, 4, 2), as those that are seen tell."""
    predicted, found = pairs(ids, seen.ids)
    if len(found) == 0:
        return np.zeros(2)
    return np.asarray(np.median((seen.corners_px[found] - corners[predicted]).mean(axis=1), axis=0))


def _depths(T_camera_marker: FloatArray, sizes: FloatArray) -> FloatArray:
    """Depths (N, 4) [m] of the corners of markers."""
    depth = T_camera_marker[:, 2, 3, None] + sizes[:, None] * (T_camera_marker[:, 2, :2] @ _FACE.T)
    return np.fmax(np.where(np.isfinite(depth), depth, 1.0), 0.1)
