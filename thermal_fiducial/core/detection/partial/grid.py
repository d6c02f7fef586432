"""Pose of a marker fitted to the edges between its cells, inside and along its sides.

Each edge is a straight step between black and white at a known place on the marker, so that all visible edges determine
the marker's pose without its corners. They are measured in layers of the frame, which are images of lower resolution.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import NamedTuple

import cv2
import numpy as np

from thermal_fiducial.core.detection.corners.corner_errors import OF_SIDES_PX
from thermal_fiducial.core.detection.corners.segments import measure, REACHED, robust_fit, UNMEASURED
from thermal_fiducial.core.detection.corners.sides import (
    Blur,
    blur_of,
    blurred_step,
    columns_across,
    EdgeModel,
    free_distance,
    NODES,
    Sides,
)
from thermal_fiducial.core.detection.prediction.frame import (
    counts_of,
    Frame,
    lag_tail_places,
    LEAST_DEPTH,
    motion_blur,
    Places,
    REMAINING,
    rolling_displacement,
    Saturation,
)
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.geometry.reprojection import outlines_on_faces
from thermal_fiducial.core.geometry.se3 import retract
from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray, IntArray, Stacked, TINY

# Columns of pixels across an edge.
_COLUMNS = 6
# Distance from its ends, in blurs, at which an edge is a straight step.
_QUIET = 2.0


@dataclass(frozen=True, slots=True)
class GridEdges(Stacked):
    """The E edges of a marker, in shares of its sides: a from left to right, b from the top down."""

    #: (E, 5, 2) equally spaced points of each
    nodes: FloatArray
    #: (E, 2) step to the next line of cells, to the right of vertical edges and below horizontal ones
    onward: FloatArray
    #: (E,) change of value along that step, 1 from black to white
    step: FloatArray


def grid_edges(bits: Gray) -> GridEdges:
    """Edges of the marker with ``bits`` (n, n) in its black border on white."""
    grid = np.pad(np.pad(bits.astype(np.float64), 1), 1, constant_values=1.0)
    cells = len(grid) - 2
    nodes, onward, steps = [], [], []
    for turned in (False, True):
        # Lines of one direction as rows; turned, those of the other.
        step = np.diff(grid.T if turned else grid, axis=0)[:, 1:-1]
        line, cell = np.nonzero(step)
        along = (cell[:, None] + NODES) / cells
        points = np.stack([along, np.broadcast_to(line[:, None] / cells, along.shape)], axis=-1)
        ahead = np.tile([0.0, 1.0 / cells], (len(line), 1))
        nodes.append(points[..., ::-1] if turned else points)
        onward.append(ahead[:, ::-1] if turned else ahead)
        steps.append(step[line, cell])
    return GridEdges(np.concatenate(nodes), np.concatenate(onward), np.concatenate(steps))


def on_marker(shares: FloatArray, size: float) -> FloatArray:
    """Points (..., 3) in the marker's frame [m] at shares (..., 2) of its sides."""
    points = np.zeros((*shares.shape[:-1], 3))
    points[..., 0], points[..., 1] = (shares[..., 0] - 0.5) * size, (0.5 - shares[..., 1]) * size
    return points


