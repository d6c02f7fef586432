"""Corners of markers that are too small for their sides to be measured one by one.

Where a cell is hardly wider than the blur, the columns of pixels across a side show all of the marker's edges at once.
Its whole pattern is fitted to the picture then, and it has to show clearly there, since nothing of its sides confirms
it. That speaks for itself only where the markers of a dictionary differ in many bits.
"""

from dataclasses import replace

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.alignment import aligned
from thermal_fiducial.core.detection.confirmation import speaks_for_itself
from thermal_fiducial.core.detection.corners.refinement import RefinedCorners
from thermal_fiducial.core.detection.decoding import Decoder
from thermal_fiducial.core.detection.found import Found
from thermal_fiducial.core.detection.frame import Frame
from thermal_fiducial.core.detection.refining import RefinedMarkers, sides_px
from thermal_fiducial.core.detection.search import accepted
from thermal_fiducial.core.types import BoolArray

# Widest cells of such markers [px].
_WIDEST_CELL_PX = 2.5
# Deviation of a corner by the pattern, in cells.
_DEVIATION_CELLS = 0.2
_BORDER_PX = 1.0


def with_corners_by_pattern(
    frame: Frame,
    found: Found,
    refined: RefinedMarkers,
    lost: BoolArray,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> tuple[RefinedMarkers, BoolArray]:
    """Refined corners with those by the pattern of small ones among the ``lost`` (N,), and which (N,) these are."""
    cell = sides_px(found.corners_px) / decoder.cells
    small = np.flatnonzero(lost & (cell < _WIDEST_CELL_PX))
    by_pattern = np.zeros(len(lost), dtype=bool)
    if len(small) == 0:
        return refined, by_pattern
    shift, upright = refined.view.shift[small], np.zeros(len(small), dtype=np.int64)
    corners = aligned(frame.image, found.corners_px[small] + shift, found.ids[small], upright, decoder, noisy=False)
    reading = decoder.read(frame.image, corners)
    good = (reading.ids == found.ids[small]) & (reading.turns == 0) & speaks_for_itself(reading, decoder)
    good &= accepted(reading, frame.noise, decoder.correctable, config)
    good &= frame.camera.contains(corners, _BORDER_PX).all(axis=1)
    which, corners, shift = small[good], corners[good], shift[good]
    by_pattern[which] = True
    covariances = (_DEVIATION_CELLS * cell[which, None, None, None]) ** 2 * np.broadcast_to(np.eye(2), (4, 2, 2))
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
            places=refined.places.moved(refined.places.at.at_pixels(px)),
        ),
        by_pattern,
    )
