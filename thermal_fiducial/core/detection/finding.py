"""Markers of a frame: followed, known ones near their predicted places, and blindly when that is due.

A marker that is looked for at its place is accepted by its own evidence alone: its pattern, in its expected place and
attitude, must correlate with the image clearly, and better than any other marker's or any other turn of its own.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.frame import Frame, Places, rolling_displacement
from thermal_fiducial.core.detection.known_markers import (
    among,
    CUT_OFF_PX,
    ExpectedMarkers,
    Found,
    KnownMarkers,
    merged,
    places_of,
)
from thermal_fiducial.core.detection.lag import lag_tail_maps, markers_deblurred, REMAINING
from thermal_fiducial.core.detection.patterns import Decoder, most_similar, NEAR_CELLS, Reading
from thermal_fiducial.core.detection.refining import BLUR_THAT_MATTERS_PX, CLEAR_CNR
from thermal_fiducial.core.detection.search import BlindSearch, SearchScales
from thermal_fiducial.core.detection.tracking import MotionTrack, TrackedMarkers
from thermal_fiducial.core.detection.twist import Twist
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# A frame's markers are remembered for about so many frames, and make sure of the kind when so many more are of it.
_FRAMES, _SURE = 30, 6.0
# Share of the map's expected markers that, when observed, shows that the prediction holds.
_ENOUGH = 0.5
# Where not all markers are known, or not all observed that should be, a blind search follows at least every so many
# frames.
_INCOMPLETE = 2
# Correlation with its pattern of a marker that is still where motion has carried it, seen through the lag.
_STILL_SIMILAR = 0.7


@dataclass(frozen=True, slots=True)
class Polarity:
    """The kind of the markers that were seen last: how many more were dark than bright, the older the less."""

    balance: float = 0.0

    def after(self, contrast: FloatArray) -> 'Polarity':
        """With the markers (N,) of one more frame, by white minus black."""
        return Polarity(self.balance + float(np.sign(contrast).sum()) - self.balance / _FRAMES)

    def kinds(self, rule: str) -> tuple[float, ...]:
        """Which kinds there may be by the parameter ``polarity``: 1 for markers darker than what is behind, -1."""
        return tuple(kind for kind in (1.0, -1.0) if self.possible(np.array([kind]), rule)[0])

    def possible(self, contrast: FloatArray, rule: str) -> BoolArray:
        """Which markers (N,) may be some, by the parameter ``polarity``."""
        if rule == 'any' or (rule == 'alike' and abs(self.balance) < _SURE):
            return np.ones(len(contrast), dtype=bool)
        kind = self.balance if rule == 'alike' else 1.0 if rule == 'dark' else -1.0
        return np.asarray(contrast * kind > 0.0)


@dataclass(frozen=True, slots=True)
class FrameHistory:
    """What the frames so far have shown."""

    track: MotionTrack
    polarity: Polarity = field(default_factory=Polarity)
    #: whether the last frame showed markers that are partially visible
    saw_partial: bool = False
    #: frames since the last blind search, and at which resolutions that was
    since_blind: int = 0
    scales: SearchScales = SearchScales.ALL


@dataclass(frozen=True, slots=True)
class Followed:
    """N markers where the motion since the last frame has carried them.

    Parameters
    ----------
    ids : (N,)
    places : at the stamp
    cnr : (N,) contrast-to-noise ratio of a pixel
    certain : (N,) whether the frame shows them there beyond doubt
    """

    ids: IntArray
    places: Places
    cnr: FloatArray
    certain: BoolArray

    @staticmethod
    def none() -> 'Followed':
        """No markers."""
        x, J = np.zeros((0, 4, 2)), np.zeros((0, 4, 2, 2))
        places = Places(ImagePoints(x, x, J, J), np.zeros((0, 4)), np.zeros((0, 4, 2, 6)))
        return Followed(np.zeros(0, dtype=np.int64), places, np.zeros(0), np.zeros(0, dtype=bool))

    @staticmethod
    def of(last: TrackedMarkers, frame: Frame) -> 'Followed':
        """Those of the last frame, carried on; nothing is known yet of whether they are seen."""
        places = Places.of(ImagePoints.seen_at(last.x, frame.camera), last.depth)
        return Followed(last.ids, places, last.cnr, np.zeros(len(last.ids), dtype=bool))

    def only(self, keep: BoolArray) -> 'Followed':
        """Those of the markers ``keep`` (N,)."""
        if keep.all():
            return self
        return Followed(self.ids[keep], self.places.only(keep), self.cnr[keep], self.certain[keep])

    def seen(self, frame: Frame, twist: Twist, decoder: Decoder, config: ArucoDetectorConfig) -> 'Followed':
        """Those that the frame shows: they look like themselves more than like any other marker."""
        if len(self.ids) == 0:
            return self
        shown = self.places.at.px + self.places.lag_blur(twist, frame.lag)
        shown += rolling_displacement(self.places, twist, frame)
        likeness = decoder.likeness(frame.image, shown)
        similarity = likeness.correlation * np.sign(self.cnr)
        alike = (likeness.best == 4 * self.ids) & (similarity > _STILL_SIMILAR)
        alike &= frame.camera.contains(shown).all(axis=1)
        certain = similarity >= config.guided_min_correlation
        certain &= similarity - likeness.runner_up >= config.guided_min_margin
        return Followed(self.ids, self.places, self.cnr, certain).only(alike)


class Findings(NamedTuple):
    """What is found in a frame."""

    found: Found
    #: those of the last frame that are observed again
    followed: Followed
    #: of :class:`FrameHistory`
    since_blind: int
    scales: SearchScales


class _Near(NamedTuple):
    """What is found where it is expected."""

    found: Found
    followed: Followed
    #: whether all that is expected is observed; and so much of it that the prediction must hold
    complete: bool
    holds: bool


class MarkerFinder:
    """Finds the markers of a dictionary.

    Parameters
    ----------
    decoder : of the dictionary
    """

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._search = BlindSearch(decoder)

    def find(
        self,
        frame: Frame,
        history: FrameHistory,
        known: KnownMarkers,
        in_map: ExpectedMarkers | None,
        config: ArucoDetectorConfig,
    ) -> Findings:
        """Markers to a pixel or two, at the frame's stamp; ``in_map``: where those of the map should be, if known."""
        near = self._near(frame, history, known, in_map, config)
        since_blind, interval = history.since_blind + 1, config.blind_interval
        if in_map is None or not near.complete:
            interval = min(interval, _INCOMPLETE)
        if (near.complete or (near.holds and in_map is not None)) and since_blind < interval:
            return Findings(near.found, near.followed, since_blind, history.scales)
        scales = _next_scales(history, complete=near.complete)
        blind = self._blind(frame, history, near.found, scales, known, config)
        return Findings(merged(near.found, blind), near.followed, 0, scales)

    def _near(
        self,
        frame: Frame,
        history: FrameHistory,
        known: KnownMarkers,
        in_map: ExpectedMarkers | None,
        config: ArucoDetectorConfig,
    ) -> _Near:
        """Markers where they should be: followed from the last frame, and others of the map."""
        if frame.twist is None or not config.guided:
            return _Near(Found.none(), Followed.none(), complete=False, holds=False)
        last = Followed.of(history.track.expected(frame.stamp_ns, frame.twist), frame)
        expected = _expected(frame.camera, last, known, in_map)
        followed = last.only(among(last.ids, expected.ids)).seen(frame, frame.twist, self._decoder, config)
        found = Found(followed.ids, followed.places.at.px, followed.cnr, np.ones(len(followed.ids), dtype=bool))
        new = ~among(expected.ids, followed.ids)
        if new.any():
            near = near_prediction(frame, frame.twist, expected.only(new), self._decoder, config)
            found = merged(found, near)
        number = len(expected.ids)
        complete = len(found.ids) >= number and (number > 0 or history.saw_partial)
        return _Near(found, followed, complete, number > 0 and len(found.ids) >= _ENOUGH * number)

    def _blind(
        self,
        frame: Frame,
        history: FrameHistory,
        found: Found,
        scales: SearchScales,
        known: KnownMarkers,
        config: ArucoDetectorConfig,
    ) -> Found:
        """Markers wherever they are, but for those that are ``found`` already."""
        kinds, allowed = history.polarity.kinds(config.polarity), self.allowed(known, config)
        blind = self._search.search(frame, allowed, config, found, scales, kinds)
        blind = blind.only(history.polarity.possible(blind.cnr, config.polarity))
        return self._without_rolling_shutter(frame, blind, known)

    def allowed(self, known: KnownMarkers, config: ArucoDetectorConfig) -> BoolArray:
        """Which IDs of the dictionary may be found."""
        wanted = known.ids if len(known.ids) and config.whitelist_from_map else np.array(config.whitelist, dtype=int)
        if len(wanted) == 0:
            return np.ones(self._decoder.count, dtype=bool)
        return np.asarray(np.isin(np.arange(self._decoder.count), wanted))

    def _without_rolling_shutter(self, frame: Frame, found: Found, known: KnownMarkers) -> Found:
        """Markers where they would be if all rows were seen at once."""
        if frame.readout == 0.0 or len(found.ids) == 0:
            return found
        places = places_of(frame, found, known.sizes(found.ids))
        rolling = rolling_displacement(places, frame.twist, frame, found.corners_px[..., 1])
        return replace(found, corners_px=found.corners_px - rolling)


