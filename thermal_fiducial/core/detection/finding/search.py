"""Blind search for markers in a frame."""

from enum import auto, Flag
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.camera_frames import with_columns_corrected
from thermal_fiducial.core.detection.corners.pattern_fit import aligned
from thermal_fiducial.core.detection.finding.quads import (
    about_background,
    dark_in_picture,
    DarkRegions,
    find_quads,
    halfway,
    halved,
    Segmentation,
    without_single_pixels,
)
from thermal_fiducial.core.detection.patterns import Decoder, Reading, shrunk
from thermal_fiducial.core.detection.prediction.frame import Frame
from thermal_fiducial.core.detection.prediction.known_markers import among, CUT_OFF_PX, FoundMarkers, TOGETHER
from thermal_fiducial.core.geometry.reprojection import diagonals, grown, sides_px, squared_sides
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray, IntArray

# Full resolution for small and blurred markers; half resolution, with the column pattern removed, for faint ones.
_FINE = Segmentation(smoothing_px=0.5, window_px=5, window_shrink=2, depth=0.2, floor=2.5, most=60.0)
_FAINT = Segmentation(smoothing_px=1.2, window_px=5, window_shrink=1, depth=0.03, floor=1.0, most=40.0)
# Deviation from the background at which counts are clipped, in standard deviations of the noise at half resolution.
_RANGE = 20.0
# Correlation from which an outline needs no alignment; least correlation, and its margin, for alignment to be tried.
_CLEAR = 0.95
_HINT, _HINT_MARGIN = 0.6, 0.06
# Factor on the shortest side of a marker in a picture for a display, which has little noise: in oblique views the other
# sides are longer.
_PICTURE_SIDE = 0.25
# Outlines run through the centres of the outermost pixels: distance to the edge there. With corners that blur rounds,
# their sides are shorter than the marker's by up to so much [px].
_EDGE_PX, _SHORTER_PX = 0.5, 2.0
# Width of cells up to which blur merges borders and plates of any margin [px].
_MERGED_PX = 3.0
# Width of cells, once to twice as much, in the images in which large markers are aligned [px]: half a cell is so little
# there that an alignment finds it, and what it leaves is less than the 5 px from which sides are found. Half a cell of
# markers that are smaller than twice that is less anyway.
_ALIGNED_PX = 5.0
# Steps of their alignment: after three, one in 25 that begin half a cell away are still 3 to 6 px off, after five one
# in 200.
_STEPS = 5
_NONE = np.zeros(0, dtype=np.intp)


class SearchScales(Flag):
    """Resolutions of the blind search, and whether counts are clipped about the background at half resolution."""

    FINE = auto()
    FAINT = auto()
    CLIPPED = auto()
    ALL = FINE | FAINT


class Outlines(NamedTuple):
    """N markers by blind search: IDs (N,), corners (N, 4, 2) [px], signed contrast-to-noise ratios (N,) of a pixel."""

    ids: IntArray
    corners_px: FloatArray
    cnr: FloatArray


