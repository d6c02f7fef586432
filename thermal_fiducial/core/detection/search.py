"""Blind search for markers in a frame."""

from dataclasses import dataclass, fields
from enum import auto, Flag

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.alignment import aligned
from thermal_fiducial.core.detection.contrast import dark, halved, Scale, without_columns
from thermal_fiducial.core.detection.corners.refinement import RefinedCorners
from thermal_fiducial.core.detection.decoding import Decoder, Reading, shrunk
from thermal_fiducial.core.detection.ids import among
from thermal_fiducial.core.detection.quads import find_quads
from thermal_fiducial.core.detection.scratch import Scratch
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Full resolution sees small and smeared markers; half resolution, without the pattern of columns, faint ones.
_FINE = Scale(smoothing_px=1.0, window_px=7, window_shrink=2, depth=0.2, floor=1.5)
_FAINT = Scale(smoothing_px=1.2, window_px=5, window_shrink=1, depth=0.03, floor=1.0)
# Among markers that are seen clearly noise is left alone, and with it what it would show of the faintest.
_FINE_OF_CLEAR = _FINE._replace(floor=4.0)
_FAINT_OF_CLEAR = _FAINT._replace(floor=4.0)
# Weight of white surroundings against correlation in choosing among the outlines of a marker.
_SURROUNDED = 0.2
# Correlation beyond which an outline needs no alignment, and from which, by such a margin, it is worth one.
_CLEAR = 0.95
_HINT, _HINT_MARGIN = 0.5, 0.06
# Cells at least this wide are read at half the resolution, where a pixel has half the noise.
_WIDE_CELL_PX = 8.0
# Correlation at the refined corners: of a marker with sharp sides, and (less when faint) of one with softer sides.
_ALIKE = 0.82
_CLEARLY_ALIKE = 0.9
# Share of a marker's isolation by which it must stand out among all others. That speaks for itself where markers differ
# in so many bits that this many wrong ones can be corrected; noise and clutter often look a little like one of the few
# patterns of a 4 x 4 dictionary.
_CLEAR_MARGIN = 0.5
_MANY_BITS = 3
# Middles of outlines of one marker, in one another, are nearer than this share of the larger one's diagonal.
_TOGETHER = 0.35
# White surroundings are as white as white bits, give or take the background; the rim of a plate seen inside out is not.
_WHITE = (0.4, 1.75)
# Corner deviation [px] times contrast over noise times root of the side [px]: 4 to 7 for four clean sides.
_SHARP = 7.5
_SOFT = 12.0
# Contrast over noise beyond which corners deviate by what optics and plates really are, and not by noise.
_NOISY = 8.0
# Width of a plate round its marker [cells], and what smear may add.
_PLATE_CELLS = 1.6
# Nearer to the rim of the image than this [px] a marker may be cut off.
_RIM = 2.0
_NONE = np.zeros(0, dtype=np.intp)
# Pixels along a side that the refinement uses of a long one.
_SEEN_PX = 60.0


class Sought(Flag):
    """At which resolutions markers are sought."""

    FINE = auto()
    FAINT = auto()
    ALL = FINE | FAINT


@dataclass(frozen=True, slots=True)
class Found:
    """Markers that a search found.

    Parameters
    ----------
    ids : (N,)
    corners_px : (N, 4, 2) clockwise from the marker's top-left, to a pixel or two
    clarity : (N,) contrast over the noise of a pixel, negative where black is warmer than white
    expected : (N,) whether it was sought where it was found
    """

    ids: IntArray
    corners_px: FloatArray
    clarity: FloatArray
    expected: BoolArray

    def only(self, keep: BoolArray | IntArray) -> 'Found':
        """Those of the markers ``keep``."""
        return Found(self.ids[keep], self.corners_px[keep], self.clarity[keep], self.expected[keep])

    @staticmethod
    def none() -> 'Found':
        """No markers."""
        return Found(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 2)), np.zeros(0), np.zeros(0, dtype=bool))