@dataclass(frozen=True, slots=True)
class Layer:
    """An image at some resolution, with its camera, and displacement and blur by motion."""

    image: Float32Array
    camera: Camera
    #: displacement (P, 2) by motion [px] of points (P, 3) in the camera frame
    displacement: Callable[[FloatArray], FloatArray]
    #: standard deviation of the blur by optics and pixels [px], and motion blur (2,) along the motion [px]
    blur: float
    lag_blur: FloatArray
    #: (1, 2, 3) map from pixels to their lag tails, which are removed; None: none are
    to_tails: FloatArray | None = None
    #: where the gray scale of a display ends; None: nowhere, or no lag tails are removed
    saturation: Saturation | None = None

    def without_saturated(self, pixel: IntArray, counting: BoolArray) -> BoolArray:
        """Which pixels ``counting`` (...), with indices ``pixel`` in the image, have counts, lag tails included."""
        if self.saturation is None or self.to_tails is None:
            return counting
        v, u = np.divmod(pixel.reshape(1, -1), self.image.shape[1])
        places = np.stack([u, v]).astype(np.float32)
        both = places, lag_tail_places(places, self.to_tails)
        hidden = np.logical_or(*(self.saturation.at(of) != 0.0 for of in both))
        return np.asarray(counting & ~hidden.reshape(pixel.shape))

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera frame, displaced by motion; NaN outside the lens model."""
        flat = points.reshape(-1, 3)
        return np.asarray((self.camera.project(flat) + self.displacement(flat)).reshape(*points.shape[:-1], 2))


class PoseFit(NamedTuple):
    """Result of a fit of a marker's pose to its edges."""

    #: (4, 4)
    T_camera_marker: FloatArray
    #: (6, 6) of translation and rotation in the camera frame, by the edges alone
    covariance: FloatArray
    #: longest move of an edge in this step [px], along its normal
    moved_px: float
    #: numbers of edges in view, and of those with a step of the common contrast that agree with the pose
    visible: int
    agreeing: int
    contrast: float
    #: standard deviation of a pixel about the model [counts]
    noise: float


def adjusted(T: FloatArray, size: float, pattern: GridEdges, layer: Layer, thickness: float = 0.0) -> PoseFit | None:
    """One linearised adjustment of a marker's pose ``T`` (4, 4) in the camera; None with too few visible edges.

    ``thickness``: of its plate [m].
    """
    nodes = layer.project(se3.apply(T, _outlines(T, size, pattern, thickness)))
    inside: BoolArray = np.asarray(layer.camera.contains(nodes).any(axis=1) & np.isfinite(nodes).all(axis=(1, 2)))
    if inside.sum() < 6:
        return None
    pattern, nodes = pattern.only(inside), nodes[inside]
    middle = pattern.nodes[:, 2]
    onward = layer.project(se3.apply(T, on_marker(middle + pattern.onward, size))) - nodes[:, 2]
    widest = math.hypot(layer.blur, float(np.linalg.norm(layer.lag_blur)))
    sides = columns_across(nodes, np.nan_to_num(onward), layer.image.shape, 1, _COLUMNS, widest)
    blur = blur_of(sides, layer.blur, layer.lag_blur[None])
    modelled = _model(sides, pattern.step, blur)
    counting = layer.without_saturated(sides.pixel, modelled.counting)
    # An edge of which the ends of a gray scale hide more than half does not speak against the marker.
    shown = 2 * counting.sum(axis=(0, 1, 3)) >= modelled.counting.sum(axis=(0, 1, 3))
    modelled = modelled._replace(counting=counting)
    measured = measure(counts_of(sides.pixel, layer.image, layer.to_tails), modelled, REACHED * blur.across, len(nodes))
    used = measured.variance[0] < UNMEASURED
    if used.sum() < 6:
        return None
    J = _design(T, size, pattern, sides, counting, layer.camera)
    sharpness = np.where(used, 1.0 / np.sqrt(measured.variance[0] + OF_SIDES_PX**2), 0.0)
    # So weak that it only keeps the system solvable.
    prior = TINY * np.diag((J[used] ** 2).sum(axis=0))
    fit = robust_fit((J * sharpness[:, None])[None], measured.shift * sharpness, used[None], prior)
    step = fit.moved[0, :, 0]
    return PoseFit(
        retract(T, step),
        fit.covariance[0],
        float(np.abs(J[used] @ step).max()),
        int(shown.sum()),
        int(fit.kept.sum()),
        float(np.median(measured.contrast[0][used])),
        math.sqrt(np.median(measured.noise[0][used])),
    )


def _outlines(T: FloatArray, size: float, pattern: GridEdges, thickness: float) -> FloatArray:
    """Points (E, 5, 3) of the edges as the camera sees them, on the marker's face [m]."""
    points = on_marker(pattern.nodes, size)
    # The plate is what is black in the pattern; ``onward`` has its second axis down, the marker's is up.
    towards_white = pattern.step[:, None] * np.sign(pattern.onward) * [1.0, -1.0]
    camera = se3.inverse(T)[:3, 3]
    return outlines_on_faces(points, towards_white[:, None], camera[None], thickness)


