"""Calibration boards and how their points are found in raw frames: chessboard, circle grid, marker board."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from thermal_fiducial.calibration.appearance import Appearance, Disc, SquaresMeet
from thermal_fiducial.calibration.keypoints import blobs, Keypoints, saddles, without_speckles
from thermal_fiducial.calibration.lattice import find_board
from thermal_fiducial.calibration.placement import BoardNodes
from thermal_fiducial.calibration.subpixel import refine
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import corners_in_map
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.core.types import Counts, Float32Array, FloatArray, Gray, IntArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import asymmetric_circles

_APART_NS = 10_000_000_000


@dataclass(frozen=True)
class Sighting:
    """Points of a board in one frame.

    Parameters
    ----------
    points : (N, 3) on the board [m]
    pixels : (N, 2) in the raw image
    """

    points: FloatArray
    pixels: FloatArray


class Target(Protocol):
    """A calibration board."""

    #: radius of the board's points [m]: 0 for corners
    radius: float

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting | None:
        """The board in a raw frame; ``camera`` is the best guess so far; None where it isn't seen."""


class Detector(Protocol):
    """What a marker board needs of a detector of markers."""

    def detect(self, stamp_ns: int, counts: Counts | Gray, camera: Camera) -> Markers:
        """Rows of the markers of a frame."""


class Chessboard:
    """A chessboard of warm and cold squares.

    Parameters
    ----------
    columns, rows : inner corners, as OpenCV counts them
    square : side of a square [m]
    """

    radius = 0.0

    def __init__(self, columns: int, rows: int, square: float) -> None:
        if columns < 3 or rows < 3 or not square > 0.0:
            raise InputError('a chessboard needs 3 x 3 inner corners or more and squares with a size')
        nodes = _rectangle(columns, rows)
        self.points = _on_board(square * nodes.astype(np.float64))
        self._board = BoardNodes(nodes)

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting | None:
        """See :class:`Target`."""
        image = without_speckles(counts)
        return _sighting(image, saddles(image), self._board, self.points, SquaresMeet())


class CircleGrid:
    """A grid of round holes or spots.

    Parameters
    ----------
    columns, rows : as ``cv2.findCirclesGrid`` counts them, e.g. 4 and 11
    spacing : between two rows [m]
    diameter : of a circle [m]
    asymmetric : whether every other row is shifted by ``spacing``, circles in a row two of them apart
    """

    def __init__(self, columns: int, rows: int, spacing: float, diameter: float, *, asymmetric: bool = True) -> None:
        pitch = spacing * np.sqrt(2.0) if asymmetric else spacing
        if columns < 2 or rows < 3 or not 0.0 < diameter < pitch:
            raise InputError('a circle grid needs 2 x 3 circles or more, and circles smaller than their spacing')
        nodes = _rectangle(columns, rows)
        centres = asymmetric_circles(columns, rows, spacing) if asymmetric else spacing * nodes.astype(np.float64)
        self.points = _on_board(centres)
        if asymmetric:
            # The nearest circles are those of the next row: the grid's axes run along the diagonals.
            x, y = np.rint(self.points[:, :2].T / spacing).astype(np.int64)
            nodes = np.stack([(x + y) // 2, (y - x) // 2], axis=1)
        self._board = BoardNodes(nodes)
        self._disc = Disc(0.5 * diameter / pitch)
        self.radius = 0.5 * diameter

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting | None:
        """See :class:`Target`."""
        image = without_speckles(counts)
        return _sighting(image, blobs(image), self._board, self.points, self._disc)


def _rectangle(columns: int, rows: int) -> IntArray:
    """Nodes (rows * columns, 2) row by row."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.stack([column, row], axis=1).astype(np.int64)


def _on_board(points: FloatArray) -> FloatArray:
    return np.asarray(np.column_stack([points, np.zeros(len(points))]), dtype=np.float64)


def _sighting(
    image: Float32Array, keypoints: Iterable[Keypoints], board: BoardNodes, points: FloatArray, appearance: Appearance
) -> Sighting | None:
    """Find a board roughly, then its points to a few hundredths of a pixel."""
    found = find_board(keypoints, board)
    if found is None:
        return None
    nodes = board.nodes.astype(np.float64)
    pixels = refine(image, nodes[found.points], found.pixels, nodes, appearance)
    seen = np.isfinite(pixels[:, 0])
    kept = found.points[seen]
    # What turns out to be no point of the board may have been all that told where in the grid it lies.
    return Sighting(points[kept], pixels[seen]) if board.place(board.nodes[kept]) is not None else None


class MarkerBoard:
    """Markers of known poses, e.g. stencils on a base plate; a part of them may be in view.

    Parameters
    ----------
    board : their map
    detector : of the dictionary of the map
    """

    radius = 0.0

    def __init__(self, board: MarkerMap, detector: Detector) -> None:
        self._board, self._detector = board, detector
        self._stamp_ns = 0

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting | None:
        """See :class:`Target`."""
        # Views have nothing to do with each other: far apart in time none hints at motion to the next.
        self._stamp_ns += _APART_NS
        rows = self._detector.detect(self._stamp_ns, counts, camera)
        rows = rows[np.isin(rows['id'], list(self._board.markers))]
        if len(rows) < 2:
            return None
        markers = [self._board.markers[marker_id] for marker_id in rows['id'].tolist()]
        T = np.stack([marker.T_map_marker for marker in markers])
        points = corners_in_map(T, np.array([marker.size for marker in markers]))
        return Sighting(points.reshape(-1, 3), corners_px(rows).reshape(-1, 2))