class BlindSearch:
    """Finds the markers of the dictionary of a ``decoder`` anywhere in a frame."""

    def __init__(self, decoder: Decoder) -> None:
        self._decoder = decoder
        self._fine, self._faint = DarkRegions(_FINE), DarkRegions(_FAINT)

    def search(
        self,
        frame: Frame,
        allowed: BoolArray,
        config: ArucoDetectorConfig,
        found: FoundMarkers,
        scales: SearchScales = SearchScales.ALL,
        polarities: tuple[float, ...] = (1.0, -1.0),
    ) -> Outlines:
        """Markers with IDs ``allowed`` (M,), each ID once.

        Parameters
        ----------
        found : markers found already: they and their plates are left out of the search
        scales : resolutions of the search
        polarities : those searched at half resolution, 1 for markers darker than their surroundings, -1 for brighter
        """
        min_side_px = _PICTURE_SIDE * config.min_side_px if frame.displayed else config.min_side_px - _SHORTER_PX
        half, fine, faint = self._outlines(frame, found, scales, polarities, min_side_px, config)
        # A search at full resolution alone is for clear markers, which need no alignment.
        to_align = SearchScales.FAINT in scales
        reading, quads = self._read(frame, half, (fine, faint), allowed, found.ids if to_align else None)
        good = accepted(reading, frame.noise, self._decoder.correctable, config)
        if not good.any():
            return Outlines(reading.ids[good], quads[good], reading.contrast[good])
        good &= (squared_sides(quads) >= min_side_px**2).all(axis=1)
        good &= (frame.camera.contains(quads, CUT_OFF_PX) & frame.camera.shows(quads)).all(axis=1)
        good &= ~overlapped(reading, quads, good, distinct(reading, frame.noise, config))
        chosen = _chosen(reading, quads, _once(reading, quads, good, config.duplicates == 'drop'), frame.noise)
        return chosen._replace(corners_px=large_aligned(frame.image, chosen.corners_px, chosen.ids, self._decoder))

    def _outlines(
        self,
        frame: Frame,
        found: FoundMarkers,
        scales: SearchScales,
        polarities: tuple[float, ...],
        min_side_px: float,
        config: ArucoDetectorConfig,
    ) -> tuple[Float32Array, FloatArray, FloatArray]:
        """The image at half resolution, and outlines (Q, 4, 2) found at full and at half, in pixels of the frame.

        Without a search at half resolution the image is that of the frame.
        """
        # The plate, and as much again for its blurred edge.
        hidden = grown(found.places.points.px, (self._decoder.cells + 4) / self._decoder.cells)
        fine = faint = np.zeros((0, 4, 2))
        half, clear = frame.image, SearchScales.ALL not in scales
        if SearchScales.FINE in scales:
            edge_px = 0.0 if frame.displayed else _EDGE_PX
            fine = find_quads(self._fine_mask(frame, clear=clear), min_side_px, hidden, edge_px)
        if SearchScales.FAINT in scales:
            noise = 0.5 * frame.noise
            half = with_columns_corrected(halved(frame.image), noise)
            near = about_background(half, _RANGE * noise) if SearchScales.CLIPPED in scales else half
            signed = (near if polarity > 0.0 else -near for polarity in polarities)
            masks = (self._faint.mask(dark, noise, clear=clear) for dark in signed)
            outlines = [find_quads(mask, 0.5 * config.min_side_px + 2.0, halfway(hidden)) for mask in masks]
            faint = 2.0 * np.concatenate(outlines) + 0.5
        return half, fine, faint

    def _fine_mask(self, frame: Frame, *, clear: bool) -> Gray:
        if frame.displayed:
            return without_single_pixels(dark_in_picture(frame.image, frame.noise))
        return self._fine.mask(frame.image, frame.noise, clear=clear)

    def _read(
        self,
        frame: Frame,
        half: Float32Array,
        outlines: tuple[FloatArray, FloatArray],
        allowed: BoolArray,
        found_ids: IntArray | None,
    ) -> tuple[Reading, FloatArray]:
        """Readings of fine and faint outlines, and their corners (Q, 4, 2).

        Doubtful ones are aligned with their pattern and read again, unless their IDs are among ``found_ids``. Without
        ``found_ids`` none is aligned.
        """
        decoder = self._decoder
        # Blur may merge a thin black border with the white on both sides: only the outline of the plate is left then.
        fine, faint = (_with_shrunk(quads, decoder.cells) for quads in outlines)
        quads = np.concatenate([fine, faint])
        reading = decoder.read(frame.image, fine, allowed).joined(decoder.read(half, halfway(faint), allowed))
        rough = _NONE if found_ids is None else _rough(reading, quads, found_ids)
        if len(rough) == 0:
            return reading, quads
        ids, turns = reading.ids[rough], reading.turns[rough]
        if frame.displayed:
            pulled = aligned(frame.image, quads[rough], ids, turns, decoder)
            again = decoder.read(frame.image, pulled, allowed)
        else:
            in_half = aligned(half, halfway(quads[rough]), ids, turns, decoder)
            pulled, again = 2.0 * in_half + 0.5, decoder.read(half, in_half, allowed)
        return reading.joined(again), np.concatenate([quads, pulled])


def large_aligned(
    image: Float32Array, corners: FloatArray, ids: IntArray, decoder: Decoder, *, predicted: bool = False
) -> FloatArray:
    """Corners (N, 4, 2) of markers ``ids`` (N,), those of large ones moved to where their patterns are.

    Cells are read in their middles: outlines that are off by a quarter of a cell are as similar as right ones. Sides
    are found from a few pixels away. ``predicted``: of :func:`aligned`.
    """
    at, corners = corners, corners.copy()
    wider = np.maximum(sides_px(corners) / (_ALIGNED_PX * decoder.cells), 1.0)
    halvings = np.floor(np.log2(wider)).astype(np.int64)
    for number in range(1, halvings.max(initial=0) + 1):
        image, at = halved(image), halfway(at)
        which = np.flatnonzero(halvings == number)
        if len(which):
            upright = np.zeros(len(which), dtype=np.int64)
            there = aligned(image, at[which], ids[which], upright, decoder, _STEPS, predicted=predicted)
            corners[which] += 2.0**number * (there - at[which])
    return corners


