"""Confirms markers at their refined corners, by the correlation of their pattern and the sharpness of their sides.

In pictures for a display, markers whose cells are hardly wider than the blur are refined by fitting the whole pattern,
as single sides cannot be measured. That is only safe with dictionaries whose markers differ in many bits.
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

# Cells at least this wide are decoded at half resolution, with half the noise and less blur [px].
_WIDE_CELL_PX = 8.0
# Least correlation at the refined corners.
_SIMILAR = 0.82
# Least correlation in a picture for a display, and for faint markers there a smaller one that grows with the contrast.
# Everyday textures resemble patterns of few bits: of 19 false positives of four such dictionaries in 100 pictures the
# best had 0.90.
_SIMILAR_IN_PICTURE, _FAINT, _PER_CNR = 0.92, 0.7, 0.07
# Least margin over the runner-up, as a share of the marker's isolation. It suffices for dictionaries that correct at
# least _MANY_BITS wrong bits; noise and clutter often resemble one of the patterns of a 4 x 4 dictionary a little.
_CLEAR_MARGIN = 0.5
_MANY_BITS = 3
# Range of the step from border to surroundings over the contrast: white surroundings are about as white as white bits,
# the background behind a plate's edge is not.
_WHITE = (0.4, 1.75)
# Largest corner standard deviation [px] times contrast-to-noise ratio times root of the side [px]: 4 to 7 for four
# sharp sides.
_SHARP = 7.5
# Contrast-to-noise ratio above which model errors dominate the noise of corners.
_NOISY = 8.0
# Length of a side up to which the refinement uses all of its pixels [px].
_SEEN_PX = 60.0
# Widest cells of markers too small for their sides to be measured [px].
_WIDEST_CELL_PX = 2.5
#: Distance from the image's border below which a marker, by its refined corners, counts as possibly cut off [px].
BORDER_PX = 1.0


def confirmed(
    image: Float32Array,
    to_tails: FloatArray | None,
    found: FoundMarkers,
    there: FloatArray,
    refined: RefinedCorners,
    decoder: Decoder,
    config: ArucoDetectorConfig,
    *,
    standing_picture: BoolArray,
) -> BoolArray:
    """Which markers (N,) show their pattern at the refined corners, with sides as sharp as their contrast allows.

    Noise and clutter that happen to correlate with a pattern have no four straight sharp sides: the standard deviations
    of their corners are far larger than contrast, noise and size of a marker explain.

    Parameters
    ----------
    to_tails : (N, 2, 3) maps from pixels to lag tails, which are removed; None: none are
    there : (N, 4, 2) predicted corners in the image [px]
    standing_picture : (N,) which are in a picture for a display, without motion blur
    """
    if len(found.ids) == 0:
        return np.zeros(0, dtype=bool)
    tails = None
    if to_tails is not None:
        tails = refined.corners_px @ to_tails[:, :, :2].swapaxes(1, 2) + to_tails[:, None, :, 2]
    reading = _read(image, refined.corners_px, tails, decoder)
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


def _read(image: Float32Array, quads: FloatArray, lag_tails: FloatArray | None, decoder: Decoder) -> Reading:
    """Readings of quadrilaterals (Q, 4, 2), at half resolution if all are large enough."""
    sides = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=-1)
    if sides.min() < _WIDE_CELL_PX * decoder.cells:
        return decoder.read(image, quads, lag_tails=lag_tails)
    half_tails = None if lag_tails is None else halfway(lag_tails)
    return decoder.read(halved(image), halfway(quads), lag_tails=half_tails)


def speaks_for_itself(reading: Reading, decoder: Decoder) -> BoolArray:
    """Which readings (N,) suffice without sharp sides: clear margin, white surroundings, a dictionary of many bits."""
    return np.asarray(_stands_out(reading, decoder) & (decoder.correctable >= _MANY_BITS))


def _stands_out(reading: Reading, decoder: Decoder) -> BoolArray:
    """Which readings (N,) have a clear margin over other markers and white surroundings."""
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
    """Refined corners, those of small ``lost`` (N,) markers replaced by a pattern fit; which (N,) were replaced."""
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
