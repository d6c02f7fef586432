"""Calibration boards and their detection in raw frames: chessboard, circle grid, marker board."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from thermal_fiducial.calibration.appearance import Disc, SquaresMeet
from thermal_fiducial.calibration.board_shape import BoardShape
from thermal_fiducial.calibration.keypoints import blobs, saddles, without_speckles
from thermal_fiducial.calibration.placement import BoardNodes
from thermal_fiducial.calibration.recognition import BoardNotFound, recognise
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.mapping.map_data import corners_of_markers, MarkerMap
from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.core.types import Counts, FloatArray, Gray, IntArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import LEAST_MARKERS

_APART_NS = 10_000_000_000
# Eighth singular value of a homography's equations, relative to the first: four points of a board that is seen at 88
# degrees have 0.014, and with three of them on a line, and noise of 0.1 px, less than 0.001.
_ONE_HOMOGRAPHY = 3e-3
# Number of similar discs beyond the board that prove a larger grid; one or two may be clutter.
_ANOTHER_GRID = 3


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


def settles_a_pose(sighting: Sighting) -> bool:
    """Whether one pose alone of a flat board fits its points: four or more, not all but one of them on a line.

    The homography from board to image is then the only one (R. Hartley, A. Zisserman, "Multiple View Geometry", 2004,
    sections 4.1 and 4.4): its equations, of coordinates that are centred and scaled, have rank 8.
    """
    board, pixels = (_scaled(places) for places in (sighting.points[:, :2], sighting.pixels))
    from_board = np.column_stack([board, np.ones(len(board))])
    none = np.zeros_like(from_board)
    rows = [[from_board, none, -pixels[:, :1] * from_board], [none, from_board, -pixels[:, 1:] * from_board]]
    sizes = np.linalg.svd(np.block(rows), compute_uv=False)
    return bool(len(sizes) >= 8 and sizes[7] > _ONE_HOMOGRAPHY * sizes[0])


def _scaled(places: FloatArray) -> FloatArray:
    centred = places - places.mean(axis=0)
    size = float(np.sqrt(np.mean(np.sum(centred**2, axis=1))))
    return np.asarray(centred / size if size > 0.0 else centred, dtype=np.float64)


class Target(Protocol):
    """A calibration board."""

    #: radius of the board's points [m]: 0 for corners
    radius: float

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting:
        """Find the board in a raw frame; ``camera`` is the present estimate.

        Raises
        ------
        BoardNotFound
            It is not in view, or it is another board.
        """


class Detector(Protocol):
    """Interface of the marker detector for a marker board."""

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
        # Outer corners of the outermost squares may look like points, one for every other square.
        self._line = min(columns, rows)

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting:
        """See :class:`Target`."""
        image = without_speckles(counts)
        found = recognise(image, saddles(image), self._board, SquaresMeet(), self._line)
        return Sighting(self.points[found.points], found.pixels)


class CircleGrid:
    """A grid of round holes or spots.

    Parameters
    ----------
    columns, rows : as ``cv2.findCirclesGrid`` counts them, e.g. 4 and 11
    spacing : between two rows [m]
    diameter : of a circle [m]
    asymmetric : whether every other row is shifted by ``spacing``, circles in a row two of them apart
    longer : number of additional circles in every other row, from the second on; the rows are then centred
    missing : column and row, from 0, of missing circles
    """

    def __init__(
        self,
        columns: int,
        rows: int,
        spacing: float,
        diameter: float,
        *,
        asymmetric: bool = True,
        longer: int = 0,
        missing: Sequence[tuple[int, int]] = (),
    ) -> None:
        pitch = spacing * np.sqrt(2.0) if asymmetric else spacing
        if columns < 2 or rows < 3:
            raise InputError(f'a circle grid needs 2 x 3 circles or more, not {columns} x {rows}')
        if not 0.0 < diameter < pitch:
            apart = f'circles of {1e3 * diameter:g} mm, {1e3 * pitch:.3g} mm from one to the next'
            raise InputError(f'{apart}: the circles of a grid are smaller than that')
        if longer < 0 or (asymmetric and longer not in (0, 1)):
            raise InputError('every other row may have one circle more, or in a symmetric grid several')
        places = [(c, r) for r in range(rows) for c in range(columns + longer * (r % 2))]
        if not set(missing) <= set(places):
            raise InputError(f'there is no circle {sorted(set(missing) - set(places))[0]} in this grid to be missing')
        nodes, centres = _circles(np.array(places, dtype=np.int64), spacing, longer, asymmetric=asymmetric)
        there = np.array([place not in set(missing) for place in places])
        self.points = _on_board(centres[there])
        self._board = BoardNodes(nodes[there], nodes[~there])
        self._disc = Disc(0.5 * diameter / pitch)
        self.radius = 0.5 * diameter

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting:
        """See :class:`Target`."""
        image = without_speckles(counts)
        tone_curve = counts.dtype == np.uint8
        found = recognise(image, blobs(image), self._board, self._disc, _ANOTHER_GRID, tone_curve=tone_curve)
        return Sighting(self.points[found.points], found.pixels)


def _circles(places: IntArray, spacing: float, longer: int, *, asymmetric: bool) -> tuple[IntArray, FloatArray]:
    """Nodes (N, 2) and centres (N, 2) [m] of circles at columns and rows (N, 2)."""
    column, row = places.T
    if not asymmetric:
        return places, spacing * places.astype(np.float64)
    # A longer row begins half a pitch earlier, one of the same length half a pitch later.
    x, y = 2 * column + (row % 2) * (-1 if longer else 1), row
    # The nearest circles are those of the next row: the grid's axes run along the diagonals.
    nodes = np.stack([(x + y) // 2, (y - x) // 2], axis=1)
    return nodes, spacing * np.stack([x, y], axis=1).astype(np.float64)


def _rectangle(columns: int, rows: int) -> IntArray:
    """Nodes (rows * columns, 2) row by row."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    return np.stack([column, row], axis=1).astype(np.int64)


