"""Finds the markers of a frame: those of the last frame, known ones near their predictions, and by blind search if due.

A marker at its prediction is accepted if its pattern, in the predicted attitude, correlates with the image clearly, and
better than the pattern of any other marker and than any other rotation of its own.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.focus import Focus
from thermal_fiducial.core.detection.corners.gray_scale import GrayScale, UNKNOWN_SCALE
from thermal_fiducial.core.detection.corners.refining import CLEAR_CNR
from thermal_fiducial.core.detection.finding.drifted import drifted_markers
from thermal_fiducial.core.detection.finding.parts import shown_by_known
from thermal_fiducial.core.detection.finding.search import BlindSearch, large_aligned, SearchScales
from thermal_fiducial.core.detection.patterns import Decoder, most_similar, NEAR_CELLS
from thermal_fiducial.core.detection.prediction.frame import displacement_by_motion, Frame, Places, rolling_displacement
from thermal_fiducial.core.detection.prediction.known_markers import (
    among,
    CUT_OFF_PX,
    depths,
    ExpectedMarkers,
    FoundMarkers,
    KnownMarkers,
    TOGETHER,
)
from thermal_fiducial.core.detection.prediction.tracking import Guide, MotionTrack
from thermal_fiducial.core.detection.prediction.twist import Twist
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.planar_pose import ippe_square
from thermal_fiducial.core.geometry.reprojection import areas, diagonals, sides_px, squared_sides
from thermal_fiducial.core.geometry.se3 import turned
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray, SECOND_NS

# Polarity: memory in frames that show markers, and the surplus of markers of one polarity from which on it is certain.
_FRAMES, _SURE = 30.0, 6.0
# The same without markers [s]: half a minute until a certain polarity is open again. Sheets take minutes to become
# colder than what is behind them; and the first marker after a gap is often in motion blur, in which the plate around a
# dark marker resembles a bright one.
_REMEMBERED_S = 20.0
# Share of the predicted map markers that must be found for the prediction to count as right.
_ENOUGH = 0.5
# Longest time between blind searches [s] without a map or with a wrong prediction: every other frame at 30 Hz, every
# one of slow cameras, before which a marker passes in few frames.
_UNSURE_S = 0.06
# Markers of the map that are looked for away from their predictions: how many at a time, least width of their cells
# [px], and how far, as a share of the image's width.
_MOST, _LEAST_CELL_PX, _FARTHEST = 8, 1.0, 0.25
# Width of a marker over its longest side below which it may be half of another one, and area over that one's: a half of
# one that is seen from the front has 0.5 of both.
_NARROW = 0.65
# Least correlation with its pattern of a followed marker, in an image that lag blurs.
_STILL_SIMILAR = 0.5


@dataclass(frozen=True, slots=True)
class FrameHistory:
    """What a frame needs from the frames before it."""

    track: MotionTrack
    #: of the camera, as far as it is known
    focus: Focus
    #: surplus of dark over bright markers, with exponential forgetting, at most that of one marker a frame
    balance: float = 0.0
    #: whether the last frame showed markers that are partially visible
    saw_partial: bool = False
    #: stamp of the last frame that was searched blindly, and the resolutions that were used
    searched_ns: int | None = None
    scales: SearchScales = SearchScales.ALL | SearchScales.CLIPPED
    #: of the display, as far as it is known
    gray_scale: GrayScale = UNKNOWN_SCALE

    def after(
        self,
        stamp_ns: int,
        twist: Twist | None,
        markers: ExpectedMarkers,
        focus: Focus,
        gray_scale: GrayScale,
        *,
        saw_partial: bool,
    ) -> 'FrameHistory':
        """The history that the frame after one with these starts from."""
        track = self.track.after(stamp_ns, twist, markers)
        surplus, before_ns = float(np.sign(markers.cnr).sum()), self.track.stamp_ns
        if surplus != 0.0:
            balance = min(max(self.balance * (1.0 - 1.0 / _FRAMES) + surplus, -_FRAMES), _FRAMES)
        else:
            elapsed_ns = 0 if before_ns is None else max(stamp_ns - before_ns, 0)
            balance = self.balance * math.exp(-elapsed_ns / (_REMEMBERED_S * SECOND_NS))
        return FrameHistory(track, focus, balance, saw_partial, self.searched_ns, self.scales, gray_scale)

    def polarities(self, rule: str) -> tuple[float, ...]:
        """Possible ones by the parameter ``polarity``: 1 for markers darker than their background, -1 for brighter."""
        if rule == 'any' or (rule == 'alike' and abs(self.balance) < _SURE):
            return 1.0, -1.0
        return (math.copysign(1.0, self.balance) if rule == 'alike' else 1.0 if rule == 'dark' else -1.0,)


class MarkerFinder:
    """Finds the markers of the dictionary of a ``decoder``."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._search = BlindSearch(decoder)

    def find(
        self,
        frame: Frame,
        history: FrameHistory,
        known: KnownMarkers,
        guide: Guide | None,
        config: ArucoDetectorConfig,
    ) -> tuple[FoundMarkers, FrameHistory]:
        """Markers at the frame's stamp, accurate to a pixel or two, and the history with the blind search after it.

        ``guide``: camera by which the map's markers are predicted; None: they are not.
        """
        unfollowed: ExpectedMarkers | None = None
        if frame.twist is None or not config.guided:
            found, complete, holds = FoundMarkers.none(), False, False
        else:
            found, predictions, unfollowed = self._guided(frame, history, known, guide, config)
            complete = len(found.ids) >= predictions and (predictions > 0 or history.saw_partial)
            enough = complete or (predictions > 0 and len(found.ids) >= _ENOUGH * predictions)
            holds = unfollowed is not None and enough
        period, last_ns = config.blind_period if holds else min(config.blind_period, _UNSURE_S), history.searched_ns
        # Not so if stamps went back.
        is_recent = last_ns is not None and 0 <= frame.stamp_ns - last_ns < period * SECOND_NS
        if (complete or holds) and is_recent:
            return found, history
        scales = _next_scales(history, found, complete=complete)
        # Half of another marker may look like a whole one that is turned away: what is narrow is looked at anew, but
        # where a map says that it is there.
        corners, is_mapped = found.places.points.px, guide is not None and among(found.ids, known.ids)
        wide = areas(corners) > _NARROW * squared_sides(corners).max(axis=1)
        blind = self._blind(frame, history, found.only(wide | is_mapped), scales, known, unfollowed, config)
        found = _joined(found, blind)
        if not holds and unfollowed is not None and guide is not None:
            missing = unfollowed.only(~among(unfollowed.ids, found.ids))
            found = _joined(found, self._drifted(frame, missing, guide, history, config))
        if guide is not None:
            found = found.only(~shown_by_known(found, known, guide.T_camera_map, frame.camera, self._decoder))
        return found, replace(history, searched_ns=frame.stamp_ns, scales=scales)

    def _guided(
        self,
        frame: Frame,
        history: FrameHistory,
        known: KnownMarkers,
        guide: Guide | None,
        config: ArucoDetectorConfig,
    ) -> tuple[FoundMarkers, int, ExpectedMarkers | None]:
        """Markers found at their predictions, from the last frame, else from the map.

        And the number of predictions, and those from the map, of markers that could not be followed from the last
        frame; None without a ``guide``.
        """
        last = history.track.expected(frame.stamp_ns, frame.twist)
        places = last.places(frame.camera)
        wanted: BoolArray = np.asarray(frame.camera.contains(places.points.px, CUT_OFF_PX).all(axis=1))
        if not wanted.all():
            last, places = last.only(wanted), places.only(wanted)
        found, unfollowed = followed(frame, last, places, self._decoder, config), None
        lost, missing = ~among(last.ids, found.ids), ExpectedMarkers.none()
        if guide is not None:
            missing = unfollowed = known.expected(
                guide.T_camera_map, frame.camera, config.min_side_px, without=found.ids
            )
            lost &= ~among(last.ids, known.ids)
        if lost.any():
            missing = missing.joined(last.only(lost))
        predictions = len(found.ids) + len(missing.ids)
        if len(missing.ids):
            found = _joined(found, near_prediction(frame, missing, self._decoder, config))
        return found, predictions, unfollowed

    def _blind(
        self,
        frame: Frame,
        history: FrameHistory,
        found: FoundMarkers,
        scales: SearchScales,
        known: KnownMarkers,
        unfollowed: ExpectedMarkers | None,
        config: ArucoDetectorConfig,
    ) -> FoundMarkers:
        """Markers by blind search, except those already ``found``."""
        polarities, allowed = history.polarities(config.polarity), self.allowed(known, config)
        blind = self._search.search(frame, allowed, config, found, scales, polarities)
        if len(blind.ids) == 0:
            return FoundMarkers.none()
        possible = (blind.cnr[:, None] * polarities > 0.0).any(axis=1)
        ids, corners = blind.ids[possible], blind.corners_px[possible]
        at, sizes = ImagePoints.at(corners, frame.camera), known.sizes[ids]
        depth = depths(ippe_square(at.x, sizes)[:, 0], sizes)
        if unfollowed is not None:
            # A single marker's planar pose may be the wrong one, and with it depth and direction of the motion blur.
            predicted, here = np.nonzero(unfollowed.ids[:, None] == ids)
            depth[here] = unfollowed.depth[predicted]
        places = Places.of(at, depth)
        if frame.readout != 0.0:
            # Places at the stamp, without the displacement by the rolling shutter.
            rolling = rolling_displacement(places, frame.twist, frame, corners[..., 1])
            places = Places.of(ImagePoints.at(corners - rolling, frame.camera), depth)
        no = np.zeros(len(ids), dtype=bool)
        return FoundMarkers(ids, places, blind.cnr[possible], no, no)

    def _drifted(
        self,
        frame: Frame,
        missing: ExpectedMarkers,
        guide: Guide,
        history: FrameHistory,
        config: ArucoDetectorConfig,
    ) -> FoundMarkers:
        """Those of the ``missing`` markers that are together farther from their predictions by the ``guide``."""
        places = missing.places(frame.camera)
        cells = sides_px(places.points.px) / self._decoder.cells
        # The widest ones are the most distinct.
        tried = np.argsort(-cells, kind='stable')[: min(_MOST, int((cells >= _LEAST_CELL_PX).sum()))]
        if len(tried) == 0:
            return FoundMarkers.none()
        missing, places = missing.only(tried), places.only(tried)
        displaced = displacement_by_motion(places, frame)
        is_there, corners = drifted_markers(
            frame.image,
            missing.ids,
            places.points.px + displaced,
            places.flow.mean(axis=1),
            turned(guide.covariance, guide.T_camera_map[:3, :3]),
            _FARTHEST * frame.camera.width,
            history.polarities(config.polarity),
            self._decoder,
        )
        x = ImagePoints.at(corners - displaced, frame.camera).x
        again = replace(missing, x=x).only(is_there)
        return near_prediction(frame, again, self._decoder, config) if is_there.any() else FoundMarkers.none()

    def allowed(self, known: KnownMarkers, config: ArucoDetectorConfig) -> BoolArray:
        """Which IDs of the dictionary may be found: of those that show a pose."""
        # With those in quarantine: only a marker that is found can be released.
        by_map = config.whitelist_from_map and len(known.mapped) > 0
        wanted = known.mapped if by_map else np.array(config.whitelist, dtype=int)
        if len(wanted) == 0:
            return self._decoder.posed
        return np.asarray(np.isin(np.arange(self._decoder.count), wanted) & self._decoder.posed)