def _next_scales(history: FrameHistory, *, complete: bool) -> SearchScales:
    """Both resolutions; where all that is expected is seen, so clearly that either shows it, only one, in turn."""
    if not (complete and history.track.all_clearer_than(CLEAR_CNR)):
        return SearchScales.ALL
    return SearchScales.FAINT if history.scales == SearchScales.FINE else SearchScales.FINE


def _expected(camera: Camera, last: Followed, known: KnownMarkers, in_map: ExpectedMarkers | None) -> ExpectedMarkers:
    """The map's markers and the last frame's others."""
    at = last.places.at
    others = ExpectedMarkers(last.ids, at.px, at.x, last.places.depth)
    new: BoolArray = np.asarray(camera.contains(at.px, CUT_OFF_PX).all(axis=1))
    if in_map is None:
        return others.only(new)
    new &= ~among(last.ids, known.ids)
    return in_map.joined(others.only(new)) if new.any() else in_map


def near_prediction(
    frame: Frame,
    twist: Twist,
    expected: ExpectedMarkers,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> Found:
    """Those of the ``expected`` markers that the frame shows near where they are expected."""
    places = Places.of(ImagePoints.at(expected.corners_px, frame.camera), expected.depth)
    shift, rolling = places.lag_blur(twist, frame.lag), rolling_displacement(places, twist, frame)
    ids, corners = expected.ids, expected.corners_px + rolling
    blurred = np.abs(shift).max(axis=(1, 2)) > BLUR_THAT_MATTERS_PX
    scene = frame.image
    if blurred.any():
        scene = markers_deblurred(frame.image, corners[blurred], lag_tail_maps(corners[blurred], shift[blurred]))
    left = np.where(blurred[:, None, None], REMAINING * shift, shift)
    shown = _shifted(scene, ids, corners + left, decoder)
    reading = decoder.read(scene, shown)
    good = _confirmed(reading, ids, frame.noise, config)
    corners = (shown - left - rolling)[good]
    return Found(ids[good], corners, reading.contrast[good] / frame.noise, np.ones(len(corners), dtype=bool))


def _shifted(image: Float32Array, ids: IntArray, corners: FloatArray, decoder: Decoder) -> FloatArray:
    """Corners (N, 4, 2) moved to where their patterns correlate best, between the places by the centre of gravity."""
    cell = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=-1) / (np.sqrt(2.0) * decoder.cells)
    step = cell[:, None, None] * NEAR_CELLS
    tried = (corners[:, None] + step[:, :, None]).reshape(-1, 4, 2)
    similarity = np.abs(decoder.match(image, tried, np.repeat(ids, len(NEAR_CELLS)))).reshape(len(ids), -1)
    return np.asarray(corners + most_similar(similarity, step)[:, None])


def _confirmed(reading: Reading, ids: IntArray, noise: float, config: ArucoDetectorConfig) -> BoolArray:
    similarity = np.abs(reading.correlation)
    return np.asarray(
        (reading.ids == ids)
        & (reading.turns == 0)
        & (similarity >= config.guided_min_correlation)
        & (similarity - reading.runner_up >= config.guided_min_margin)
        & (np.abs(reading.contrast) >= config.guided_min_contrast * noise)
    )
