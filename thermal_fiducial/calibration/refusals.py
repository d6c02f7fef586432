"""Why a board is not found in an image, by what the image shows of it.

The place of an incomplete board in its grid is unclear whatever hides the rest of it. What helps depends on that:
distance and tilt, focus, the border of the image, faint contrast, or something before the board.
"""

import cv2
import numpy as np

from thermal_fiducial.calibration.appearance import Appearance
from thermal_fiducial.calibration.grid_search import RefusedGrid
from thermal_fiducial.calibration.keypoints import NOISE_RATIO
from thermal_fiducial.calibration.placement import BoardNodes
from thermal_fiducial.calibration.subpixel import blur_of, refine
from thermal_fiducial.calibration.surface import local_surfaces, Surfaces
from thermal_fiducial.calibration.windows import LEAST_SPACING
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray

# Grids of this many points, or of this share of the board's, are chance: those of noise and of edges have 5 to 15, up
# to 21 where the points are little above the limit.
_CHANCE, _CHANCE_SHARE, _OF_NOISE, _CHANCE_OF_NOISE = 12, 0.2, 1.5, 25
# Points that are not found are faint where those found are less than this many times above the limit.
_FAINT = 3.0
# Blur [distances between points] that leaves less than half of the contrast of dots of a third of that.
_BLURRED = 0.25
# Blur of a picture's sharpest edges that is a lens out of focus [px]; optics in focus have 0.5 to 1.2.
_UNSHARP_PX = 2.5
# Share of a picture with the steepest slopes, and least ratio to the usual slope: 3 in noise.
_STEEPEST, _STEEP = 0.003, 6.0
_OF_DIFFERENCE = 1.0 / 3.0
# Share of the places on one side of a grid that lie outside the image.
_OUTSIDE = 0.3
_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))


def why_refused(image: Float32Array, grid: RefusedGrid | None, board: BoardNodes, appearance: Appearance) -> str:
    """Why the heaviest grid of an image is not the board, in one line."""
    if grid is None or _by_chance(grid, len(board.nodes)):
        largest = 'no points form a grid' if grid is None else f'the largest regular grid has {len(grid.nodes)} points'
        blur_px = edge_blur(image)
        cause = 'out of view, too far away, or fainter than the noise'
        if blur_px > _UNSHARP_PX:
            cause = f'out of focus, or moving (the sharpest edges are blurred by {blur_px:.1f} px)'
        return f'no board found: {cause}; {largest}'
    hindered = _hindrance(image, grid, appearance) or _unlike(image, grid, appearance, len(board.nodes))
    unclear = ', which may lie in more than one place of the board' if grid.refusal.covered else ''
    found, whole = len(grid.nodes), len(board.nodes)
    seen = f'{found} of {whole} points found' if found <= whole else f'{found} points in a grid, the board has {whole}'
    return f'{hindered}: {seen}{unclear}'


def why_unlike(image: Float32Array, blur_px: float, nodes: FloatArray, pixels: FloatArray) -> str | None:
    """Why points do not look as described, if that is the image's.

    Parameters
    ----------
    blur_px : of the points that do; NaN if not known
    nodes, pixels : (N, 2) of the grid
    """
    surfaces = local_surfaces(nodes, pixels, nodes)
    return _too_close(surfaces) or _blurred(image, blur_px, surfaces)


def median_spacing(nodes: FloatArray, pixels: FloatArray) -> float:
    """Distance between the points of a grid [px]."""
    return float(np.median(_spacing(local_surfaces(nodes, pixels, nodes))))


def edge_blur(image: Float32Array) -> float:
    """Blur of the steepest edges [px], by how much their slope falls when they are blurred further; 0 without edges."""
    slopes = []
    for blur in (1.0, 2.0):
        smooth = cv2.GaussianBlur(image, (0, 0), blur)
        slopes.append(np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)))
    sharp, smooth = slopes
    limit = float(np.quantile(smooth, 1.0 - _STEEPEST))
    if limit <= _STEEP * float(np.median(smooth)):
        return 0.0
    # The slope of an edge blurred by s falls as 1 / sqrt(s^2 + blur^2); a difference over two pixels blurs too.
    ratio = max(float(np.median(sharp[smooth >= limit] / smooth[smooth >= limit])) ** 2, 1.0 + 1e-3)
    return float(np.sqrt(max(0.0, (4.0 - ratio) / (ratio - 1.0) - _OF_DIFFERENCE)))


