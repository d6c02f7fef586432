"""What the camera looks at: markers on plates, before a wall that is uneven and cluttered."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rigs.rig import pose, Rig

#: Axes of a marker that faces a camera which looks along x: right, up, out of the face.
FACING = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
#: The wall: texels to a side; how far it is, of the distance of the nearest marker.
WALL, BEHIND = 1024, 2.2
_ATTEMPTS = 50


@dataclass(frozen=True, eq=False)
class Plate:
    """A marker on its plate.

    Parameters
    ----------
    T_map_plate : x right, y up, z out of the face, in the middle of the marker
    cells : (n, n) 1 for white, with the black border
    size : side of the black square [m]
    margin : of white around it, in cells: a multiple of a half
    warmth : of white [K]
    uneven : (2,) how much warmer it is on the right and at the top, as shares
    """

    T_map_plate: np.ndarray
    cells: np.ndarray
    size: float
    margin: float
    warmth: float
    uneven: np.ndarray

    @property
    def corners(self) -> np.ndarray:
        """Corners (4, 3) of the black square in the plate, clockwise from the top left."""
        return self.size / 2.0 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])

    @property
    def cell(self) -> float:
        """Side of a cell [m]."""
        return self.size / len(self.cells)

    @lru_cache(maxsize=64)  # noqa: B019, as the plates of a process are few
    def texture(self, texels: int) -> np.ndarray:
        """Warmth [K] and coverage (H, W, 2), float32, with ``texels``, an even number, to the side of a cell."""
        white = np.pad(np.kron(self.cells, np.ones((texels, texels))), round(self.margin * texels), constant_values=1.0)
        along = (np.arange(len(white)) + 0.5) / len(white) - 0.5
        slope = 1.0 + self.uneven[0] * along + self.uneven[1] * -along[:, None]
        return np.stack((self.warmth * slope * white, np.ones_like(white)), axis=-1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Room:
    """Plates by marker ID, the first in the middle; the wall: warmth (WALL, WALL) [K], float32, pose and side [m]."""

    plates: dict[int, Plate]
    wall: np.ndarray
    T_map_wall: np.ndarray
    wall_side: float


def drawn(rig: Rig, bits: np.ndarray) -> Room:
    """The room of a rig, with markers of a dictionary's ``bits`` (M, n, n)."""
    rng = rig.rng('room')
    # One to two cells, as printed and cut markers have.
    margin = 0.5 * rng.integers(2, 5)
    plates = {}
    for marker_id, T in zip(rng.permutation(len(bits)).tolist(), _places(rig, rng), strict=False):
        cells = np.pad(bits[marker_id], 1).astype(np.float64)
        # A board that is heated from one side.
        plates[marker_id] = Plate(T, cells, rig.task.size, margin, rig.task.contrast, rng.normal(0.0, 0.1, 2))
    distance = BEHIND * rig.near
    return Room(plates, _wall(rng), pose(FACING, np.array([distance, 0.0, 0.0])), 3.0 * distance)


def _places(rig: Rig, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Poses of plates in view, and, for those who look or fly away, of plates beside it; none hides another."""
    width, height = rig.near * np.array([rig.lens.width, rig.lens.height]) / 2.0 / rig.lens.focal
    beside = {'transit': 2.2 * rig.near, 'look away': 1.6 * width}.get(rig.task.style)
    spans = [0.3 * width] + [1.1 * width] * int(rng.integers(0, 10)) + ([beside] * 10 if beside else [])
    seen: list[np.ndarray] = []
    for span in spans:
        for _ in range(_ATTEMPTS):
            across = rng.uniform(-1.0, 1.0, 2) * [span, min(span, 0.8 * height)]
            place = np.array([rng.uniform(0.9, 1.5) * rig.near, *across])
            direction = place[1:] / place[0] * rig.near
            if all(np.linalg.norm(direction - other) > 2.6 * rig.task.size for other in seen):
                seen.append(direction)
                turns = rng.uniform(-1.0, 1.0, 3) * [0.6, 0.4, 0.3]
                yield pose(FACING @ Rotation.from_euler('YXZ', turns).as_matrix(), place)
                break


def _wall(rng: np.random.Generator) -> np.ndarray:
    """Uneven warmth, and up to eleven things that differ from it by three times as much."""
    wall = cv2.resize(rng.normal(size=(24, 24)), (WALL, WALL), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    for _ in range(rng.integers(0, 12)):
        left, top = rng.integers(0, WALL - 64, 2)
        width, height = rng.integers(16, 120, 2)
        wall[top : top + height, left : left + width] = rng.normal(0.0, 3.0)
    return wall * np.float32(rng.uniform(0.1, 1.2))
