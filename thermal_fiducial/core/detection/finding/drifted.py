"""Markers of the map that are not near their predictions, as the filter has drifted.

After seconds without markers, predictions are off by more than the half cell that is tried around them. Then the marker
that the image resembles most, as far from its prediction as the covariance of the predicted camera allows, is taken for
right; with it the others are predicted anew, and have to be near. They are found if the evidence of all of them
together is enough for as many places as were looked at. So markers are found again that are too small, too blurred or
too faint for their outlines to show.

Source: J. Civera, O. Grasa, A. Davison, J. Montiel, "1-Point RANSAC for EKF Filtering", Journal of Field Robotics 2010.
"""

import math

import numpy as np

from thermal_fiducial.core.detection.finding.quads import halved
from thermal_fiducial.core.detection.finding.template_matching import halvings, MarkerTemplate
from thermal_fiducial.core.detection.patterns import Decoder, NEAR_CELLS
from thermal_fiducial.core.geometry.reprojection import sides_px
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# Standard deviations of a prediction within which a marker is looked for.
_SIGMAS = 3.0
# Standard deviation of a match along an axis [cells].
_OF_MATCH = 0.3
# Bound on the number of false finds in a search, were all of the image squares with a border around random bits.
_FALSE_FINDS = 0.001


def drifted_markers(
    image: Float32Array,
    ids: IntArray,
    corners: FloatArray,
    flow: FloatArray,
    of_camera: FloatArray,
    farthest_px: float,
    kinds: tuple[float, ...],
    decoder: Decoder,
) -> tuple[BoolArray, FloatArray]:
    """Which of N markers the image shows away from their predictions, and where.

    Parameters
    ----------
    image : (height, width) counts or gray levels
    ids, corners : (N,), (N, 4, 2) of markers, as predicted [px]
    flow : (N, 2, 6) derivative of their centres by a displacement of the camera in its axes, position first [px/m, rad]
    of_camera : (6, 6) covariance of that displacement
    farthest_px : largest distance that is searched
    kinds : polarities, 1 for markers darker than their surroundings, -1 for brighter

    Returns
    -------
    (N,), and (N, 4, 2) corners, accurate to half a cell
    """
    cells = sides_px(corners) / decoder.cells
    reach = np.minimum(_SIGMAS * _stds_px(flow, of_camera), farthest_px)
    if (reach < NEAR_CELLS.max() * cells[:, None]).all():
        return np.zeros(len(ids), dtype=np.bool_), corners
    images = [image]
    for _ in range(halvings(cells.max())):
        images.append(halved(images[-1]))
    views = zip(ids.tolist(), corners, reach, strict=True)
    templates = [MarkerTemplate(images, *view, kinds, decoder) for view in views]
    alone = [template.best(np.zeros(2), near) for template, near in zip(templates, reach, strict=True)]
    variances = (_OF_MATCH * cells) ** 2
    likely = [place for place, match in enumerate(alone) if match.gain > 0.0]
    for first in sorted(likely, key=lambda place: -alone[place].gain):
        mean, left = _after(of_camera, flow[first], alone[first].shift_px, variances[first])
        near = _SIGMAS * np.sqrt(_stds_px(flow, left) ** 2 + variances[:, None])
        matches = [template.best(*at) for template, *at in zip(templates, flow @ mean, near, strict=True)]
        matches[first] = alone[first]
        gains = np.array([match.gain for match in matches])
        # Each of the others shows or does not, with equal odds.
        of_others = np.delete(np.logaddexp(gains, 0.0) - math.log(2.0), first)
        if gains[first] + of_others.sum() > math.log(len(ids) / _FALSE_FINDS):
            shifts = np.stack([match.shift_px for match in matches])
            return gains > 0.0, corners + shifts[:, None]
    return np.zeros(len(ids), dtype=np.bool_), corners


def _stds_px(flow: FloatArray, of_camera: FloatArray) -> FloatArray:
    """Standard deviations (N, 2) of markers along columns and rows by a covariance (6, 6) of the camera."""
    return np.asarray(np.sqrt(((flow @ of_camera) * flow).sum(axis=-1)))


def _after(
    of_camera: FloatArray, flow: FloatArray, shift_px: FloatArray, variance: float
) -> tuple[FloatArray, FloatArray]:
    """Mean (6,) and covariance (6, 6) of the camera's displacement after one marker with ``flow`` (2, 6) is matched."""
    gain = of_camera @ flow.T @ np.linalg.inv(flow @ of_camera @ flow.T + variance * np.eye(2))
    return gain @ shift_px, of_camera - gain @ flow @ of_camera
