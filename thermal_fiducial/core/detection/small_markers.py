"""Corners of small markers in pictures for a display, by their whole patterns, where these are evidence enough."""

import math

import numpy as np

from thermal_fiducial.core.detection.corner_errors import OF_PATTERN_PX
from thermal_fiducial.core.detection.frame import Frame
from thermal_fiducial.core.detection.known_markers import FoundMarkers
from thermal_fiducial.core.detection.pattern_fit import fit_patterns, PatternFit
from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.refined_corners import RefinedCorners, sides_px
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Cells below which the whole pattern is fitted, as they are hardly wider than the blur of their sides [px].
_WIDEST_CELL_PX = 2.5
# Bound on the number of false markers in a picture, were all of it squares with a black border around random bits.
_FALSE_MARKERS = 0.01


def too_small_for_sides(corners_px: FloatArray, cells: int) -> BoolArray:
    """Which markers (N, 4, 2) have sides in a picture that are not measured by themselves."""
    return np.asarray(sides_px(corners_px) < _WIDEST_CELL_PX * cells)


def fitted_patterns(
    frame: Frame, found: FoundMarkers, shown_px: FloatArray, decoder: Decoder, blur_px: float
) -> tuple[IntArray, RefinedCorners]:
    """Places of the small markers among those ``found`` (N,) whose patterns are there, and their corners.

    Parameters
    ----------
    shown_px : (N, 4, 2) corners in the image, with lag tails, accurate to half a cell
    blur_px : standard deviation of the blur of optics and pixels
    """
    small = np.flatnonzero(too_small_for_sides(shown_px, decoder.cells))
    if len(small) == 0:
        return small, RefinedCorners.none()
    fit = fit_patterns(frame.image, shown_px[small], found.ids[small], decoder, blur_px)
    good = _evident(fit, found.expected[small], frame, decoder)
    covariances = fit.covariances[good] + OF_PATTERN_PX**2 * np.eye(2)
    contrast, noise = fit.contrast[good], fit.noise[good]
    corners = RefinedCorners(
        fit.corners_px[good], covariances, contrast, noise, np.zeros(len(noise)), np.ones(len(noise), dtype=bool)
    )
    return small[good], corners


def _evident(fit: PatternFit, expected: BoolArray, frame: Frame, decoder: Decoder) -> BoolArray:
    """Which fits (N,) are evidence enough, of all markers and places that might be one by chance."""
    height, width = frame.image.shape
    places = np.where(expected, 1.0, height * width / np.maximum(sides_px(fit.corners_px) ** 2, 1.0))
    tried = 4.0 * decoder.count * places
    return np.asarray((fit.evidence > np.log(tried / _FALSE_MARKERS)) & (fit.lead > -math.log(_FALSE_MARKERS)))
