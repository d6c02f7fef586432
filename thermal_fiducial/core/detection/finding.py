"""Markers of a frame: followed, known ones near their predicted places, and blindly when that is due."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.found import among, Found, merged, places_of
from thermal_fiducial.core.detection.frame import Frame, seen_displacement
from thermal_fiducial.core.detection.guided import Followed, near_prediction
from thermal_fiducial.core.detection.known_markers import ExpectedMarkers, KnownMarkers, MarkerSizes, MarkersOfMap
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.search import BlindSearch, SearchScales
from thermal_fiducial.core.detection.tracking import MotionTrack
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import BoolArray, FloatArray

# A frame's markers are remembered for about so many frames, and make sure of the kind when so many more are of it.
_FRAMES, _SURE = 30, 6.0
# Share of the map's expected markers that, when observed, shows that the prediction holds.
_ENOUGH = 0.5
# Contrast over noise beyond which a marker shows at full and at half the resolution.
_CLEAR = 20.0
# Nearer to the border of the image than this a marker is not expected to be observed [px].
_BORDER_PX = 2.0
# Where not all markers are known, or not all observed that should be, a blind search follows at least every so many
# frames.
_INCOMPLETE = 2


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
    sizes : sides of the markers
    """

    def __init__(self, decoder: Decoder, sizes: MarkerSizes) -> None:
        self._decoder, self._sizes = decoder, sizes
        self._search = BlindSearch(decoder)

    def find(self, frame: Frame, history: FrameHistory, of_map: MarkersOfMap, config: ArucoDetectorConfig) -> Findings:
        """Markers to a pixel or two, at the frame's stamp."""
        near = self._near(frame, history, of_map, config)
        since_blind, interval = history.since_blind + 1, config.blind_interval
        if of_map.expected is None or not near.complete:
            interval = min(interval, _INCOMPLETE)
        if (near.complete or (near.holds and of_map.expected is not None)) and since_blind < interval:
            return Findings(near.found, near.followed, since_blind, history.scales)
        scales = _next_scales(history, complete=near.complete)
        blind = self._blind(frame, history, near.found, scales, of_map.known, config)
        return Findings(merged(near.found, blind), near.followed, 0, scales)

    def _near(self, frame: Frame, history: FrameHistory, of_map: MarkersOfMap, config: ArucoDetectorConfig) -> _Near:
        """Markers where they should be: followed from the last frame, and others of the map."""
        if frame.twist is None or not config.guided:
            return _Near(Found.none(), Followed.none(), complete=False, holds=False)
        last = Followed.of(history.track.expected(frame.stamp_ns, frame.twist), frame)
        expected = _expected(frame.camera, last, of_map)
        followed = last.only(among(last.ids, expected.ids)).seen(frame, frame.twist, self._decoder, config)
        found = followed.found()
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
        places = places_of(frame, found, self._sizes.of(found.ids, known))
        rolling = seen_displacement(places, frame.twist, frame, found.corners_px[..., 1])
        return replace(found, corners_px=found.corners_px - rolling)


def _next_scales(history: FrameHistory, *, complete: bool) -> SearchScales:
    """Both resolutions; where all that is expected is seen, so clearly that either shows it, only one, in turn."""
    if not (complete and history.track.all_clearer_than(_CLEAR)):
        return SearchScales.ALL
    return SearchScales.FAINT if history.scales == SearchScales.FINE else SearchScales.FINE


def _expected(camera: Camera, last: Followed, of_map: MarkersOfMap) -> ExpectedMarkers:
    """The map's markers and the last frame's others."""
    at = last.places.at
    others = ExpectedMarkers(last.ids, at.px, at.x, last.places.depth)
    new: BoolArray = np.asarray(camera.contains(at.px, _BORDER_PX).all(axis=1))
    if of_map.expected is None:
        return others.only(new)
    new &= ~among(last.ids, of_map.known.ids)
    return of_map.expected.joined(others.only(new)) if new.any() else of_map.expected