class BlindSearch:
    """Finds the markers of a dictionary wherever they are.

    Parameters
    ----------
    decoder : of the dictionary
    scratch : for its images
    """

    def __init__(self, decoder: Decoder, scratch: Scratch) -> None:
        self._decoder, self._scratch = decoder, scratch

    def search(
        self,
        image: Float32Array,
        noise: float,
        scene: Float32Array,
        allowed: BoolArray,
        config: ArucoDetectorConfig,
        seen: Found | None = None,
        sought: Sought = Sought.ALL,
        kinds: tuple[float, ...] = (1.0, -1.0),
    ) -> Found:
        """Markers with IDs ``allowed`` (M,), each ID once.

        Parameters
        ----------
        image : (height, width) the frame
        noise : standard deviation of a pixel in it [counts]
        scene : the same freed of lag, which costs noise: the finest markers are sought there, the faintest in ``image``
        seen : markers that are there: nothing is sought in them and their plates
        sought : at which resolutions
        kinds : of markers sought among the faintest, 1 for darker than their surroundings, -1 for brighter
        """
        decoder = self._decoder
        seen = Found.none() if seen is None else seen
        hidden = _grown(seen.corners_px, 1.0 + 2.0 * _PLATE_CELLS / decoder.cells)
        fine = faint = np.zeros((0, 4, 2))
        if Sought.FINE in sought:
            scale = _FINE if sought == Sought.ALL else _FINE_OF_CLEAR
            fine = find_quads(dark(scene, noise, scale, self._scratch), config.min_side_px, hidden)
        half = image
        if Sought.FAINT in sought:
            half = without_columns(halved(image, self._scratch), 0.5 * noise, self._scratch)
            views = [half if kind > 0.0 else -half for kind in kinds]
            scale = _FAINT if sought == Sought.ALL else _FAINT_OF_CLEAR
            faint = np.concatenate([self._faint(view, noise, scale, config.min_side_px, hidden) for view in views])
        if len(fine) + len(faint) == 0:
            return Found.none()
        # Blur may leave nothing to be seen of a border between two white ones but the outline of the whole plate.
        fine, faint = (_with_shrunk(outlines, decoder.cells) for outlines in (fine, faint))
        quads = np.concatenate([fine, faint])
        reading = _joined(decoder.read(scene, fine, allowed), decoder.read(half, _halfway(faint), allowed))
        # At full resolution alone those are sought that show clearly, if not now then in a frame to come.
        rough = _rough(reading, quads, seen.ids) if Sought.FAINT in sought else _NONE
        if len(rough):
            better = aligned(half, _halfway(quads[rough]), reading.ids[rough], reading.turns[rough], decoder)
            reading = _joined(reading, decoder.read(half, better, allowed))
            quads = np.concatenate([quads, 2.0 * better + 0.5])
        good = accepted(reading, noise, decoder.correctable, config) & _large(quads, config.min_side_px)
        good &= _whole(quads, image, _RIM)
        if not good.any():
            return Found.none()
        good &= ~_inside_out(reading, quads, good, distinct(reading, noise, config))
        return _chosen(reading, quads, _once(reading, quads, good, config.duplicates == 'drop'), noise)

    def _faint(
        self, half: Float32Array, noise: float, scale: Scale, min_side_px: float, hidden: FloatArray
    ) -> FloatArray:
        """Quadrilaterals of faint markers (Q, 4, 2) at half the resolution, in pixels of the full one."""
        mask = dark(half, 0.5 * noise, scale, self._scratch)
        return 2.0 * find_quads(mask, 0.5 * min_side_px + 2.0, _halfway(hidden)) + 0.5


def _with_shrunk(outlines: FloatArray, cells: int) -> FloatArray:
    """Quadrilaterals (Q, 4, 2), and what would be a marker in each if it were a plate."""
    return np.concatenate([outlines, shrunk(outlines, cells)]) if len(outlines) else outlines


def _large(quads: FloatArray, min_side_px: float) -> BoolArray:
    """Which quadrilaterals (Q, 4, 2) have no shorter side."""
    span = quads[:, [1, 2, 3, 0]] - quads
    return np.asarray((np.sum(span * span, axis=-1) >= min_side_px**2).all(axis=1))


def _chosen(reading: Reading, quads: FloatArray, places: IntArray, noise: float) -> Found:
    """The markers at ``places`` among the quadrilaterals, their corners from the marker's own first one."""
    turned = (np.arange(4) - reading.turns[places][:, None]) % 4
    corners = np.take_along_axis(quads[places], turned[..., None], axis=1)
    return Found(reading.ids[places], corners, reading.contrast[places] / noise, np.zeros(len(places), dtype=bool))


