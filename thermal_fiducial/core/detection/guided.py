"""Prediction-guided detection: known markers are looked for where they must be.

A marker is accepted by its own evidence alone: its pattern, in its expected place and attitude, must correlate with
the image clearly, and better than the pattern of any other marker or any other turn of its own.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.decoding import Decoder, Reading
from thermal_fiducial.core.detection.ids import among
from thermal_fiducial.core.detection.scratch import Scratch
from thermal_fiducial.core.detection.search import Found, read_quads
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import marker_corners
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray

# A marker turned further from the camera than this shows too little to be expected.
_MAX_TILT_COSINE = 0.2
_NEXT = np.array([1, 2, 3, 0])
# A marker predicted as far inside the image as this is not cut by its rim [px].
_WHOLE_PX = 10.0
# Places round the prediction that are tried, in shares of a cell: near first, then far.
_NEAR = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]), axis=-1).reshape(-1, 2)
_FAR = np.stack(np.meshgrid([-1.4, -0.7, 0.0, 0.7, 1.4], [-1.4, -0.7, 0.0, 0.7, 1.4]), axis=-1).reshape(-1, 2)


class Expected(NamedTuple):
    """Places of N markers in a frame."""

    #: (N,)
    ids: IntArray
    #: (N, 4, 2) in pixels, and normalised
    corners_px: FloatArray
    x: FloatArray
    #: (N, 4) of the corners [m]
    depth: FloatArray

    def only(self, keep: BoolArray) -> 'Expected':
        """Those of the markers ``keep`` (N,)."""
        return Expected(self.ids[keep], self.corners_px[keep], self.x[keep], self.depth[keep])

    def joined(self, others: 'Expected') -> 'Expected':
        """Those of ``others`` as well."""
        return Expected(
            np.concatenate([self.ids, others.ids]),
            np.concatenate([self.corners_px, others.corners_px]),
            np.concatenate([self.x, others.x]),
            np.concatenate([self.depth, others.depth]),
        )


class CutMarkers(NamedTuple):
    """N markers that show a face and may be in view, but not wholly."""

    #: (N,)
    ids: IntArray
    #: (N, 4, 4)
    T_camera_marker: FloatArray
    #: (N,) sides [m]
    sizes: FloatArray


class KnownMarkers:
    """The markers of a map.

    Parameters
    ----------
    markers : ID to (T_map_marker, side [m])
    """

    def __init__(self, markers: Mapping[int, tuple[FloatArray, float]]) -> None:
        #: (M,)
        self.ids = np.array(sorted(markers), dtype=np.int64)
        entries = [markers[marker_id] for marker_id in self.ids.tolist()]
        self._T_map_marker = T_map_marker = (
            np.stack([entry[0] for entry in entries]) if entries else np.zeros((0, 4, 4))
        )
        self._sizes = sizes = np.array([entry[1] for entry in entries])
        corners = se3.apply(T_map_marker, sizes[:, None, None] * marker_corners(1.0))
        self._corners_and_normals = np.concatenate([corners, T_map_marker[:, None, :3, 2]], axis=1)

    def expected(self, T_camera_map: FloatArray, camera: Camera, min_side_px: float) -> Expected:
        """Those that are wholly in view and show a face."""
        rotated = self._corners_and_normals @ T_camera_map[:3, :3].T
        points, normal = rotated[:, :4] + T_camera_map[:3, 3], rotated[:, 4]
        corners = camera.project(points)
        centre = 0.25 * points.sum(axis=1)
        facing = (normal * centre).sum(axis=1) < -_MAX_TILT_COSINE * np.sqrt((centre * centre).sum(axis=1))
        span = corners.take(_NEXT, axis=1) - corners
        large = ((span * span).sum(axis=-1) >= min_side_px**2).all(axis=1)
        seen = np.flatnonzero(camera.contains(corners, 2.0).all(axis=1) & facing & large)
        points = points[seen]
        return Expected(self.ids[seen], corners[seen], points[..., :2] / points[..., 2:], points[..., 2])

    def cut(self, T_camera_map: FloatArray, camera: Camera, without: IntArray) -> CutMarkers:
        """Those that show a face and may be partly in view, but for those of the IDs ``without``."""
        T = T_camera_map @ self._T_map_marker
        centre, normal = T[:, :3, 3], T[:, :3, 2]
        distance = np.sqrt(np.sum(centre * centre, axis=1))
        facing = np.sum(normal * centre, axis=1) < -_MAX_TILT_COSINE * distance
        corners = camera.project(se3.apply(T_camera_map, self._corners_and_normals[:, :4].reshape(-1, 3))).reshape(
            -1, 4, 2
        )
        near = np.nan_to_num(corners, nan=-1e9)
        low, high = near.min(axis=1), near.max(axis=1)
        inside = camera.contains(corners)
        overlap = inside.any(axis=1) | ((low < (camera.width, camera.height)) & (high > 0.0)).all(axis=1)
        whole = camera.contains(corners, _WHOLE_PX).all(axis=1)
        some = np.flatnonzero(facing & overlap & ~whole & ~among(self.ids, without))
        return CutMarkers(self.ids[some], T[some], self._sizes[some])


def look(
    image: Float32Array,
    scratch: Scratch,
    ids: IntArray,
    corners: FloatArray,
    decoder: Decoder,
    noise: float,
    config: ArucoDetectorConfig,
) -> tuple[Found, BoolArray]:
    """The expected markers (N,), (N, 4, 2) that the image shows, and which (N,) of them these are."""
    corners = _shifted(image, ids, corners, decoder, _NEAR)
    reading = read_quads(image, scratch, corners, decoder)
    good, contrast = _confirmed(reading, ids, noise, config), reading.contrast.copy()
    missing = np.flatnonzero(~good)
    if len(missing):
        far = _shifted(image, ids[missing], corners[missing], decoder, _FAR)
        corners[missing] = _shifted(image, ids[missing], far, decoder, _NEAR)
        reading = read_quads(image, scratch, corners[missing], decoder)
        good[missing], contrast[missing] = _confirmed(reading, ids[missing], noise, config), reading.contrast
    return Found(ids[good], corners[good], contrast[good] / noise, np.ones(int(good.sum()), dtype=bool)), good


def _shifted(
    image: Float32Array, ids: IntArray, corners: FloatArray, decoder: Decoder, offsets: FloatArray
) -> FloatArray:
    """Corners (N, 4, 2) moved to where their patterns correlate best, between the places by the centre of gravity."""
    cell = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=-1) / (np.sqrt(2.0) * decoder.cells)
    step = cell[:, None, None] * offsets
    tried = (corners[:, None] + step[:, :, None]).reshape(-1, 4, 2)
    similarity = np.abs(decoder.match(image, tried, np.repeat(ids, len(offsets)))).reshape(len(ids), -1)
    weight = np.maximum(similarity - 0.8 * similarity.max(axis=1, keepdims=True), 0.0)
    shift = np.einsum('np,npk->nk', weight, step) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    return np.asarray(corners + shift[:, None])


def _confirmed(reading: Reading, ids: IntArray, noise: float, config: ArucoDetectorConfig) -> BoolArray:
    similarity = np.abs(reading.correlation)
    return np.asarray(
        (reading.ids == ids)
        & (reading.turns == 0)
        & (similarity >= config.guided_min_correlation)
        & (similarity - reading.runner_up >= config.guided_min_margin)
        & (np.abs(reading.contrast) >= config.guided_min_contrast * noise)
    )
