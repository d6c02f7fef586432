"""Rendering of the scene on the focal plane, by samples in space and time that are looked up in planar plates.

A pixel that lies inside one cell of a plate during a whole sub-frame needs one sample. All others get the points of a
rank-1 lattice over their area and the sub-frame: each point is back-projected through the lens with the camera pose of
its own time, and looked up in the plate. The ages of the points follow the exponential decay of the bolometer within
the sub-frame, so that the sum over sub-frames y <- e y + (1 - e) x is the true response of the lag,
y(t) = integral of x(t - a) exp(-a / tau) / tau da, and a moving edge is blurred without steps.

The optics blur the scene before the pixels sample it. So a pixel is a mean over the points of its neighbourhood, each
weighted by the point spread, integrated over the pixel, at its own distance. Means over pixels that are blurred
afterwards are aliased: edges within 2 degrees of the image's axes are then up to 0.03 px off, by their phase.

With a rolling shutter each row has its own t. The homographies of a plate are computed at the borders of strips of
rows, a millisecond of read-out each, and interpolated linearly over the rows between.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.special import ndtr

from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, IntArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.plate_lookup import (
    cell_indices,
    clipped,
    cut_pixels,
    homographies,
    look_up,
    NEAR,
    outline_points,
    ray_factors,
    Strip,
    strips,
)
from thermal_fiducial.sim.scene import Acrylic, Fog, Plate, Room
from thermal_fiducial.sim.spline_trajectory import MotionPath

#: Number of points of a pixel and sub-frame to generators of the lattice (column, row, time), found by exhaustive
#: search for the largest distance between points in each projection.
LATTICES = {23: (1, 19, 10), 97: (1, 84, 79), 251: (1, 234, 148)}

_COARSE = 4


@dataclass(frozen=True)
class Quality:
    """Sampling of the renderer.

    Parameters
    ----------
    samples : points of a pixel in a sub-frame, one of :data:`LATTICES`
    sub_frames : of a frame interval
    warm_up : frames before the first one, until the bolometers have settled
    stepwise : integrate the lag in steps from the scene at the end of each sub-frame, as simpler renderers do: a moving
        edge becomes a staircase, with less lag than that of the time constant
    """

    samples: int = 23
    sub_frames: int = 4
    warm_up: int = 3
    stepwise: bool = False


@dataclass(frozen=True)
class _PointSpread:
    """Share that a pixel has of the points of the pixels around it.

    Parameters
    ----------
    reach : how far away these pixels are [px]
    weights : (pixels, points), row by row
    """

    reach: int
    weights: Float32Array

    @property
    def kernel(self) -> Float32Array:
        """Weights of pixels all of whose points are equal, (rows, columns)."""
        side = 2 * self.reach + 1
        return np.asarray(self.weights.sum(axis=1).reshape(side, side))


class Renderer:
    """Temperatures of the bolometers, frame by frame, blurred by the optics and after the lag.

    Parameters
    ----------
    lens : with the image size
    plates : all flat objects
    room, fog, acrylic : the rest of the scene
    trajectory : of the body
    T_body_camera : (4, 4)
    interval : of frames [s]
    lag : thermal time constant of the bolometers [s]; 0: none
    readout : from the first row's sampling to the last's [s]; 0: all rows at once
    psf_sigma_px : standard deviation of the optics' point spread, before the pixels' area [px]; 0: none
    """

    def __init__(
        self,
        lens: Lens,
        plates: Sequence[Plate],
        room: Room,
        fog: Fog,
        acrylic: Acrylic,
        trajectory: MotionPath,
        T_body_camera: FloatArray,
        interval: float = 1 / 30,
        lag: float = 0.010,
        quality: Quality = Quality(),
        readout: float = 0.0,
        psf_sigma_px: float = 0.0,
    ) -> None:
        if quality.samples not in LATTICES:
            raise InputError(f'{quality.samples} samples a pixel: choose one of {", ".join(map(str, LATTICES))}')
        self._lens, self._plates, self._room, self._fog, self._acrylic = lens, list(plates), room, fog, acrylic
        self._centres = np.array([plate.T_map_plate[:3, 3] for plate in plates]).reshape(-1, 3)
        self._normals = np.array([plate.T_map_plate[:3, 2] for plate in plates]).reshape(-1, 3)
        self._outlines = np.array([outline_points(plate) for plate in plates]).reshape(-1, 32, 3)
        self._trajectory, self._T_body_camera = trajectory, T_body_camera
        self._interval, self._warm_up = interval, quality.warm_up
        self._sub_frames = quality.sub_frames if lag > 0 else 1
        self._dx, self._dy, self._ages, self._forget = _lattice(quality, interval / self._sub_frames, lag)
        self._spread = _point_spread(psf_sigma_px, self._dx, self._dy)
        self._rays = _pixel_rays(lens)
        self._norms = np.sqrt(1.0 + np.sum(self._rays[:2] ** 2, axis=0))
        self._coarse_rays = _coarse_rays(lens).astype(np.float32)
        self._coarse_norms = np.linalg.norm(self._coarse_rays, axis=-1)
        self._strips, self._nodes = strips(lens.height, readout)
        self._coarse_delays = _coarse_delays(lens.height, readout)
        self._max_slope = 1.2 * float(np.sqrt(self._norms.max() ** 2 - 1.0))
        self._previous: float | None = None
        self._state: Float32Array = np.zeros((lens.height, lens.width), np.float32)

    def camera_poses(self, t: FloatArray) -> FloatArray:
        """T_map_camera (N, 4, 4) at times (N,) [s]."""
        return np.asarray(self._trajectory(t).T_map_body @ self._T_body_camera)

    def forget(self) -> None:
        """Forget the state of the bolometers: the next frame begins with a warm-up."""
        self._previous = None

    def frame(self, t: float) -> Float32Array:
        """Excess temperature (height, width) [K] of the bolometers when the middle row is read out at ``t`` [s].

        It starts from the state of the previous call if that was one interval ago, else from a warm-up before ``t``.
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
        """The scene averaged with the lag's weights over the sub-frame that ends at ``t`` in the middle row."""
        times = t + self._nodes[:, None] - self._ages
        poses = self.camera_poses(times.ravel()).reshape(*times.shape, 4, 4)
        t_middle = t - float(self._ages[len(self._ages) // 2])
        image = self._background(t_middle)
        few = np.concatenate([poses[:: -max(1, len(poses) // 2), 0], poses[:1, -1]])
        for plate, box in self._in_view(few):
            H = homographies(plate, poses)
            for strip in self._strips:
                self._draw(image, plate, box, strip, H, t_middle)
        return image

    def _background(self, t: float) -> Float32Array:
        poses = self.camera_poses(t + self._coarse_delays)
        directions = self._coarse_rays @ poses[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
        excess, distance = self._room.look(poses[:, None, :3, 3], directions)
        through = np.exp(np.float32(-self._fog.at(t)) * distance * self._coarse_norms)
        coarse = through * excess + (1.0 - through) * np.float32(self._fog.excess)
        height, width = coarse.shape[0] * _COARSE, coarse.shape[1] * _COARSE
        fine = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.ascontiguousarray(fine[: self._lens.height, : self._lens.width])

    def _draw(
        self, image: Float32Array, plate: Plate, box: tuple[slice, slice], strip: Strip, H: FloatArray, t: float
    ) -> None:
        """The part of a plate that lies in the strip; ``H`` (nodes, N, 3, 3)."""
        padded, kept = strip.rows_of(box[0], self._spread.reach + 1)
        if kept.stop <= kept.start:
            return
        H = strip.motion(H)
        rays, norms = self._rays[:, padded, box[1]], self._norms[padded, box[1]]
        shape, share = norms.shape, strip.share(padded)
        u, v, inverse_depth = look_up(ray_factors(rays[:3], share, H), H[:, [0, H.shape[1] // 2, -1]])
        cells = cell_indices(u, v, plate)
        levels, covers = plate.levels.ravel(), plate.cover.ravel()
        level, cover = levels[cells[1]], covers[cells[1]]
        cut = np.flatnonzero(cut_pixels(plate.regions.ravel()[cells].reshape(3, *shape)))
        if len(cut):
            points = self._supersample(plate, ray_factors(rays, share, H)[:, cut], H)
            level = self._blurred(level.reshape(shape), cut, levels[points])
            cover = self._blurred(cover.reshape(shape), cut, covers[points])
        terms = (level, cover, u[1], v[1], inverse_depth[1])
        level, cover, u, v, inverse_depth = (term.reshape(shape)[kept] for term in terms)
        self._blend(image[strip.within(box[0]), box[1]], plate, level, cover, (u, v, inverse_depth), norms[kept], t)

    def _supersample(self, plate: Plate, rays: Float32Array, H: FloatArray) -> IntArray:
        """Cells (N, M) at the points of the lattice in pixels ``rays`` (7 or 14, M)."""
        u, v, _ = look_up(rays, H, np.stack([self._dx, self._dy], axis=1))
        return cell_indices(u, v, plate)

    def _blurred(self, image: Float32Array, cut: IntArray, points: Float32Array) -> Float32Array:
        """The image (h, w) blurred, where the pixels ``cut`` (M,) have the values of their ``points`` (N, M) instead.

        What the points differ from their pixel goes to its neighbours, each by its own distance. Beyond its border the
        image goes on, without points.
        """
        filtered = cv2.filter2D(image, -1, self._spread.kernel, borderType=cv2.BORDER_REPLICATE)
        blurred = np.asarray(filtered, dtype=np.float32)
        differences = points - image.ravel()[cut]
        uneven = np.flatnonzero(np.any(differences, axis=0))
        if len(uneven) == 0:
            return blurred
        # Of the image and ``reach`` pixels around it.
        reach = self._spread.reach
        height, width = (size + 2 * reach for size in image.shape)
        row, column = np.divmod(cut[uneven], image.shape[1])
        around = np.arange(-reach, reach + 1)
        to = (row + reach) * width + column + reach - (width * around[:, None] + around).reshape(-1, 1)
        shares = self._spread.weights @ differences[:, uneven]
        sums = np.bincount(to.ravel(), shares.ravel(), height * width).reshape(height, width)
        return np.asarray(blurred + sums[reach : height - reach, reach : width - reach], dtype=np.float32)

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
        depth = 1.0 / np.where(visible, inverse_depth, np.float32(1.0))
        through = np.exp(np.float32(-self._fog.at(t)) * norms * depth)
        seen = through * emitted + (1.0 - through) * cover * self._fog.excess
        image += np.where(visible, seen - cover * image, 0.0)

    def _in_view(self, poses: FloatArray) -> list[tuple[Plate, tuple[slice, slice]]]:
        """Plates that may be visible from ``poses`` (N, 4, 4), the farthest first, each with its rows and columns."""
        centre = poses[:, :3, 3].mean(axis=0)
        heights = np.sum((poses[:, None, :3, 3] - self._centres) * self._normals, axis=-1)
        lows, highs, in_front = self._boxes(poses)
        seen = np.all(heights > 1e-3, axis=0) & in_front & np.all(highs > lows, axis=1)
        distance = np.linalg.norm(self._centres - centre, axis=1)
        order = [index for index in np.argsort(-distance) if seen[index]]
        return [(self._plates[n], (slice(lows[n, 1], highs[n, 1]), slice(lows[n, 0], highs[n, 0]))) for n in order]

    def _boxes(self, poses: FloatArray) -> tuple[IntArray, IntArray, BoolArray]:
        """Low and high corner (P, 2) [px] of the area that each plate may cover; whether any of it is in front (P,)."""
        points = (self._outlines - poses[:, None, None, :3, 3]) @ poses[:, None, :3, :3]
        front = points[..., 2] > NEAR
        pixels = self._outline_pixels(points[..., :2] / np.where(front, points[..., 2], 1.0)[..., None])
        low, high = pixels.min(axis=(0, 2)), pixels.max(axis=(0, 2))
        some = np.any(front, axis=(0, 2))
        for index in np.flatnonzero(some & ~np.all(front, axis=(0, 2))):
            visible = np.concatenate([clipped(outline) for outline in points[:, index]])
            pixels = self._outline_pixels(visible[:, :2] / visible[:, 2:])
            low[index], high[index] = pixels.min(axis=0), pixels.max(axis=0)
        size = np.array([self._lens.width, self._lens.height])
        return (
            np.clip(np.floor(low) - 3 - self._spread.reach, 0, size).astype(np.int64),
            np.clip(np.ceil(high) + 4 + self._spread.reach, 0, size).astype(np.int64),
            some,
        )

    def _outline_pixels(self, slopes: FloatArray) -> FloatArray:
        """Pixels of rays; rays far outside the image are moved to a circle around it, where the lens model is valid."""
        radius = np.linalg.norm(slopes, axis=-1, keepdims=True)
        return self._lens.project_slopes(slopes * np.minimum(1.0, self._max_slope / np.maximum(radius, 1e-9)))


def _lattice(quality: Quality, duration: float, lag: float) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Offsets in the pixel [px], ages before the end of the sub-frame [s] in rising order, share that decays."""
    n = quality.samples
    columns, rows, times = (((np.arange(n) * g) % n + 0.5) / n for g in LATTICES[n])
    forget = float(np.exp(-duration / lag)) if lag > 0 else 0.0
    continuous = lag > 0 and not quality.stepwise
    ages = -lag * np.log(1.0 - times * (1.0 - forget)) if continuous else np.zeros(n)
    order = np.argsort(ages, kind='stable')
    return columns[order] - 0.5, rows[order] - 0.5, ages[order], forget


def _point_spread(sigma: float, dx: FloatArray, dy: FloatArray) -> _PointSpread:
    """A Gaussian of ``sigma`` [px], integrated over the pixel that is computed, at points ``dx``, ``dy`` (N,) [px]."""
    if sigma <= 0:
        return _PointSpread(0, np.full((1, len(dx)), 1.0 / len(dx), np.float32))
    # Farther away is a two-thousandth of its weight.
    reach = int(np.ceil(3.5 * np.hypot(sigma, np.sqrt(1.0 / 12.0)) - 0.5))
    neighbours = np.arange(-reach, reach + 1)[:, None]
    of_rows, of_columns = (
        ndtr((neighbours + offset + 0.5) / sigma) - ndtr((neighbours + offset - 0.5) / sigma) for offset in (dy, dx)
    )
    weights = of_rows[:, None] * of_columns
    return _PointSpread(reach, np.asarray(weights / weights.sum(), dtype=np.float32).reshape(-1, len(dx)))


@lru_cache(maxsize=2)
def _pixel_rays(lens: Lens) -> Float32Array:
    """(7, height, width): ray x y 1 of each pixel's centre, and dx/du dx/dv dy/du dy/dv."""
    v, u = np.mgrid[0 : lens.height, 0 : lens.width].astype(np.float64)
    slopes = lens.slopes(np.stack([u, v], axis=-1))
    J = lens.slopes_jacobian(slopes)
    ones = np.ones_like(u)
    terms = [slopes[..., 0], slopes[..., 1], ones, J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]]
    return np.stack(terms).astype(np.float32)


@lru_cache(maxsize=2)
def _coarse_rays(lens: Lens) -> FloatArray:
    """Rays (rows, columns, 3) through the centres of the blocks of pixels of ``cv2.resize``."""
    rows, columns = -(-lens.height // _COARSE), -(-lens.width // _COARSE)
    v, u = (np.mgrid[0:rows, 0:columns] + 0.5) * _COARSE - 0.5
    slopes = lens.slopes(np.stack([u, v], axis=-1))
    return np.concatenate([slopes, np.ones((rows, columns, 1))], axis=-1)


def _coarse_delays(height: int, readout: float) -> FloatArray:
    """Times [s] at which rows of :func:`_coarse_rays` are read out, after the middle row: (rows,), or one for all."""
    if readout <= 0:
        return np.zeros(1)
    rows = (np.arange(-(-height // _COARSE)) + 0.5) * _COARSE - 0.5
    return np.asarray(readout * (rows / (height - 1) - 0.5))