def _joined(found: FoundMarkers, others: FoundMarkers) -> FoundMarkers:
    """Both, at each place that which was ``found`` unless it may be half of the other one.

    The right half of marker 30 of DICT_4X4_50 is marker 17, seen from the side: only the whole explains both.
    """
    if len(found.ids) == 0 or len(others.ids) == 0:
        return others if len(found.ids) == 0 else found
    mine, theirs = found.places.points.px, others.places.points.px
    apart = np.linalg.norm(mine.mean(axis=1)[:, None] - theirs.mean(axis=1), axis=-1)
    together = apart <= TOGETHER * diagonals(mine)[:, None]
    half = together & (found.ids[:, None] != others.ids) & (areas(mine)[:, None] < _NARROW * areas(theirs))
    whole = ~half.any(axis=1)
    found, together = found.only(whole), together[whole]
    return found.joined(others.only(~among(others.ids, found.ids) & ~together.any(axis=0)))


def _next_scales(history: FrameHistory, found: FoundMarkers, *, complete: bool) -> SearchScales:
    """Both resolutions; one in turn where all predicted markers were found with high contrast.

    Where none is ``found`` at its prediction, counts are clipped every other time until markers show: clipped ones show
    those that touch a flame or are beside a panel, others those in motion blur, both ends of which would be clipped.
    """
    last, had_markers = history.scales, len(history.track.markers.ids) > 0
    if len(found.ids) == 0 and (SearchScales.CLIPPED in last) == had_markers:
        return SearchScales.ALL | SearchScales.CLIPPED
    if not (complete and history.track.all_clearer_than(CLEAR_CNR)):
        return SearchScales.ALL
    return SearchScales.FAINT if last == SearchScales.FINE else SearchScales.FINE


