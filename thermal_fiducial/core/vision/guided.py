"""Prediction-guided detection: known markers are looked for where they must be.

A marker is accepted by its own evidence alone: its pattern, in its expected place and attitude, must correlate with
the image clearly, and better than the pattern of any other marker or any other turn of its own.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core import geometry
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.measurements import Odometry
from thermal_fiducial.core.pose import marker_corners
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray
from thermal_fiducial.core.vision.decoding import Decoder, Reading
from thermal_fiducial.core.vision.lag import Twist
from thermal_fiducial.core.vision.search import Found, read_quads

# A marker turned further from the camera than this shows too little to be expected.
_MAX_TILT_COSINE = 0.2
# Places round the prediction that are tried, in shares of a cell: near first, then far.
_NEAR = np.stack(np.meshgrid([-0.5, 0.0, 0.5], [-0.5, 0.0, 0.5]), axis=-1).reshape(-1, 2)
_FAR = np.stack(np.meshgrid([-1.4, -0.7, 0.0, 0.7, 1.4], [-1.4, -0.7, 0.0, 0.7, 1.4]), axis=-1).reshape(-1, 2)


class Expected(NamedTuple):
    """Places of N markers in a frame."""

    #: (N,)
    ids: IntArray
    #: (N, 4, 2)
    corners_px: FloatArray
    #: (N, 4) of the corners [m]
    depth: FloatArray


def expected_markers(
    marker_map: Mapping[int, tuple[FloatArray, float]], T_camera_map: FloatArray, camera: Camera, min_side_px: float
) -> Expected:
    """The markers of the map that are wholly in view and show a face."""
    ids = np.array(sorted(marker_map), dtype=np.int64)
    if len(ids) == 0:
        return Expected(ids, np.zeros((0, 4, 2)), np.zeros((0, 4)))
    T_map_marker = np.stack([marker_map[marker_id][0] for marker_id in ids.tolist()])
    sizes = np.array([marker_map[marker_id][1] for marker_id in ids.tolist()])
    T = T_camera_map @ T_map_marker
    points = geometry.apply(T, sizes[:, None, None] * marker_corners(1.0))
    corners = camera.project(points)
    distance = np.maximum(np.linalg.norm(T[:, :3, 3], axis=-1), 1e-6)
    facing = -np.sum(T[:, :3, 2] * T[:, :3, 3], axis=-1) / distance > _MAX_TILT_COSINE
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    inside = camera.contains(corners, 2.0).all(axis=1)
    seen = inside & facing & (np.min(np.nan_to_num(sides), axis=1) >= min_side_px)
    return Expected(ids[seen], corners[seen], points[seen][..., 2])


def camera_in_map(stamp_ns: int, odometry: Odometry, T_body_camera: FloatArray, twist: Twist) -> FloatArray:
    """T_map_camera (4, 4) at a frame, from the odometry before it carried on with the camera's twist."""
    dt = (stamp_ns - odometry.stamp_ns) * 1e-9
    moved = geometry.transform(geometry.so3_exp(twist.value[3:] * dt), twist.value[:3] * dt)
    return np.asarray(odometry.T_map_body @ T_body_camera @ moved)


def look(
    image: Float32Array,
    ids: IntArray,
    corners: FloatArray,
    decoder: Decoder,
    noise: float,
    config: ArucoDetectorConfig,
) -> tuple[Found, BoolArray]:
    """The expected markers (N,), (N, 4, 2) that the image shows, and which (N,) of them these are."""
    corners = _shifted(image, ids, corners, decoder, _NEAR)
    reading = read_quads(image, corners, decoder)
    good, contrast = _confirmed(reading, ids, noise, config), reading.contrast.copy()
    missing = np.flatnonzero(~good)
    if len(missing):
        far = _shifted(image, ids[missing], corners[missing], decoder, _FAR)
        corners[missing] = _shifted(image, ids[missing], far, decoder, _NEAR)
        reading = read_quads(image, corners[missing], decoder)
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
