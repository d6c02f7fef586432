"""Markers of a frame: found, identified, their corners refined, both poses of each."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig, size_overrides
from thermal_fiducial.core import geometry
from thermal_fiducial.core.adjustment.edges import edges_behind
from thermal_fiducial.core.camera import Camera, ImagePoints
from thermal_fiducial.core.corners import refine_corners, RefinedCorners
from thermal_fiducial.core.measurements import MARKER_DTYPE, Markers, Odometry
from thermal_fiducial.core.pose import choose_branches, ippe_square, marker_corners, planar_poses
from thermal_fiducial.core.types import BoolArray, Counts, Float32Array, FloatArray, Gray, IntArray
from thermal_fiducial.core.vision.clock_offset import ClockOffset
from thermal_fiducial.core.vision.contrast import noise_of, without_columns
from thermal_fiducial.core.vision.decoding import Decoder
from thermal_fiducial.core.vision.guided import camera_in_map, Expected, expected_markers, look
from thermal_fiducial.core.vision.lag import (
    image_velocity,
    markers_sharpened,
    model_error,
    MotionTracker,
    plausible,
    REMAINING,
    smear,
    smear_by_twist,
    SmearField,
    SPREAD,
    Tracked,
    Twist,
    without_lag,
)
from thermal_fiducial.core.vision.local_corners import local_corners
from thermal_fiducial.core.vision.marker_rows import marker_rows
from thermal_fiducial.core.vision.patterns import marker_bits
from thermal_fiducial.core.vision.search import blind_search, confirmed, Found, merged

# Smear by lag below which the shape of an edge doesn't change, and below which the search misses nothing [px].
_SMEAR_THAT_MATTERS_PX, _SMEAR_THAT_HIDES_PX = 0.4, 2.0
# Correlation with its pattern of a marker that is still where motion has carried it, seen through the lag.
_STILL_ALIKE = 0.7
# Share of the map's expected markers that, seen, shows that the prediction holds.
_ENOUGH = 0.5
# What both ways to measure smeared corners cost: sharpening adds noise, in pixels times contrast over noise times root
# of the side; without it the tail of the lag passes for a symmetric blur, which displaces corners by so much of the
# square of the smear over a cell.
_NOISE_OF_SHARPENING, _COST_OF_SMEAR = 6.5, 0.22
# Contrast over noise below which a marker is faint. A clearer one is always sharpened: its corners are so good that
# even a short tail shows in what they have in common.
_CLEAR = 20.0
# Contrast over noise beyond which the column pattern of the array displaces no side.
_CLEARER_THAN_COLUMNS = 100.0
# Columns of pixels used of a cell; all of a faint marker's count.
_COLUMNS, _COLUMNS_FAINT = 6, 12
# Pixels round a marker that the refinement may look at.
_WINDOW_MARGIN_PX = 14
# Nearer to the rim of the image than this a marker is not expected to be seen.
_RIM_PX = 2.0
# Where not all markers are known, or not all seen that should be, a blind search follows at least every so many frames.
_INCOMPLETE = 2
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
        self._behind = edges_behind(bits)
        self._T_body_camera = geometry.transform(
            geometry.rotation_from_quaternion(config.camera_orientation), config.camera_position
        )
        self._motion = MotionTracker(self._T_body_camera, config.bolometer_lag)
        self._clock_offset = ClockOffset()
        self._field: SmearField | None = None
        self._depth = _TYPICAL_DEPTH
        self._map: dict[int, tuple[FloatArray, float]] = {}
        self._since_blind = 0

    def set_map(self, marker_map: Mapping[int, tuple[FloatArray, float]]) -> None:
        """Markers that are known: ID to (T_map_marker, side [m])."""
        count = self._decoder.count
        self._map = {marker_id: entry for marker_id, entry in marker_map.items() if 0 <= marker_id < count}

    def detect(self, stamp_ns: int, counts: Counts | Gray, camera: Camera, odometry: Odometry | None = None) -> Markers:
        """Markers of one frame, sorted by ID; an empty array when there are none.

        Parameters
        ----------
        stamp_ns : of the frame
        counts : (height, width), clean
        camera : its intrinsics
        odometry : the filter's latest state, where there is one
        """
        with one_thread():
            odometry = self._on_camera_clock(odometry)
            twist = self._motion.predict(stamp_ns, odometry)
            image = counts.astype(np.float32)
            T_camera_map = self._predicted_pose(stamp_ns, odometry, twist)
            noise = noise_of(image)
            if counts.dtype != np.uint8 and not self._motion.all_clearer_than(_CLEARER_THAN_COLUMNS):
                image = without_columns(image, noise)
            frame = _Frame(stamp_ns, image, noise, camera, twist)
            in_map = None
            if T_camera_map is not None and self.config.guided:
                in_map = expected_markers(self._map, T_camera_map, camera, self.config.min_side_px)
            found, tracked = self._find(frame, in_map)
            ids, refined = self._refined(frame, found, tracked)
            self._learn_offset(frame, in_map, ids, refined.corners_px)
            if self.config.refinement == 'subpix' or (self.config.refinement == 'auto' and counts.dtype == np.uint8):
                refined = local_corners(image, refined, self._decoder.cells)
            return self._rows(ids, refined, camera, T_camera_map)

    def size(self, marker_id: int) -> float:
        """Side of a marker [m]: of the map, or of the overrides, or the common one."""
        if marker_id in self._map:
            return self._map[marker_id][1]
        return self._sizes.get(marker_id, self.config.marker_size)

    def _on_camera_clock(self, odometry: Odometry | None) -> Odometry | None:
        """The filter's state, where it can be true, with the stamp that the camera would have given it."""
        if odometry is None or not plausible(odometry):
            return None
        offset = round(self.config.camera_time_offset * 1e9) + self._clock_offset.ns
        return replace(odometry, stamp_ns=odometry.stamp_ns - offset)

    def _learn_offset(self, frame: '_Frame', in_map: Expected | None, ids: IntArray, corners: FloatArray) -> None:
        """How far seen corners (N, 4, 2) are off their places tells what is left of the clocks' offset."""
        if in_map is None or frame.twist is None:
            return
        _, predicted, seen = np.intersect1d(in_map.ids, ids, assume_unique=True, return_indices=True)
        x, depth = frame.camera.normalise(in_map.corners_px[predicted]), in_map.depth[predicted]
        velocity = image_velocity(frame.camera, x, depth, frame.twist)
        self._clock_offset.learn(frame.stamp_ns, corners[seen] - in_map.corners_px[predicted], velocity)

    def _predicted_pose(self, stamp_ns: int, odometry: Odometry | None, twist: Twist | None) -> FloatArray | None:
        """T_camera_map at the frame, where odometry that is fresh enough tells it."""
        if odometry is None or twist is None or not self._map:
            return None
        if abs(stamp_ns - odometry.stamp_ns) * 1e-9 > self.config.max_odometry_age:
            return None
        return geometry.inverse(camera_in_map(stamp_ns, odometry, self._T_body_camera, twist))

    def _find(self, frame: '_Frame', in_map: Expected | None) -> tuple[Found, Tracked]:
        """Markers where they should be, and whatever a blind search shows, when that is due; and which are tracked."""
        expected, tracked, complete, holds = Found.none(), Tracked.none(), False, False
        if frame.twist is not None and self.config.guided:
            last = self._motion.expected(frame.stamp_ns, frame.twist)
            ids, corners, depth = self._expected(frame.camera, last, in_map)
            tracked = self._tracked(frame, frame.twist, last.only(np.isin(last.ids, ids)))
            everywhere = np.ones(len(tracked.ids), dtype=bool)
            expected = Found(tracked.ids, frame.camera.distort(tracked.x), tracked.clarity, everywhere)
            new = ~np.isin(ids, tracked.ids)
            if new.any():
                corners = corners + _common_shift(ids, corners, expected)
                expected = merged(expected, self._guided(frame, frame.twist, ids[new], corners[new], depth[new]))
            complete = len(ids) > 0 and len(expected.ids) >= len(ids)
            holds = len(ids) > 0 and len(expected.ids) >= _ENOUGH * len(ids)
        self._since_blind += 1
        interval = self.config.blind_interval
        if in_map is None or not complete:
            interval = min(interval, _INCOMPLETE)
        if (complete or (holds and in_map is not None)) and self._since_blind < interval:
            return expected, tracked
        self._since_blind = 0
        scene = self._scene(frame.image, frame.camera, frame.twist)
        allowed = self._allowed()
        blind = blind_search(frame.image, scene, self._decoder, allowed, self.config, expected.corners_px)
        return merged(expected, blind), tracked

    def _expected(self, camera: Camera, last: Tracked, in_map: Expected | None) -> Expected:
        """The map's markers and the last frame's others."""
        corners = camera.distort(last.x)
        new = camera.contains(corners, _RIM_PX).all(axis=1)
        if in_map is None:
            return Expected(last.ids[new], corners[new], last.depth[new])
        new &= ~np.isin(last.ids, list(self._map))
        return Expected(
            np.concatenate([in_map.ids, last.ids[new]]),
            np.concatenate([in_map.corners_px, corners[new]]),
            np.concatenate([in_map.depth, last.depth[new]]),
        )

    def _tracked(self, frame: '_Frame', twist: Twist, last: Tracked) -> Tracked:
        """Those of the last frame's markers that this one shows where the motion has carried them."""
        if len(last.ids) == 0:
            return last
        smeared = smear(frame.camera, last.x, last.depth, twist, self.config.bolometer_lag)
        shown = frame.camera.distort(last.x) + smeared
        similarity = self._decoder.match(frame.image, shown, last.ids) * np.sign(last.clarity)
        alike = (similarity > _STILL_ALIKE) & frame.camera.contains(shown).all(axis=1)
        return last.only(alike)

    def _guided(self, frame: '_Frame', twist: Twist, ids: IntArray, corners: FloatArray, depth: FloatArray) -> Found:
        """Known markers that are seen near where the map and the filter say."""
        camera, image, noise = frame.camera, frame.image, frame.noise
        shift = smear(camera, camera.normalise(corners), depth, twist, self.config.bolometer_lag)
        blurred = np.abs(shift).max(axis=(1, 2)) > _SMEAR_THAT_MATTERS_PX
        scene = markers_sharpened(image, corners[blurred], shift[blurred], _WINDOW_MARGIN_PX)
        still = np.where(blurred[:, None, None], REMAINING * shift, shift)
        found, seen = look(scene, ids, corners + still, self._decoder, noise, self.config)
        found = replace(found, corners_px=found.corners_px - still[seen])
        faint = np.flatnonzero(blurred & ~seen)
        if len(faint) == 0:
            return found
        # Freeing a faint marker of its lag may have drowned it in noise.
        also, there = look(image, ids[faint], (corners + shift)[faint], self._decoder, noise, self.config)
        return merged(found, replace(also, corners_px=also.corners_px - shift[faint[there]]))

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
        coarse = self._field.at(twist, self._depth, self.config.bolometer_lag)
        if np.abs(coarse).max() < _SMEAR_THAT_HIDES_PX:
            return image
        field = self._field.full(coarse)
        return without_lag(image, field[..., 0], field[..., 1])

    def _refined(self, frame: '_Frame', found: Found, tracked: Tracked) -> tuple[IntArray, RefinedCorners]:
        """Corners at the stamp, on the image freed of lag by the twist that they themselves improve, and their IDs."""
        ids, corners, camera, predicted = found.ids, found.corners_px, frame.camera, frame.twist
        refined = RefinedCorners(corners, np.zeros((0, 4, 2, 2)), np.zeros(0), np.zeros(0))
        if len(ids) == 0:
            self._motion.remember(frame.stamp_ns, predicted, Tracked.none())
            return ids, refined
        behind = self._behind[ids]
        if len(tracked.ids) == len(ids) and self._since_blind > 0:
            at_stamp, depth = ImagePoints.seen_at(tracked.x, camera), tracked.depth
        else:
            at_stamp = ImagePoints.at(corners, camera)
            depth = _corner_depths(at_stamp.x, self._sizes_of(ids))
        near = np.isin(ids, tracked.ids)
        self._depth = float(np.median(depth))
        twist, tau = predicted, self.config.bolometer_lag
        by_twist = smear_by_twist(at_stamp.x, at_stamp.J, depth, tau)
        columns = _COLUMNS if np.abs(found.clarity).min() > _CLEAR else _COLUMNS_FAINT
        sides = _sides(corners)
        for _ in range(2):
            smeared = np.zeros_like(corners) if twist is None else by_twist @ twist.value
            sharpen = _worth_sharpening(smeared, sides, self._decoder.cells, found.clarity)
            view = _view(frame.image, at_stamp.px, smeared, sharpen)
            start = at_stamp.moved(view.shift, camera)
            seen = refine_corners(
                view.image, start, camera, behind, self.config.blur_px, view.spread, columns, near=near
            )
            refined, at_stamp = seen, start.moved(seen.corners_px - start.px - view.shift, camera)
            deviation = np.sqrt(0.5 * np.trace(seen.covariances, axis1=-2, axis2=-1).mean(axis=-1)) / camera.focal_px
            twist = self._motion.correct(frame.stamp_ns, predicted, ids, at_stamp.x, depth, deviation)
            if twist is None:
                break
            smeared = by_twist @ twist.value
            shift = smeared - view.removed
            corners = seen.corners_px - shift
            unknown = by_twist @ twist.covariance @ np.swapaxes(by_twist, -1, -2)
            unknown = unknown + model_error(smeared, sides / self._decoder.cells)
            refined = replace(seen, corners_px=corners, covariances=seen.covariances + unknown)
            at_stamp, near = start.moved(corners - start.px, camera), np.ones(len(ids), dtype=bool)
            if np.abs(shift - view.shift)[sharpen].max(initial=0.0) < _SMEAR_THAT_MATTERS_PX:
                break
        # How well the image shows the sides, apart from how well the motion is known.
        there = replace(found, corners_px=found.corners_px + view.shift)
        keep = confirmed(view.image, there, seen, self._decoder, self.config)
        ids, refined = ids[keep], refined.only(keep)
        seen_now = Tracked(ids, at_stamp.x[keep], depth[keep], refined.contrast / frame.noise)
        self._motion.remember(frame.stamp_ns, twist, seen_now)
        return ids, refined

    def _rows(self, ids: IntArray, refined: RefinedCorners, camera: Camera, T_camera_map: FloatArray | None) -> Markers:
        if len(ids) == 0:
            return np.zeros(0, dtype=MARKER_DTYPE)
        corners, covariances = ImagePoints.at(refined.corners_px, camera), refined.covariances
        poses = planar_poses(corners, covariances, self._sizes_of(ids))
        in_map = [self._map.get(marker_id) for marker_id in ids.tolist()]
        poses = choose_branches(poses, corners, covariances, in_map, T_camera_map)
        return marker_rows(ids, corners.px, covariances, poses, refined.contrast)

    def _sizes_of(self, ids: IntArray) -> FloatArray:
        return np.array([self.size(marker_id) for marker_id in ids.tolist()])


