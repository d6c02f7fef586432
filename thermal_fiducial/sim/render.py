"""The scene as the focal plane sees it: sampled from the plates' own planes, in space and in time.

A pixel wholly inside one cell of a plate at all times of a sub-frame needs one sample. Every other pixel gets the
points of a rank-1 lattice over its area and the sub-frame: each point is back-projected through the lens with the camera pose
of its own time and looked up in the plate. Its time is drawn from the exponential by which the bolometer forgets
within the sub-frame, so that the sum over sub-frames y <- e y + (1 - e) x is the lag's true response,
y(t) = integral of x(t - a) exp(-a / tau) / tau da, and a moving edge is smeared without steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.scene import Acrylic, Fog, Plate, Room
from thermal_fiducial.sim.trajectory import Trajectory

#: Points of a pixel and sub-frame -> generators of the lattice (column, row, time), found by exhaustive search for
#: the largest distance between points in each projection.
LATTICES = {23: (1, 19, 10), 97: (1, 84, 79), 251: (1, 234, 148)}

_NEAR = 0.05
_COARSE = 8
_KERNEL = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Quality:
    """How finely the renderer samples.

    Parameters
    ----------
    samples : points of a pixel in a sub-frame, a key of :data:`LATTICES`
    sub_frames : of a frame interval
    warm_up : frames before the first one that fill the bolometers' memory
    """

    samples: int = 23
    sub_frames: int = 4
    warm_up: int = 3


class Renderer:
    """Temperatures on the focal plane, frame by frame, after lag and before the optics' blur.

    Parameters
    ----------
    lens : with the image size
    plates : everything flat
    room, fog, acrylic : the rest of the scene
    trajectory : of the body
    T_body_camera : (4, 4)
    interval : of frames [s]
    lag : thermal time constant of the bolometers [s]; 0: none
    """

    def __init__(
        self,
        lens: Lens,
        plates: Sequence[Plate],
        room: Room,
        fog: Fog,
        acrylic: Acrylic,
        trajectory: Trajectory,
        T_body_camera: FloatArray,
        interval: float = 1 / 30,
        lag: float = 0.010,
        quality: Quality = Quality(),
    ) -> None:
        if quality.samples not in LATTICES:
            raise InputError(f'{quality.samples} samples a pixel: choose one of {", ".join(map(str, LATTICES))}')
        self._lens, self._plates, self._room, self._fog, self._acrylic = lens, list(plates), room, fog, acrylic
        self._trajectory, self._T_body_camera = trajectory, T_body_camera
        self._interval, self._warm_up = interval, quality.warm_up
        self._sub_frames = quality.sub_frames if lag > 0 else 1
        self._dx, self._dy, self._ages, self._forget = _lattice(quality.samples, interval / self._sub_frames, lag)
        self._rays = _pixel_rays(lens)
        self._norms = np.sqrt(1.0 + np.sum(self._rays[..., :2] ** 2, axis=-1))
        self._coarse_rays = _coarse_rays(lens)
        self._max_slope = 1.2 * float(np.sqrt(self._norms.max() ** 2 - 1.0))
        self._previous: float | None = None
        self._state: Float32Array = np.zeros((lens.height, lens.width), np.float32)

    def camera_poses(self, t: FloatArray) -> FloatArray:
        """T_map_camera (N, 4, 4) at times (N,) [s]."""
        return np.asarray(self._trajectory(t).T_map_body @ self._T_body_camera)

    def forget(self) -> None:
        """Let the next frame be the first one."""
        self._previous = None

    def frame(self, t: float) -> Float32Array:
        """Excess temperature (height, width) [K] of the bolometers when they are read out at ``t`` [s].

        The state of the previous call is the start if that was one interval ago, else the frames before ``t``
        are rendered for it.
        """
        if self._previous is None or abs(self._previous + self._interval - t) > 1e-6:
            self._state = self._sub_frame(t - (self._warm_up + 1) * self._interval).copy()
            for n in range(self._warm_up, 0, -1):
                self._advance(t - n * self._interval)
        self._advance(t)
        self._previous = t
        return self._state.copy()

    def _advance(self, t: float) -> None:
        for n in range(self._sub_frames - 1, -1, -1):
            scene = self._sub_frame(t - n * self._interval / self._sub_frames)
            cv2.accumulateWeighted(scene, self._state, 1.0 - self._forget)

    def _sub_frame(self, t: float) -> Float32Array:
        """The scene averaged over the sub-frame that ends at ``t``, with the lag's weights."""
        poses = self.camera_poses(t - self._ages)
        middle = len(poses) // 2
        t_middle = t - float(self._ages[middle])
        image = self._background(poses[middle], t_middle)
        distances = [float(np.linalg.norm(p.T_map_plate[:3, 3] - poses[middle, :3, 3])) for p in self._plates]
        for index in np.argsort(distances)[::-1]:
            self._draw(image, self._plates[index], poses, t_middle)
        return image

    def _background(self, T_map_camera: FloatArray, t: float) -> Float32Array:
        directions = self._coarse_rays @ T_map_camera[:3, :3].T
        excess, distance = self._room.look(T_map_camera[:3, 3], directions)
        through = np.exp(-self._fog.at(t) * distance * np.linalg.norm(directions, axis=-1))
        coarse = (through * excess + (1.0 - through) * self._fog.excess).astype(np.float32)
        height, width = coarse.shape[0] * _COARSE, coarse.shape[1] * _COARSE
        fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(fine[: self._lens.height, : self._lens.width])

    def _draw(self, image: Float32Array, plate: Plate, poses: FloatArray, t: float) -> None:
        H, in_front = _homographies(plate, poses)
        box = self._box(plate, poses[[0, -1]]) if in_front else None
        if box is None:
            return
        rays, norms = self._rays[box], self._norms[box]
        moments = [0, len(H) // 2, len(H) - 1]
        u, v, inverse_depth = _look_up(rays[..., :3], H[moments], np.zeros((3, 2)))
        column, row = _cells(u, v, plate)
        level, cover = plate.levels[row[..., 1], column[..., 1]], plate.cover[row[..., 1], column[..., 1]]
        cut = _cut_pixels(plate.regions[row, column])
        level[cut], cover[cut] = self._supersample(plate, rays[cut], H)
        self._blend(image[box], plate, level, cover, (u[..., 1], v[..., 1], inverse_depth[..., 1]), norms, t)

    def _supersample(self, plate: Plate, rays: Float32Array, H: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Mean level and cover over the lattice of pixels ``rays`` (M, 7)."""
        u, v, _ = _look_up(rays, H, np.stack([self._dx, self._dy], axis=1))
        column, row = _cells(u, v, plate)
        index = row * np.int32(plate.levels.shape[1]) + column
        return plate.levels.ravel()[index].mean(axis=-1), plate.cover.ravel()[index].mean(axis=-1)

    def _blend(
        self,
        image: Float32Array,
        plate: Plate,
        level: Float32Array,
        cover: Float32Array,
        uvd: tuple[Float32Array, Float32Array, Float32Array],
        norms: Float32Array,
        t: float,
    ) -> None:
        u, v, inverse_depth = uvd
        rows, columns = plate.levels.shape
        slope = 1.0 + plate.gradient[0] * (u / columns - 0.5) + plate.gradient[1] * (v / rows - 0.5)
        cold = self._acrylic.sheet(t) if plate.cold is None else plate.cold
        emitted = level * (plate.hot * slope) + (cover - level) * cold
        visible = inverse_depth > 0
        depth = 1.0 / np.where(visible, inverse_depth, 1.0)
        through = np.exp(-self._fog.at(t) * norms * depth)
        seen = through * emitted + (1.0 - through) * cover * self._fog.excess
        image += np.where(visible, seen - cover * image, 0.0)

    def _box(self, plate: Plate, poses: FloatArray) -> tuple[slice, slice] | None:
        """Rows and columns that the plate may touch during the sub-frame, or None."""
        corners = plate.outline_map
        outlines = [_clip(_outline((corners - T[:3, 3]) @ T[:3, :3])) for T in poses]
        points = np.concatenate(outlines)
        if len(points) == 0:
            return None
        slopes = points[:, :2] / points[:, 2:]
        radius = np.linalg.norm(slopes, axis=1, keepdims=True)
        pixels = self._lens.project_slopes(slopes * np.minimum(1.0, self._max_slope / np.maximum(radius, 1e-9)))
        size = np.array([self._lens.width, self._lens.height])
        low = np.clip(np.floor(pixels.min(axis=0)) - 3, 0, size).astype(int)
        high = np.clip(np.ceil(pixels.max(axis=0)) + 4, 0, size).astype(int)
        return None if np.any(high <= low) else (slice(low[1], high[1]), slice(low[0], high[0]))


def _lattice(samples: int, duration: float, lag: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Offsets in the pixel [px], ages before the end of the sub-frame [s] in rising order, and the share forgotten."""
    columns, rows, times = (((np.arange(samples) * g) % samples + 0.5) / samples for g in LATTICES[samples])
    forget = float(np.exp(-duration / lag)) if lag > 0 else 0.0
    ages = -lag * np.log(1.0 - times * (1.0 - forget)) if lag > 0 else np.zeros(samples)
    order = np.argsort(ages, kind='stable')
    return columns[order] - 0.5, rows[order] - 0.5, ages[order], forget


def _pixel_rays(lens: Lens) -> Float32Array:
    """(height, width, 7): ray x y 1 of each pixel's centre, and dx/du dx/dv dy/du dy/dv."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    slopes = lens.slopes(np.stack([u, v], axis=-1))
    J = lens.slopes_jacobian(slopes)
    ones = np.ones_like(u)
    terms = [slopes[..., 0], slopes[..., 1], ones, J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]]
    return np.stack(terms, axis=-1).astype(np.float32)


def _coarse_rays(lens: Lens) -> FloatArray:
    """Rays (rows, columns, 3) through the centres of blocks of pixels, as ``cv2.resize`` takes them."""
    rows, columns = -(-lens.height // _COARSE), -(-lens.width // _COARSE)
    v, u = (np.mgrid[0:rows, 0:columns] + 0.5) * _COARSE - 0.5
    slopes = lens.slopes(np.stack([u, v], axis=-1))
    return np.concatenate([slopes, np.ones((rows, columns, 1))], axis=-1)


def _homographies(plate: Plate, poses: FloatArray) -> tuple[FloatArray, bool]:
    """H (N, 3, 3) with H (x, y, 1) = (column, row, 1) / depth for the ray x y 1; and whether the face is seen."""
    R_plate_map = plate.T_map_plate[:3, :3].T
    D = R_plate_map @ poses[:, :3, :3]
    o = (poses[:, :3, 3] - plate.T_map_plate[:3, 3]) @ R_plate_map.T
    if not np.all(o[:, 2] > 1e-3):
        return D, False
    metres = D - (o / o[:, 2:])[:, :, None] * D[:, 2:, :]
    metres[:, 2] = -D[:, 2] / o[:, 2:]
    return plate.to_cells @ metres, True


def _look_up(rays: Float32Array, H: FloatArray, offsets: FloatArray) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Column, row and inverse depth (..., N) where ``rays`` (..., 3 or 7), moved by ``offsets`` (N, 2) [px], hit."""
    terms = [H[:, :, 0], H[:, :, 1], H[:, :, 2]]
    if rays.shape[-1] == 7:
        dx, dy = offsets[:, :1], offsets[:, 1:]
        terms += [H[:, :, 0] * dx, H[:, :, 0] * dy, H[:, :, 1] * dx, H[:, :, 1] * dy]
    matrix = np.stack(terms).transpose(0, 2, 1).reshape(len(terms), -1).astype(np.float32)
    product = rays @ matrix
    n = len(H)
    u, v, inverse_depth = product[..., :n], product[..., n : 2 * n], product[..., 2 * n :]
    safe = np.where(inverse_depth > 1e-6, inverse_depth, np.float32(np.inf))
    outside = inverse_depth <= 1e-6
    u, v = u / safe, v / safe
    u[outside] = -1.0
    return u, v, inverse_depth


def _cells(u: Float32Array, v: Float32Array, plate: Plate) -> tuple[IntArray, IntArray]:
    rows, columns = plate.levels.shape
    return (
        np.clip(u, 0, columns - 0.5).astype(np.int32),  # type: ignore[return-value]
        np.clip(v, 0, rows - 0.5).astype(np.int32),
    )


def _cut_pixels(regions: np.ndarray) -> BoolArray:
    """Pixels whose surroundings (3 x 3, at the three moments of ``regions`` (h, w, 3)) are not all of one region."""
    highest = cv2.dilate(np.ascontiguousarray(regions.max(axis=-1)), _KERNEL)
    lowest = cv2.erode(np.ascontiguousarray(regions.min(axis=-1)), _KERNEL)
    return np.asarray(highest != lowest)


def _outline(corners_camera: FloatArray) -> FloatArray:
    """Closed outline (33, 3) with eight points a side."""
    s = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]
    sides = [a + s * (b - a) for a, b in zip(corners_camera, np.roll(corners_camera, -1, axis=0), strict=True)]
    return np.concatenate([*sides, corners_camera[:1]])


def _clip(outline: FloatArray) -> FloatArray:
    """The part of a closed outline in front of the camera, with the points where it crosses the near plane."""
    a, b = outline[:-1], outline[1:]
    crossing = (a[:, 2] > _NEAR) != (b[:, 2] > _NEAR)
    a, b = a[crossing], b[crossing]
    share = (_NEAR - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    return np.concatenate([outline[outline[:, 2] > _NEAR], a + share * (b - a)])