def _halfway(quads: FloatArray) -> FloatArray:
    """Corners (..., 2) in pixels of half the resolution."""
    return 0.5 * (quads - 0.5)


def _grown(quads: FloatArray, factor: float) -> FloatArray:
    """Quadrilaterals (N, 4, 2) larger by a factor about their middles."""
    middle = 0.25 * quads.sum(axis=1, keepdims=True)
    return np.asarray(middle + factor * (quads - middle))


def _rough(reading: Reading, quads: FloatArray, seen: IntArray) -> IntArray:
    """Places of the best readings of IDs that show, but not clearly, where none does: their outlines may be off.

    IDs that are ``seen`` already need no other place.
    """
    similarity = np.abs(reading.correlation)
    clear = similarity >= _CLEAR
    hinted = (similarity >= _HINT) & (similarity - reading.runner_up >= _HINT_MARGIN)
    hinted &= ~among(reading.ids, np.concatenate([reading.ids[clear], seen]))
    places = np.flatnonzero(hinted)[np.argsort(-similarity[hinted], kind='stable')]
    places = places[np.unique(reading.ids[places], return_index=True)[1]]
    centre, across = quads.mean(axis=1), np.linalg.norm(quads[clear, 2] - quads[clear, 0], axis=-1)
    distance = np.linalg.norm(centre[places, None] - centre[clear], axis=-1)
    return np.asarray(places[(distance > 0.5 * across).all(axis=1)])