@dataclass(frozen=True, slots=True)
class _Frame:
    """An image, and what is known of the camera's motion at its stamp."""

    stamp_ns: int
    image: Float32Array
    #: standard deviation of a pixel [counts]
    noise: float
    camera: Camera
    twist: Twist | None


@dataclass(frozen=True, slots=True)
class _View:
    """A frame in which the smear of N markers is short."""

    image: Float32Array
    #: (N, 4, 2) where the corners appear in it, off their places at the stamp [px]
    shift: FloatArray
    #: (N, 4, 2) how much of the smear's shift has been taken out
    removed: FloatArray
    #: (N, 2) standard deviation of what is left of the smear, along it
    spread: FloatArray


def _common_shift(ids: IntArray, corners: FloatArray, seen: Found) -> FloatArray:
    """By how much (2,) markers are off their predicted corners (N, 4, 2), as those that are seen tell."""
    _, predicted, found = np.intersect1d(ids, seen.ids, assume_unique=True, return_indices=True)
    if len(found) == 0:
        return np.zeros(2)
    return np.asarray(np.median((seen.corners_px[found] - corners[predicted]).mean(axis=1), axis=0))


def _worth_sharpening(smeared: FloatArray, sides: FloatArray, cells: int, clarity: FloatArray) -> BoolArray:
    """For which markers with smear (N, 4, 2) and sides (N,) [px] smeared edges cost more than sharpening's noise."""
    square = np.sum(smeared.mean(axis=1) ** 2, axis=1)
    systematic, noise = _COST_OF_SMEAR * square * cells / sides, _NOISE_OF_SHARPENING / np.sqrt(sides)
    return np.asarray((np.abs(clarity) > _CLEAR) | (systematic * np.abs(clarity) > noise))


def _view(image: Float32Array, corners: FloatArray, smeared: FloatArray, sharpen: BoolArray) -> _View:
    """``image`` with known smear round all markers (N, 4, 2), sharpened round some (N,)."""
    removed = (1.0 - REMAINING) * smeared * sharpen[:, None, None]
    shift = smeared - removed
    sharp = markers_sharpened(image, (corners + shift)[sharpen], smeared[sharpen], _WINDOW_MARGIN_PX)
    return _View(sharp, shift, removed, smeared.mean(axis=1) * np.where(sharpen, SPREAD, 1.0)[:, None])


def _sides(corners: FloatArray) -> FloatArray:
    """Mean sides (N,) of quadrilaterals (N, 4, 2)."""
    return np.asarray(np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1).mean(axis=1))


def _corner_depths(x: FloatArray, sizes: FloatArray) -> FloatArray:
    """Depths (N, 4) [m] of normalised corners (N, 4, 2), roughly: of the first of both planar poses."""
    T = ippe_square(x, sizes)[:, 0]
    corners = geometry.apply(T, sizes[:, None, None] * marker_corners(1.0))
    return np.maximum(np.nan_to_num(corners[..., 2], nan=1.0), 0.1)
