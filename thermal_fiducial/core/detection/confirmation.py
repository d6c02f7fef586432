"""Confirms markers at their refined corners.

A marker is confirmed by the correlation of its pattern. Those whose cells are hardly wider than the blur are confirmed
by the evidence of the fit of their pattern, or like the others.
"""

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.corner_errors import BLURRED_OUT
from thermal_fiducial.core.detection.corners.refining import RefinedMarkers
from thermal_fiducial.core.detection.finding.quads import halfway, halved
from thermal_fiducial.core.detection.patterns import Decoder, Reading
from thermal_fiducial.core.detection.prediction.frame import Frame, lag_tail_places
from thermal_fiducial.core.detection.prediction.known_markers import FoundMarkers
from thermal_fiducial.core.geometry.camera import ImagePoints
from thermal_fiducial.core.geometry.planar_pose import planar_poses
from thermal_fiducial.core.geometry.reprojection import narrow_sides, sides_px
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray

# Cells at least this wide are decoded at half resolution, with half the noise and less blur [px].
_WIDE_CELL_PX = 8.0
# Least correlation at the refined corners, and in a clear image of cells so narrow [px] that their edges blur together:
# of 480 squares of 8 to 14 px with other bits 5 would be markers by 0.82.
_SIMILAR, _SIMILAR_IF_CLEAR, _NARROW_PX = 0.82, 0.92, 3.0
# Distance of the edges between cells from where the pattern has them, rms [cells], which nothing in a clear image
# explains. Rendered markers have less than 0.04, in equalised pictures less than 0.08, through plates of 5 % of their
# size at 57 deg about 0.15; nine of ten windows in panels that correlate by 0.82 or more have more.
_OFF_GRID_CELLS = 0.15
# Least margin over the runner-up, as a share of the marker's isolation. It suffices for dictionaries that correct at
# least _MANY_BITS wrong bits; noise and clutter often resemble one of the patterns of a 4 x 4 dictionary a little.
_CLEAR_MARGIN = 0.5
_MANY_BITS = 3
# Range of the step from border to surroundings over the contrast: white surroundings are about as white as white bits,
# the background behind a plate's edge is not. By the fit of its sides, a whole marker has 0.84 to 1.06 of it, one of
# which a tenth is covered seldom less than 0.57; where there are no sides, 7 of 10 fits have less than 0.3.
_WHITE = (0.4, 1.75)
# Distance from the image's border below which a marker, by its refined corners, counts as possibly cut off [px].
_BORDER_PX = 1.0
# Distance from the nearest view of a square beyond which an outline is no marker's, rms [cells]. Bent sheets in photos
# by a lens whose distortion is unknown are off by up to 0.05.
_OFF_SQUARE_CELLS = 0.1
# Standard deviations of its corners that are allowed for besides.
_SIGMAS = 3.0
# Displacement or standard deviation of blur that cells are read in spite of [cells].
_LITTLE = 0.1


def confirmed(
    frame: Frame,
    found: FoundMarkers,
    markers: RefinedMarkers,
    decoder: Decoder,
    config: ArucoDetectorConfig,
) -> RefinedMarkers:
    """The markers ``found`` that show their pattern at the refined corners and are squares."""
    corners = markers.observed.corners_px
    predicted = found.places.points.px + markers.blur.shift
    off_cells = np.abs(corners - predicted).max(axis=(1, 2)) * decoder.cells / sides_px(predicted)
    keep = ((off_cells < _LITTLE) & found.certain) | markers.observed.evident
    others = np.flatnonzero(~keep & ~markers.observed.refuted)
    if len(others):
        keep[others] = _readable(frame, markers.only(others), found.expected[others], decoder, config)
    keep &= frame.camera.contains(corners, _BORDER_PX).all(axis=1)
    doubtful = np.flatnonzero(keep & (markers.observed.doubt > 0.0))
    if len(doubtful):
        # By the noise of the pixels alone: a pattern that is none leaves more, and that would excuse the outline.
        own = np.minimum(frame.noise / markers.observed.noise[doubtful], 1.0) ** 2
        variance = own * markers.observed.mean_variance[doubtful]
        keep[doubtful] = _square(ImagePoints.at(corners[doubtful], frame.camera), variance, decoder.cells)
    return markers if keep.all() else markers.only(keep)