def _joined(first: Reading, second: Reading) -> Reading:
    names = [item.name for item in fields(Reading)]
    return Reading(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def merged(first: Found, second: Found) -> Found:
    """All markers of ``first``, and those of ``second`` that it does not have and that lie elsewhere."""
    if len(second.ids) == 0:
        return first
    apart = np.linalg.norm(second.corners_px.mean(axis=1)[:, None] - first.corners_px.mean(axis=1), axis=-1)
    extent = np.linalg.norm(first.corners_px[:, 2] - first.corners_px[:, 0], axis=-1)
    new = ~among(second.ids, first.ids) & (apart > 0.35 * extent).all(axis=1)
    return Found(
        np.concatenate([first.ids, second.ids[new]]),
        np.concatenate([first.corners_px, second.corners_px[new]]),
        np.concatenate([first.clarity, second.clarity[new]]),
        np.concatenate([first.expected | among(first.ids, second.ids[second.expected]), second.expected[new]]),
    )


def distinct(reading: Reading, noise: float, config: ArucoDetectorConfig) -> BoolArray:
    """Which readings look like one marker of the dictionary, whatever the bits and sides are like."""
    similarity = np.abs(reading.correlation)
    return np.asarray(
        (similarity >= config.min_correlation)
        & (similarity - reading.runner_up >= config.min_margin)
        & (np.abs(reading.contrast) >= config.min_contrast * noise)
    )


def accepted(reading: Reading, noise: float, correctable: int, config: ArucoDetectorConfig) -> BoolArray:
    """Which readings are evidence enough for a marker nobody expected."""
    bits = config.max_bit_errors if config.max_bit_errors >= 0 else correctable
    return np.asarray(
        distinct(reading, noise, config)
        & (reading.bit_errors <= bits)
        & (reading.border_errors <= config.max_border_errors)
        & (reading.surround >= config.min_surround)
    )


def _inside_out(reading: Reading, quads: FloatArray, good: BoolArray, readable: BoolArray) -> BoolArray:
    """Which good readings (Q,) are of a plate's rim or of bits: at a more similar readable one of other polarity."""
    mine, others = np.flatnonzero(good), np.flatnonzero(readable)
    similarity, centre = np.abs(reading.correlation), quads.mean(axis=1)
    across = np.linalg.norm(quads[:, 2] - quads[:, 0], axis=-1)
    apart = np.linalg.norm(centre[mine, None] - centre[others], axis=-1)
    together = apart < _TOGETHER * np.maximum(across[mine, None], across[others])
    opposite = reading.correlation[mine, None] * reading.correlation[others] < 0.0
    result = np.zeros(len(good), dtype=bool)
    result[mine] = (together & opposite & (similarity[others] > similarity[mine, None])).any(axis=1)
    return result


def confirmed(
    image: Float32Array,
    scratch: Scratch,
    found: Found,
    refined: RefinedCorners,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> BoolArray:
    """Which markers (N,) still look like themselves at their refined corners, with sides as sharp as their contrast.

    Noise and clutter that happen to correlate with a pattern have no four straight sharp sides: their corners are far
    less certain than contrast, noise and size of a marker make them.
    """
    if len(found.ids) == 0:
        return np.zeros(0, dtype=bool)
    reading = read_quads(image, scratch, refined.corners_px, decoder)
    similarity = np.abs(reading.correlation)
    contrast = np.abs(refined.contrast) / np.maximum(refined.noise, 1e-6)
    same = reading.ids == found.ids
    margin = (similarity - reading.runner_up) / decoder.isolation[reading.ids]
    distinct = (similarity >= _ALIKE) | (decoder.correctable >= _MANY_BITS)
    white = (reading.surround >= _WHITE[0]) & (reading.surround <= _WHITE[1])
    alike = distinct & (margin >= _CLEAR_MARGIN) & white
    side = np.linalg.norm(refined.corners_px[:, 2] - refined.corners_px[:, 0], axis=-1) / np.sqrt(2.0)
    deviation = np.sort(np.sqrt(0.5 * np.trace(refined.covariances, axis1=-2, axis2=-1)), axis=1)[:, 2]
    softness = deviation * np.minimum(contrast, _NOISY) * np.sqrt(np.minimum(side, _SEEN_PX))
    sharp = softness <= _SHARP
    soft = (softness <= _SOFT) & (similarity >= np.minimum(_CLEARLY_ALIKE, 0.7 + 0.07 * contrast))
    known = (similarity >= config.guided_min_correlation) & (similarity - reading.runner_up >= config.guided_min_margin)
    there = np.abs(refined.corners_px - found.corners_px).max(axis=(1, 2)) < 0.7 * side / decoder.cells
    return np.asarray(same & ((found.expected & known & there) | (alike & (sharp | soft))))


def _whole(quads: FloatArray, image: Float32Array, rim: float) -> BoolArray:
    """Which quadrilaterals (Q, 4, 2) lie in the image, ``rim`` away from its edges."""
    height, width = image.shape
    return np.asarray(((quads >= rim) & (quads <= (width - 1 - rim, height - 1 - rim))).all(axis=(1, 2)))


def read_quads(image: Float32Array, scratch: Scratch, quads: FloatArray, decoder: Decoder) -> Reading:
    """Readings of (Q, 4, 2) among all IDs, at half the resolution when all are large enough for it."""
    everything = np.ones(decoder.count, dtype=bool)
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=-1)
    if sides.min(initial=np.inf) >= _WIDE_CELL_PX * decoder.cells:
        return decoder.read(halved(image, scratch), 0.5 * (quads - 0.5), everything)
    return decoder.read(image, quads, everything)


def _once(reading: Reading, quads: FloatArray, good: BoolArray, drop_duplicates: bool) -> IntArray:
    """Place of the best reading of every ID; of an ID at two places neither, when such are to be dropped."""
    similarity = np.where(good, np.abs(reading.correlation) + _SURROUNDED * np.clip(reading.surround, 0.0, 1.0), 0.0)
    across = np.linalg.norm(quads[:, 2] - quads[:, 0], axis=-1)
    centre = quads.mean(axis=1)
    best = []
    for marker_id in np.unique(reading.ids[good]).tolist():
        same = np.flatnonzero(good & (reading.ids == marker_id))
        clearest = same[similarity[same].argmax()]
        apart = np.linalg.norm(centre[same] - centre[clearest], axis=-1) > 0.5 * across[clearest]
        if not (drop_duplicates and apart.any()):
            best.append(clearest)
    return _alone(np.array(best, dtype=np.int64), similarity, centre, across)


def _alone(places: IntArray, similarity: FloatArray, centre: FloatArray, across: FloatArray) -> IntArray:
    """Of markers that lie in one another the clearest: a plate round a marker may look like another, inside out."""
    order = places[np.argsort(-similarity[places], kind='stable')]
    kept: list[int] = []
    for place in order.tolist():
        distance = np.linalg.norm(centre[kept] - centre[place], axis=-1)
        if np.all(distance > _TOGETHER * np.maximum(across[kept], across[place])):
            kept.append(place)
    return np.array(kept, dtype=np.int64)