def _by_chance(grid: RefusedGrid, count: int) -> bool:
    few = _CHANCE_OF_NOISE if grid.signal < _OF_NOISE * NOISE_RATIO else _CHANCE
    return len(grid.nodes) <= max(few, _CHANCE_SHARE * count)


def _hindrance(image: Float32Array, grid: RefusedGrid, appearance: Appearance) -> str | None:
    """What keeps more points from being found."""
    nodes = grid.nodes.astype(np.float64)
    surfaces = local_surfaces(nodes, grid.pixels, nodes)
    too_close = _too_close(surfaces)
    if too_close:
        return too_close
    faint = grid.signal < _FAINT * NOISE_RATIO
    # Edges around the board show the focus where its points are lost in noise.
    blurred = _blurred(image, np.nan if faint else blur_of(image, nodes, grid.pixels, appearance), surfaces)
    if blurred:
        return blurred
    if _leaves(image.shape, grid.nodes, surfaces):
        return 'partly out of view'
    return 'too faint against the noise' if faint else None


def _too_close(surfaces: Surfaces) -> str | None:
    closest = float(np.percentile(_spacing(surfaces), 10.0))
    if closest >= LEAST_SPACING:
        return None
    return f'too far away or too oblique, points {closest:.1f} px apart where {LEAST_SPACING:.0f} are needed'


def _blurred(image: Float32Array, blur_px: float, surfaces: Surfaces) -> str | None:
    """That points are too blurred, by the edges of the image where the points do not look as described."""
    blur_px = blur_px if np.isfinite(blur_px) else edge_blur(image)
    apart = float(np.median(_spacing(surfaces)))
    if not blur_px > _BLURRED * apart:
        return None
    return f'out of focus or moving, blurred by {blur_px:.1f} px where points are {apart:.1f} px apart'


def _unlike(image: Float32Array, grid: RefusedGrid, appearance: Appearance, count: int) -> str:
    """What is left where nothing in the image explains it."""
    every = grid.nodes.astype(np.float64)
    # Without what lies beside a board and continues its grid.
    nodes = grid.nodes[np.isfinite(refine(image, every, grid.pixels, every, appearance).pixels[:, 0])]
    columns, rows = np.sort(np.ptp(nodes, axis=0) + 1)[::-1].tolist() if len(nodes) else (0, 0)
    if 0 < len(nodes) == columns * rows < count:
        return f'a whole grid of {columns} x {rows} points, which is smaller than the one described'
    return 'partly hidden, or another board'


def _spacing(surfaces: Surfaces) -> FloatArray:
    """Distance (P,) to the nearest other point [px], diagonals among them: oblique views shear a grid."""
    along, across = surfaces.steps[..., 0], surfaces.steps[..., 1]
    every = np.stack([along, across, along + across, along - across])
    return np.asarray(np.linalg.norm(every, axis=2).min(axis=0), dtype=np.float64)


def _leaves(shape: tuple[int, ...], nodes: IntArray, surfaces: Surfaces) -> bool:
    """Whether on one side the grid ends where the image does."""
    known = set(map(tuple, nodes.tolist()))
    for side in _SIDES:
        free = np.array([tuple(node) not in known for node in (nodes + side).tolist()])
        # To the next place and half a step further, for a point needs its surroundings.
        ends = surfaces.centres[free] + 1.5 * np.asarray(surfaces.steps[free] @ np.array(side, dtype=np.float64))
        outside = np.any((ends < 0.0) | (ends > np.array(shape[::-1]) - 1.0), axis=1)
        if np.mean(outside) >= _OUTSIDE:
            return True
    return False
