"""Parts of known markers that look like other whole markers: the right half of marker 30 of DICT_4X4_50 is marker 17.

Such a part is outlined where motion blur or the border of the image hides the outline of the whole.
"""

import cv2
import numpy as np

from thermal_fiducial.core.detection.patterns import Decoder
from thermal_fiducial.core.detection.prediction.known_markers import among, FoundMarkers, KnownMarkers
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import areas, diagonals
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray

# Least correlation of what a known marker shows with the one found there: outlines of parts are inaccurate.
_ALIKE = 0.7
# A drawn marker: width of its cells [px], and white around it [cells].
_CELL, _AROUND = 8, 2


def shown_by_known(
    found: FoundMarkers, known: KnownMarkers, T_camera_map: FloatArray, camera: Camera, decoder: Decoder
) -> BoolArray:
    """Which of N ``found`` markers, that no map has, are parts of ``known`` ones: these show as much there.

    Parameters
    ----------
    T_camera_map : the camera by odometry
    """
    shown, px = np.zeros(len(found.ids), dtype=bool), found.places.points.px
    unknown = ~among(found.ids, known.mapped)
    if not unknown.any():
        return shown
    outlines = known.outlines(T_camera_map, camera)
    apart = np.linalg.norm(px.mean(axis=1)[:, None] - outlines.mean(axis=1), axis=-1)
    within = (apart < 0.5 * diagonals(outlines)) & (areas(px)[:, None] < areas(outlines))
    for place, whole in np.argwhere(within & unknown[:, None]).tolist():
        image, drawn = _drawn(decoder, int(known.ids[whole]))
        to_drawn = cv2.getPerspectiveTransform(outlines[whole].astype(np.float32), drawn)
        corners = np.asarray(cv2.perspectiveTransform(px[place][None], to_drawn), dtype=np.float64)
        shown[place] |= decoder.correlation(image, corners, found.ids[place : place + 1])[0] >= _ALIKE
    return shown


def _drawn(decoder: Decoder, marker_id: int) -> tuple[Float32Array, Float32Array]:
    """An image of an upright marker, and its corners (4, 2) there [px]."""
    [cells] = decoder.patterns(np.array([marker_id]), np.zeros(1, dtype=np.int64))
    ringed = np.pad(cells, _AROUND, constant_values=1.0)
    low, high = _CELL * _AROUND - 0.5, _CELL * (_AROUND + decoder.cells) - 0.5
    corners = np.array([[low, low], [high, low], [high, high], [low, high]], dtype=np.float32)
    return np.kron(ringed, np.ones((_CELL, _CELL))).astype(np.float32), corners