def _model(sides: Sides, step: FloatArray, blur: Blur) -> EdgeModel:
    """Model of edges that are straight steps, (M, C, E, 1), but near their ends and other edges."""
    sharpness, height = (1.0 / blur.across).astype(np.float32), step[:, None].astype(np.float32)
    value, slope = blurred_step(sides.distance, sharpness, height)
    ends = _QUIET * blur.along / sides.along
    straight = sides.fresh & (sides.t > ends) & (sides.t < 1.0 - ends)
    counting: BoolArray = np.asarray((np.abs(sides.distance) <= free_distance(sides, blur.across)) & straight)
    if sides.inside is not None:
        counting &= sides.inside
    return EdgeModel(value, slope, counting)


def _design(
    T: FloatArray, size: float, pattern: GridEdges, sides: Sides, counting: BoolArray, camera: Camera
) -> FloatArray:
    """Derivative (E, 6) of displacements along the normals by translation and rotation, where columns count."""
    counted: BoolArray = np.asarray(counting.any(axis=0))
    t = (sides.t * counted).sum(axis=(0, 2)) / np.maximum(counted.sum(axis=(0, 2)), 1)
    shares = pattern.nodes[:, 0] + t[:, None] * (pattern.nodes[:, 4] - pattern.nodes[:, 0])
    J = pose_jacobian(T, on_marker(shares, size), camera)
    return np.asarray(np.einsum('ek,ekj->ej', sides.normal[:, 0], J))


def pose_jacobian(T: FloatArray, points: FloatArray, camera: Camera) -> FloatArray:
    """Derivative (P, 2, 6) of the pixels of points (P, 3) in the marker by its pose ``T`` (4, 4)."""
    _, by_point = camera.project_jacobian(se3.apply(T, points))
    by_turn = -se3.skew(points @ T[:3, :3].T)
    return np.concatenate([by_point, by_point @ by_turn], axis=-1)


def layer_of(frame: Frame, window: FloatArray, factor: int = 1) -> Layer:
    """The frame reduced by ``factor``, with the motion blur at a ``window`` (4, 3) in the camera frame.

    At full resolution large lag tails are removed, as around whole markers: an edge with a tail, fitted as if its blur
    were symmetric, seems a fifth of the blur ahead.
    """
    camera, image = _coarser(frame.camera, factor), frame.image
    motion = motion_blur(frame, places_of_points(window, frame.camera), frame.twist)
    to_tails, lag_blur = motion.to_tails, motion.spread[0]
    if factor > 1:
        cropped = image[: camera.height * factor, : camera.width * factor]
        image = np.asarray(cv2.resize(cropped, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
        to_tails, lag_blur = None, motion.lag[0].mean(axis=0) / factor
    blur = math.hypot(frame.blur_px / factor, math.sqrt((1.0 - 1.0 / factor**2) / 12.0))

    def displacement(points: FloatArray) -> FloatArray:
        places = places_of_points(points, frame.camera)
        left = 1.0 if to_tails is None else REMAINING
        shift = left * places.lag_blur(frame.twist, frame.lag) + rolling_displacement(places, frame.twist, frame)
        return np.asarray(shift[0] / factor)

    saturation = None if to_tails is None else frame.saturation
    return Layer(image, camera, displacement, blur, lag_blur, to_tails, saturation)


def _coarser(camera: Camera, factor: int) -> Camera:
    """The camera of an image reduced by ``factor``."""
    if factor == 1:
        return camera
    K = camera.K.copy()
    K[:2, 2] += 0.5 - 0.5 * factor
    K[:2] /= factor
    return Camera(camera.width // factor, camera.height // factor, K, camera.model, camera.D)


def places_of_points(points: FloatArray, camera: Camera) -> Places:
    """Places (1, P) of points (P, 3) in the camera."""
    depth = np.maximum(points[None, :, 2], LEAST_DEPTH)
    return Places.of(ImagePoints.seen_at(points[None, :, :2] / depth[..., None], camera), depth)
