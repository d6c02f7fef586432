"""Whether markers look like themselves where their corners were refined to.

Markers that are too small for their sides to be measured one by one show by their whole pattern. Where a cell is hardly
wider than the blur, the columns of pixels across a side show all of the marker's edges at once: its pattern is fitted
to the picture then. That speaks for itself only where the markers of a dictionary differ in many bits.
"""

from dataclasses import replace

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.alignment import aligned
from thermal_fiducial.core.detection.corner_errors import OF_PATTERN_CELLS
from thermal_fiducial.core.detection.frame import Frame
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.patterns import Decoder, Reading
from thermal_fiducial.core.detection.quads import halfway, halved
from thermal_fiducial.core.detection.refining import RefinedCorners, RefinedMarkers, sides_px
from thermal_fiducial.core.detection.search import accepted
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, TINY

# Cells at least this wide are read at half the resolution, where a pixel has half the noise and less blur.
_WIDE_CELL_PX = 8.0
# Correlation at the refined corners.
_SIMILAR = 0.82
# The same in a picture for a display, less of a faint marker. Textures of everyday things look like patterns of few
# bits there, at contrasts at which a marker is all but free of noise. Of 19 false positives of four such dictionaries
# in 100 pictures the best had 0.90.
_SIMILAR_IN_PICTURE, _FAINT, _PER_CNR = 0.92, 0.7, 0.07
# Share of a marker's isolation by which it must stand out among all others. That speaks for itself where markers differ
# in so many bits that this many wrong ones can be corrected; noise and clutter often look a little like one of the few
# patterns of a 4 x 4 dictionary.
_CLEAR_MARGIN = 0.5
_MANY_BITS = 3
# White surroundings are as white as white bits, give or take the background; the edge of a plate seen inside out is
# not.
_WHITE = (0.4, 1.75)
# Corner deviation [px] times contrast over noise times root of the side [px]: 4 to 7 for four clean sides.
_SHARP = 7.5
# Contrast over noise beyond which corners deviate by what optics and plates really are, and not by noise.
_NOISY = 8.0
# Pixels along a side that the refinement uses of a long one.
_SEEN_PX = 60.0
# Widest cells of markers too small for their sides to be measured [px].
_WIDEST_CELL_PX = 2.5
#: Nearer to the border of the image than this a marker may be cut off, by its refined corners [px].
BORDER_PX = 1.0


def confirmed(
    image: Float32Array,
    found: FoundMarkers,
    there: FloatArray,
    refined: RefinedCorners,
    decoder: Decoder,
    config: ArucoDetectorConfig,
    *,
    standing_picture: BoolArray,
) -> BoolArray:
    """Which markers (N,) still look like themselves at their refined corners, with sides as sharp as their contrast.

    Noise and clutter that happen to correlate with a pattern have no four straight sharp sides: their corners are far
    less certain than contrast, noise and size of a marker make them.

    Parameters
    ----------
    there : (N, 4, 2) where the corners should appear [px]
    standing_picture : (N,) which are seen in a picture for a display, and not blurred by motion
    """
    if len(found.ids) == 0:
        return np.zeros(0, dtype=bool)
    reading = _read(image, refined.corners_px, decoder)
    similarity = np.abs(reading.correlation)
    contrast = np.abs(refined.contrast) / np.maximum(refined.noise, TINY)
    same = reading.ids == found.ids
    asked = np.clip(_FAINT + _PER_CNR * np.abs(found.cnr), _SIMILAR, _SIMILAR_IN_PICTURE)
    distinct = (similarity >= np.where(standing_picture, asked, _SIMILAR)) | (decoder.correctable >= _MANY_BITS)
    alike = distinct & _stands_out(reading, decoder)
    side = np.linalg.norm(refined.corners_px[:, 2] - refined.corners_px[:, 0], axis=-1) / np.sqrt(2.0)
    deviation = np.sort(np.sqrt(0.5 * np.trace(refined.covariances, axis1=-2, axis2=-1)), axis=1)[:, 2]
    softness = deviation * np.minimum(contrast, _NOISY) * np.sqrt(np.minimum(side, _SEEN_PX))
    known = reading.clear(config.guided_min_correlation, config.guided_min_margin)
    near = np.abs(refined.corners_px - there).max(axis=(1, 2)) < 0.7 * side / decoder.cells
    return np.asarray(same & ((found.expected & known & near) | (alike & (softness <= _SHARP))))


def _read(image: Float32Array, quads: FloatArray, decoder: Decoder) -> Reading:
    """Readings of (Q, 4, 2), at half the resolution when all are large enough for it."""
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=-1)
    if sides.min() < _WIDE_CELL_PX * decoder.cells:
        return decoder.read(image, quads)
    return decoder.read(halved(image), halfway(quads))


def speaks_for_itself(reading: Reading, decoder: Decoder) -> BoolArray:
    """Which readings (N,) show a marker beyond doubt, whatever its sides are like."""
    return np.asarray(_stands_out(reading, decoder) & (decoder.correctable >= _MANY_BITS))


def _stands_out(reading: Reading, decoder: Decoder) -> BoolArray:
    """Which readings (N,) are clearly of one marker, in white surroundings."""
    margin = (np.abs(reading.correlation) - reading.runner_up) / decoder.isolation[reading.ids]
    white = (reading.surround >= _WHITE[0]) & (reading.surround <= _WHITE[1])
    return np.asarray((margin >= _CLEAR_MARGIN) & white)


def with_corners_by_pattern(
    frame: Frame,
    found: FoundMarkers,
    refined: RefinedMarkers,
    lost: BoolArray,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> tuple[RefinedMarkers, BoolArray]:
    """Refined corners with those by the pattern of small ones among the ``lost`` (N,), and which (N,) these are."""
    cell = sides_px(found.places.at.px) / decoder.cells
    small = np.flatnonzero(lost & (cell < _WIDEST_CELL_PX))
    by_pattern = np.zeros(len(lost), dtype=bool)
    if len(small) == 0:
        return refined, by_pattern
    shift, upright = refined.blur.shift[small], np.zeros(len(small), dtype=np.int64)
    corners = aligned(frame.image, found.places.at.px[small] + shift, found.ids[small], upright, decoder, noisy=False)
    reading = decoder.read(frame.image, corners)
    good = (reading.ids == found.ids[small]) & (reading.turns == 0) & speaks_for_itself(reading, decoder)
    good &= accepted(reading, frame.noise, decoder.correctable, config)
    good &= frame.camera.contains(corners, BORDER_PX).all(axis=1)
    which, corners, shift = small[good], corners[good], shift[good]
    by_pattern[which] = True
    covariances = (OF_PATTERN_CELLS * cell[which, None, None, None]) ** 2 * np.broadcast_to(np.eye(2), (4, 2, 2))
    contrast, doubt = reading.contrast[good], np.zeros(len(which))
    noise = np.full(len(which), frame.noise)
    observed = RefinedCorners(corners, covariances, contrast, noise, doubt)
    at_stamp = replace(observed, corners_px=corners - shift)
    px = refined.places.at.px.copy()
    px[which] = at_stamp.corners_px
    return (
        replace(
            refined,
            observed=refined.observed.with_others(which, observed),
            corners=refined.corners.with_others(which, at_stamp),
            places=replace(refined.places, at=refined.places.at.at_pixels(px)),
        ),
        by_pattern,
    )
