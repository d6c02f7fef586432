"""The image that the lens forms of a room, without noise: rays met with planes, blurred, averaged over each pixel.

Optics blur before pixels sample: means over pixels that are blurred afterwards are aliased, and sides along the
axes of the image up to 0.05 px off, by their phase.
"""

import math

import cv2
import numpy as np

from rigs.lens import Lens
from rigs.room import Plate, Room, WALL

#: Rays to the side of a pixel: edges are as wide as a texel, and texels nearly as rays are apart. Sides along the axes
#: of the image are 0.005 px off (rms); with two 0.010, and with four 0.003 in twice the time.
_PER_SIDE = 3
#: Farther away the blur has a hundredth of a percent of its middle [standard deviations].
_REACH = 4.0
#: Pairs of texels to the side of a cell: at least, at most.
_PAIRS = (1, 64)
#: Coordinate of rays that never meet a plane [m].
_NOWHERE = 1e4
#: Textures count rows from the top.
_DOWN = np.array([1.0, -1.0], dtype=np.float32)
#: Inverse depth that is never reached [1/m].
_HORIZON = 1e-4


class Renderer:
    """The view of a room through a lens whose optics blur by a Gaussian of ``spread`` [px], before the pixels' area."""

    def __init__(self, lens: Lens, room: Room, spread: float = 0.0) -> None:
        self._lens, self._room, self._spread = lens, room, spread
        # Pixels around those that see a plate directly.
        self._margin = 1 + math.ceil(_REACH * spread)
        self._fine = lens.rays(lens.pixels(_PER_SIDE)).astype(np.float32)
        self._rays = lens.rays(lens.pixels()).astype(np.float32)
        # What a column of pixels has in x, and a row in y.
        self._columns = self._rays[..., 0].min(axis=0), self._rays[..., 0].max(axis=0)
        self._rows = self._rays[..., 1].min(axis=1), self._rays[..., 1].max(axis=1)

    def kelvin(self, T_map_camera: np.ndarray) -> np.ndarray:
        """Temperatures (H, W) above that of acrylic [K], float32."""
        T_camera_map = np.linalg.inv(T_map_camera)
        image = self._wall(T_camera_map @ self._room.T_map_wall)
        plates = [(T_camera_map @ plate.T_map_plate, plate) for plate in self._room.plates.values()]
        for T, plate in sorted(plates, key=lambda item: -np.linalg.norm(item[0][:3, 3])):
            self._paint(image, T, plate)
        return image

    def _wall(self, T_camera_wall: np.ndarray) -> np.ndarray:
        places = _places(self._rays, T_camera_wall, self._room.wall_side, WALL)
        wall = cv2.remap(self._room.wall, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return _blurred(wall, self._spread)

    def _paint(self, image: np.ndarray, T_camera_plate: np.ndarray, plate: Plate) -> None:
        edge = 1.0 + 2.0 * plate.margin / len(plate.cells)
        corners = edge * plate.corners @ T_camera_plate[:3, :3].T + T_camera_plate[:3, 3]
        rows, columns = self._box(corners)
        if rows.stop <= rows.start or columns.stop <= columns.start:
            return
        rays = self._fine[_finer(rows), _finer(columns)]
        cell_px = self._lens.focal[0] * plate.cell / np.linalg.norm(T_camera_plate[:3, 3])
        texture = plate.texture(2 * int(np.clip(np.round(cell_px * _PER_SIDE / 2.0), *_PAIRS)))
        places = _places(rays, T_camera_plate, edge * plate.size, len(texture))
        fine = cv2.remap(texture, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        fine = _blurred(fine, _PER_SIDE * self._spread)
        size = columns.stop - columns.start, rows.stop - rows.start
        kelvin, covered = cv2.split(cv2.resize(fine, size, interpolation=cv2.INTER_AREA))
        image[rows, columns] = image[rows, columns] * (1.0 - covered) + kelvin

    def _box(self, corners: np.ndarray) -> tuple[slice, slice]:
        """Rows and columns of pixels that may show a plate with such corners (4, 3)."""
        if corners[:, 2].max() <= 0.0:
            return slice(0, 0), slice(0, 0)
        if corners[:, 2].min() <= 0.0:
            return slice(0, self._lens.height), slice(0, self._lens.width)
        (left, top), (right, bottom) = (f(corners[:, :2] / corners[:, 2:], axis=0) for f in (np.min, np.max))
        return self._between(*self._rows, top, bottom), self._between(*self._columns, left, right)

    def _between(self, lowest: np.ndarray, highest: np.ndarray, begin: float, end: float) -> slice:
        """Those whose range ``lowest`` to ``highest`` reaches into ``begin`` to ``end``, and those its blur reaches."""
        inside = np.flatnonzero((highest >= begin) & (lowest <= end))
        if not len(inside):
            return slice(0, 0)
        return slice(max(int(inside[0]) - self._margin, 0), min(int(inside[-1]) + 1 + self._margin, len(lowest)))


def _places(rays: np.ndarray, T_camera_plane: np.ndarray, side: float, texels: int) -> np.ndarray:
    """Columns and rows (H, W, 2) of a texture, in the middle of a plane and ``side`` [m] wide, that rays meet."""
    # A point x, y of the plane is seen along (x, y, 1) / depth = H ray.
    H = np.linalg.inv(T_camera_plane[:3, [0, 1, 3]])
    met = cv2.transform(rays, H)
    met[met[..., 2] < _HORIZON] = (_NOWHERE, _NOWHERE, 1.0)
    return met[..., :2] / met[..., 2:] * (_DOWN * np.float32(texels / side)) + np.float32(texels / 2.0 - 0.5)


def _blurred(image: np.ndarray, spread: float) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), spread, borderType=cv2.BORDER_REPLICATE) if spread > 0.0 else image


def _finer(pixels: slice) -> slice:
    return slice(pixels.start * _PER_SIDE, pixels.stop * _PER_SIDE)
