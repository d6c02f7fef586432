"""Looking up rays in the planes of plates: homographies, strips of rows of a rolling shutter, cells and outlines."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from thermal_fiducial.core.types import BoolArray, Float32Array, FloatArray, Gray, IntArray
from thermal_fiducial.sim.scene import Plate

#: Longest read-out of a strip [s]: interpolation over it misses 0.016 px of a vibration of 0.1 px at 180 Hz.
STRIP_TIME = 1e-3
#: Depth of the near plane [m].
NEAR = 0.05
_KERNEL = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class Strip:
    """Rows ``start`` to ``stop`` of the image, read out between two nodes, or all rows at a single one."""

    start: int
    stop: int
    node: int
    rolling: bool

    def within(self, rows: slice) -> slice:
        """The part of ``rows`` that lies in the strip."""
        return slice(max(rows.start, self.start), min(rows.stop, self.stop))

    def rows_of(self, rows: slice, margin: int) -> tuple[slice, slice]:
        """The strip's part of ``rows``, extended by ``margin`` at each end if possible, and the part's place in it."""
        own = self.within(rows)
        padded = slice(max(own.start - margin, rows.start), min(own.stop + margin, rows.stop))
        return padded, slice(own.start - padded.start, own.stop - padded.start)

    def share(self, rows: slice) -> Float32Array:
        """Position (rows, 1) of each of ``rows`` between the nodes: 0 at the first, 1 at the second."""
        done = (np.arange(rows.start, rows.stop) - self.start) / (self.stop - self.start)
        return np.asarray(done[:, None], dtype=np.float32)

    def motion(self, H: FloatArray) -> FloatArray:
        """H (nodes, N, 3, 3) at the first node, and its change until the second (1 or 2, N, 3, 3)."""
        first = H[self.node]
        return np.stack([first, H[self.node + 1] - first]) if self.rolling else first[None]


def strips(height: int, readout: float) -> tuple[list[Strip], FloatArray]:
    """Strips of an image, and the times [s] of the nodes between them, after that of the middle row."""
    if readout <= 0:
        return [Strip(0, height, 0, rolling=False)], np.zeros(1)
    count = min(int(np.ceil(readout / STRIP_TIME)), height)
    borders = np.round(np.linspace(0, height, count + 1)).astype(int).tolist()
    strips = [Strip(start, stop, n, rolling=True) for n, (start, stop) in enumerate(pairwise(borders))]
    return strips, readout * (np.array(borders) / (height - 1) - 0.5)


def ray_factors(rays: Float32Array, share: Float32Array, H: FloatArray) -> Float32Array:
    """Factors (K or 2 K, rows * columns), for ``rays`` (K, rows, columns), of H at the first node and of its change."""
    return np.concatenate([rays, share * rays] if len(H) > 1 else [rays]).reshape(len(H) * len(rays), -1)


def homographies(plate: Plate, poses: FloatArray) -> FloatArray:
    """H (..., 3, 3) with H (x, y, 1) = (column, row, 1) / depth for the ray x y 1, seen from ``poses`` (..., 4, 4)."""
    R_plate_map = plate.T_map_plate[:3, :3].T
    D = R_plate_map @ poses[..., :3, :3]
    o = (poses[..., :3, 3] - plate.T_map_plate[:3, 3]) @ R_plate_map.T
    metres = D - (o / o[..., 2:])[..., None] * D[..., 2:, :]
    metres[..., 2, :] = -D[..., 2, :] / o[..., 2:]
    return np.asarray(plate.to_cells @ metres)


def look_up(
    rays: Float32Array, H: FloatArray, offsets: FloatArray | None = None
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Column, row and inverse depth (N, M) at which rays, moved by ``offsets`` (N, 2) [px], hit the plate.

    ``rays`` are those of :func:`ray_factors`, ``H`` is the :meth:`Strip.motion` of the strip.
    """
    matrix = np.concatenate([_ray_terms(part, offsets) for part in H], axis=1)
    u, v, inverse_depth = (matrix @ rays).reshape(3, H.shape[1], -1)
    # Behind the camera this puts the point far off the plate.
    depth = 1.0 / np.maximum(inverse_depth, np.float32(1e-6))
    u *= depth
    v *= depth
    return u, v, inverse_depth


def _ray_terms(H: FloatArray, offsets: FloatArray | None) -> Float32Array:
    """Matrix (3 N, 3 or 7) that multiplies a ray (3 or 7,) for ``H`` (N, 3, 3)."""
    terms = [H[..., 0], H[..., 1], H[..., 2]]
    if offsets is not None:
        dx, dy = offsets[:, :1], offsets[:, 1:]
        terms += [H[..., 0] * dx, H[..., 0] * dy, H[..., 1] * dx, H[..., 1] * dy]
    return np.stack(terms, axis=-1).transpose(1, 0, 2).reshape(-1, len(terms)).astype(np.float32)


def cell_indices(u: Float32Array, v: Float32Array, plate: Plate) -> IntArray:
    """Index into the plate's flat grids; points off the plate get their border."""
    rows, columns = plate.levels.shape
    row = np.clip(v, 0, rows - 0.5).astype(np.intp)
    row *= columns
    row += np.clip(u, 0, columns - 0.5).astype(np.intp)
    return row


def cut_pixels(regions: Gray) -> BoolArray:
    """Pixels (h, w) with several regions in their 3 x 3 neighbourhood at the times of ``regions`` (3, h, w)."""
    highest = cv2.dilate(np.maximum(np.maximum(regions[0], regions[1]), regions[2]), _KERNEL)
    lowest = cv2.erode(np.minimum(np.minimum(regions[0], regions[1]), regions[2]), _KERNEL)
    return np.asarray(highest != lowest)


def outline_points(plate: Plate) -> FloatArray:
    """Outline (32, 3) in ``map`` with eight points a side."""
    corners = plate.outline_map
    s = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None]
    return np.concatenate([a + s * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])


def clipped(outline: FloatArray) -> FloatArray:
    """Points of a closed outline (N, 3) beyond the near plane, and its intersections with that plane."""
    a, b = outline, np.roll(outline, -1, axis=0)
    front = outline[:, 2] > NEAR
    crossing = front != np.roll(front, -1)
    a, b = a[crossing], b[crossing]
    share = (NEAR - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
    return np.concatenate([outline[front], a + share * (b - a)])