def _with_shrunk(outlines: FloatArray, cells: int) -> FloatArray:
    """Outlines (Q, 4, 2), and those of the markers in them if they are plates with a margin of one cell, or of two.

    Alignment makes up for half a cell. Two cells are tried for small markers alone: the borders of larger ones show.
    """
    if len(outlines) == 0:
        return outlines
    inner = shrunk(outlines, cells, 2.0)
    small = inner[sides_px(inner) < _MERGED_PX * cells]
    return np.concatenate([outlines, shrunk(outlines, cells, 1.0), small])


def _chosen(reading: Reading, quads: FloatArray, places: IntArray, noise: float) -> Outlines:
    """Markers at indices ``places`` of the quadrilaterals, corners ordered from the marker's first one."""
    turned = (np.arange(4) - reading.turns[places][:, None]) % 4
    corners = np.take_along_axis(quads[places], turned[..., None], axis=1)
    return Outlines(reading.ids[places], corners, reading.contrast[places] / noise)


def _rough(reading: Reading, quads: FloatArray, found_ids: IntArray) -> IntArray:
    """Indices of the best doubtful reading of each ID, away from clear readings: its outline may be inaccurate.

    IDs that are among ``found_ids`` or that have a clear reading are left out.
    """
    similarity = np.abs(reading.correlation)
    clear = similarity >= _CLEAR
    hinted = (similarity >= _HINT) & (similarity - reading.runner_up >= _HINT_MARGIN)
    hinted &= ~among(reading.ids, np.concatenate([reading.ids[clear], found_ids]))
    places = np.flatnonzero(hinted)[np.argsort(-similarity[hinted], kind='stable')]
    places = places[np.unique(reading.ids[places], return_index=True)[1]]
    centre, across = quads.mean(axis=1), diagonals(quads[clear])
    distance = np.linalg.norm(centre[places, None] - centre[clear], axis=-1)
    return np.asarray(places[(distance > 0.5 * across).all(axis=1)])


def distinct(reading: Reading, noise: float, config: ArucoDetectorConfig) -> BoolArray:
    """Which readings pass the limits of correlation, margin and contrast."""
    return reading.clear(config.min_correlation, config.min_margin, config.min_contrast * noise)


def accepted(reading: Reading, noise: float, correctable: int, config: ArucoDetectorConfig) -> BoolArray:
    """Which readings suffice for a marker that was not predicted: also few wrong bits, and white surroundings."""
    right = (reading.bit_errors <= correctable) & (reading.surround >= config.min_surround)
    return np.asarray(distinct(reading, noise, config) & right)


def overlapped(reading: Reading, quads: FloatArray, good: BoolArray, readable: BoolArray) -> BoolArray:
    """Which good readings (Q,) are at the place of a more similar one, which is the marker there.

    That is one of opposite polarity, good or only ``readable``, of which they are the plate or inner bits, or a good
    one of another ID, of which they are an inaccurate outline.
    """
    mine, others = np.flatnonzero(good), np.flatnonzero(readable | good)
    similarity, centre = np.abs(reading.correlation), quads.mean(axis=1)
    across = diagonals(quads)
    apart = np.linalg.norm(centre[mine, None] - centre[others], axis=-1)
    together = apart < TOGETHER * np.maximum(across[mine, None], across[others])
    opposite = reading.correlation[mine, None] * reading.correlation[others] < 0.0
    different = (reading.ids[mine, None] != reading.ids[others]) & good[others]
    result = np.zeros(len(good), dtype=bool)
    result[mine] = (together & (opposite | different) & (similarity[others] > similarity[mine, None])).any(axis=1)
    return result


def _once(reading: Reading, quads: FloatArray, good: BoolArray, drop_duplicates: bool) -> IntArray:
    """Index of the best reading of every ID; IDs at two places are left out if ``drop_duplicates``."""
    similarity = np.abs(reading.correlation)
    across = diagonals(quads)
    centre = quads.mean(axis=1)
    best = []
    for marker_id in np.unique(reading.ids[good]).tolist():
        same = np.flatnonzero(good & (reading.ids == marker_id))
        clearest = same[similarity[same].argmax()]
        apart = np.linalg.norm(centre[same] - centre[clearest], axis=-1) > 0.5 * across[clearest]
        if not (drop_duplicates and apart.any()):
            best.append(clearest)
    return np.array(best, dtype=np.int64)