def _square(corners: ImagePoints, variance: FloatArray, cells: int) -> BoolArray:
    """Which outlines (N, 4), with corners of a ``variance`` (N,) [px^2], are about those of squares in space.

    The constraints of :mod:`corners.squares` measure no distance in the image: a tilt hardly changes a small square, so
    that corners 0.3 px off miss them by 0.1, or 6 px in a side of 60.
    """
    count = len(corners.px)
    poses = planar_poses(corners, np.tile(np.eye(2), (count, 4, 1, 1)), np.ones(count))
    off_square = _OFF_SQUARE_CELLS / cells * sides_px(corners.px)
    return np.asarray(poses.rms_px[:, 0] ** 2 <= off_square**2 + _SIGMAS**2 * variance)


def _readable(
    frame: Frame, markers: RefinedMarkers, expected: BoolArray, decoder: Decoder, config: ArucoDetectorConfig
) -> BoolArray:
    """Which markers (N,) are decoded at the refined corners; ``expected`` ones (N,) need less evidence."""
    blur, corners = markers.blur, markers.observed.corners_px
    tails = None
    if blur.to_tails is not None:
        tails = lag_tail_places(corners.transpose(2, 0, 1), blur.to_tails).transpose(1, 2, 0)
    reading = _read(frame.image, corners, tails, decoder)
    known = expected & reading.clear(config.guided_min_correlation, config.guided_min_margin)
    cell_px = sides_px(corners) / decoder.cells
    still = np.sqrt(np.sum(blur.spread**2, axis=1)) < _LITTLE * cell_px
    # Neither blur nor noise moves an edge there.
    sharp = markers.observed.noise < BLURRED_OUT * np.abs(markers.observed.contrast)
    clear = still & (frame.displayed | sharp)
    least = np.where(clear & (cell_px < _NARROW_PX), _SIMILAR_IF_CLEAR, _SIMILAR)
    similar = np.abs(reading.correlation) >= least
    similar &= ~clear | (decoder.off_grid(frame.image, corners, markers.ids) < _OFF_GRID_CELLS)
    distinct = (similar | (decoder.correctable >= _MANY_BITS)) & _stands_out(reading, decoder)
    # Where the fit found no sides, corners are where it began, and their covariance is that of its prior. What was not
    # expected has passed limits of its surroundings before.
    step = markers.observed.contrast * np.sign(reading.contrast)
    on_sides = (step >= _WHITE[0] * np.abs(reading.contrast)) | ~expected
    return np.asarray((reading.ids == markers.ids) & (known | distinct) & on_sides)


def _read(image: Float32Array, quads: FloatArray, lag_tails: FloatArray | None, decoder: Decoder) -> Reading:
    """Readings of quadrilaterals (Q, 4, 2), at half resolution if all are large enough."""
    if narrow_sides(quads).min() < _WIDE_CELL_PX * decoder.cells:
        return decoder.read(image, quads, lag_tails=lag_tails)
    half_tails = None if lag_tails is None else halfway(lag_tails)
    return decoder.read(halved(image), halfway(quads), lag_tails=half_tails)


def _stands_out(reading: Reading, decoder: Decoder) -> BoolArray:
    """Which readings (N,) have a clear margin over other markers and white surroundings."""
    margin = (np.abs(reading.correlation) - reading.runner_up) / decoder.isolation[reading.ids]
    white = (reading.surround >= _WHITE[0]) & (reading.surround <= _WHITE[1])
    return np.asarray((margin >= _CLEAR_MARGIN) & white)
