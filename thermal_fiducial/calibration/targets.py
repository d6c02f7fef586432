"""Calibration boards and how their points are found in raw frames: chessboard, circle grid, marker board."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from thermal_fiducial.calibration.subpixel import centroids, saddle_points
from thermal_fiducial.calibration.views import board_views, without_speckles
from thermal_fiducial.core.camera import Camera
from thermal_fiducial.core.map_data import MarkerMap
from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.core.reprojection import corners_in_map
from thermal_fiducial.core.types import Counts, FloatArray, Gray
from thermal_fiducial.errors import InputError
from thermal_fiducial.fabrication.boards import asymmetric_circles

# Share of a grid's circles that must be wholly in the image.
_LEAST_SHARE = 0.6
# Blobs to choose the circles from, in circles of the board.
_MOST_BLOBS = 3
_APART_NS = 10_000_000_000
# Images up to this width [px] are enlarged for the search.
_SMALL = 400
_GRID = cv2.CALIB_CB_ASYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
# A board whose points lie closer than this [px] is too far away to give sub-pixel points.
_LEAST_SPACING = 6.0


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
        self._size = (columns, rows)
        row, column = np.divmod(np.arange(rows * columns), columns)
        self.points = np.stack([column * square, row * square, np.zeros(rows * columns)], axis=1)

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting | None:
        """See :class:`Target`."""
        image = without_speckles(counts)
        for view in board_views(image):
            corners = self._corners(view)
            if corners is not None:
                spacing = _spacing(corners, self._size[0])
                pixels = saddle_points(image, corners, spacing) if spacing.min() >= _LEAST_SPACING else None
                return None if pixels is None else Sighting(self.points, pixels)
        return None

    def _corners(self, view: Gray) -> FloatArray | None:
        # Small sensors: the search wants squares of ten pixels or more.
        scale = 2 if view.shape[1] <= _SMALL else 1
        view = cv2.resize(view, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC).astype(np.uint8)
        found, corners = cv2.findChessboardCornersSB(view, self._size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
            found, corners = cv2.findChessboardCorners(view, self._size, flags=flags)
        return (np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5) / scale - 0.5 if found else None


class CircleGrid:
    """An asymmetric grid of round holes.

    Parameters
    ----------
    columns, rows : as ``cv2.findCirclesGrid`` counts them, e.g. 4 and 11
    spacing : between two rows [m]
    diameter : of a circle [m]
    """

    def __init__(self, columns: int, rows: int, spacing: float, diameter: float) -> None:
        if columns < 2 or rows < 3 or not 0.0 < diameter < 2.0 * spacing:
            raise InputError('a circle grid needs 2 x 3 circles or more, and circles smaller than their spacing')
        self._size = (columns, rows)
        self.points = np.column_stack([asymmetric_circles(columns, rows, spacing), np.zeros(rows * columns)])
        self._share = diameter / (spacing * np.sqrt(2.0))
        self.radius = 0.5 * diameter

    def find(self, counts: Counts | Gray, camera: Camera) -> Sighting | None:
        """See :class:`Target`."""
        image = without_speckles(counts)
        for view in board_views(image):
            centres = self._centres(view)
            if centres is not None:
                nearest = _nearest_neighbour(centres)
                pixels = centroids(image, centres, nearest, self._share)
                seen = np.isfinite(pixels[:, 0])
                if np.mean(seen) < _LEAST_SHARE or nearest.min() < _LEAST_SPACING:
                    return None
                return Sighting(self.points[seen], pixels[seen])
        return None

    def _centres(self, view: Gray) -> FloatArray | None:
        """Circles in the order of the board.

        OpenCV's search for the grid takes minutes on thousands of specks, so it is shown the largest blobs only,
        drawn anew; their centres are refined later anyway.
        """
        detector = _blob_detector()
        blobs = sorted(detector.detect(view), key=lambda blob: -blob.size)[: _MOST_BLOBS * len(self.points)]
        if len(blobs) < len(self.points):
            return None
        canvas = np.full_like(view, 255)
        for blob in blobs:
            centre = round(blob.pt[0]), round(blob.pt[1])
            cv2.circle(canvas, centre, max(2, round(0.35 * blob.size)), 0, -1)
        found, centres = cv2.findCirclesGrid(canvas, self._size, flags=_GRID, blobDetector=detector)
        return np.asarray(centres, dtype=np.float64).reshape(-1, 2) if found else None


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


def _blob_detector() -> cv2.SimpleBlobDetector:
    """Dark blobs of any usable size; views of both polarities are tried."""
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea, parameters.maxArea = 12.0, 20000.0
    parameters.minDistBetweenBlobs = 4.0
    parameters.minThreshold, parameters.maxThreshold, parameters.thresholdStep = 30.0, 226.0, 12.0
    parameters.filterByColor, parameters.blobColor = True, 0
    parameters.filterByConvexity, parameters.minConvexity = True, 0.8
    parameters.filterByInertia, parameters.filterByCircularity = False, False
    return cv2.SimpleBlobDetector.create(parameters)


def _spacing(corners: FloatArray, columns: int) -> FloatArray:
    """Distance (N,) of each corner to the nearest of its neighbours in its row and column [px]."""
    grid = corners.reshape(-1, columns, 2)
    along = np.linalg.norm(np.diff(grid, axis=1), axis=-1)
    down = np.linalg.norm(np.diff(grid, axis=0), axis=-1)
    far = np.inf
    steps = [
        np.pad(along, ((0, 0), (1, 0)), constant_values=far),
        np.pad(along, ((0, 0), (0, 1)), constant_values=far),
        np.pad(down, ((1, 0), (0, 0)), constant_values=far),
        np.pad(down, ((0, 1), (0, 0)), constant_values=far),
    ]
    return np.asarray(np.min(steps, axis=0).reshape(-1))


def _nearest_neighbour(points: FloatArray) -> FloatArray:
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    return np.asarray(distance.min(axis=1))