def _on_board(points: FloatArray) -> FloatArray:
    return np.asarray(np.column_stack([points, np.zeros(len(points))]), dtype=np.float64)


class MarkerBoard:
    """Markers of known poses, e.g. stencils on a base plate; a subset in view suffices.

    Parameters
    ----------
    board : their map; markers in quarantine are left alone
    detector : of the dictionary of the map

    Raises
    ------
    InputError
        The map has fewer markers than a view needs.
    """

    radius = 0.0

    def __init__(self, board: MarkerMap, detector: Detector) -> None:
        self._board = board
        self._markers = {key: marker for key, marker in board.markers.items() if marker.trusted}
        if len(self._markers) < LEAST_MARKERS:
            raise InputError(f'a board of {number_of(len(self._markers), "marker")}: calibration needs two or more')
        self._detector = detector
        self._stamp_ns = 0

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting:
        """See :class:`Target`."""
        # Views are independent: stamps far apart keep the detector from predicting motion between them.
        self._stamp_ns += _APART_NS
        return self.sighting(self._detector.detect(self._stamp_ns, counts, camera))

    def as_found(self, shape: BoardShape) -> MarkerMap:
        """The map of the board with its markers moved to where their corners were found."""
        moved = dict(self._board.markers)
        for (key, marker), corners in zip(self._markers.items(), self._corners(self._markers), strict=True):
            places = np.stack([shape.found(corner) for corner in corners])
            moved[key] = replace(marker, T_map_marker=se3.rigid_alignment(places, corners) @ marker.T_map_marker)
        return replace(self._board, markers=moved)

    def sighting(self, rows: Markers) -> Sighting:
        """Markers of the board among those of a frame. Raises BoardNotFound where they are too few."""
        rows = rows[np.isin(rows['id'], list(self._markers))]
        if len(rows) < LEAST_MARKERS:
            raise BoardNotFound(f'{number_of(len(rows), "marker")} of the board, of which two are needed')
        return Sighting(self._corners(rows['id'].tolist()).reshape(-1, 3), corners_px(rows).reshape(-1, 2))

    def _corners(self, ids: Iterable[int]) -> FloatArray:
        """Corners (N, 4, 3) of markers as described [m]."""
        return corners_of_markers([self._markers[marker_id] for marker_id in ids])