def followed(
    frame: Frame,
    last: ExpectedMarkers,
    places: Places,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> FoundMarkers:
    """Those of the ``last`` frame's N markers whose pattern the image shows at the predicted ``places``."""
    if len(last.ids) == 0:
        return FoundMarkers.none()
    corners = places.points.px + displacement_by_motion(places, frame)
    match = decoder.best_match(frame.pixels, corners)
    similarity = match.correlation * np.sign(last.cnr)
    alike = (match.best == 4 * last.ids) & (similarity > _STILL_SIMILAR)
    alike &= (frame.camera.contains(corners) & frame.camera.shows(corners)).all(axis=1)
    certain = similarity >= config.guided_min_correlation
    certain &= similarity - match.runner_up >= config.guided_min_margin
    found = FoundMarkers(last.ids, places, last.cnr, np.ones(len(alike), dtype=bool), certain)
    return found if alike.all() else found.only(alike)


def near_prediction(
    frame: Frame,
    expected: ExpectedMarkers,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> FoundMarkers:
    """Those of the ``expected`` markers that are decoded near their predictions."""
    ids, places = expected.ids, expected.places(frame.camera)
    displaced = displacement_by_motion(places, frame)
    corners = _shifted(frame.image, ids, places.points.px + displaced, decoder)
    corners = large_aligned(frame.image, corners, ids, decoder, predicted=True)
    reading, at_stamp = decoder.read(frame.image, corners), corners - displaced
    limits = config.guided_min_correlation, config.guided_min_margin, config.guided_min_contrast * frame.noise
    good = (reading.ids == ids) & (reading.turns == 0) & reading.clear(*limits)
    good &= frame.camera.shows(at_stamp).all(axis=1)
    found = Places.of(ImagePoints.at(at_stamp[good], frame.camera), expected.depth[good])
    no = np.zeros(len(found.depth), dtype=bool)
    return FoundMarkers(ids[good], found, reading.contrast[good] / frame.noise, ~no, no)


def _shifted(image: Float32Array, ids: IntArray, corners: FloatArray, decoder: Decoder) -> FloatArray:
    """Corners (N, 4, 2) moved to the best correlation with their patterns on a grid, interpolated by its centroid."""
    cell = diagonals(corners) / (np.sqrt(2.0) * decoder.cells)
    step = cell[:, None, None] * NEAR_CELLS
    tried = (corners[:, None] + step[:, :, None]).reshape(-1, 4, 2)
    similarity = np.abs(decoder.correlation(image, tried, np.repeat(ids, len(NEAR_CELLS)))).reshape(len(ids), -1)
    return np.asarray(corners + most_similar(similarity, step)[:, None])
