"""A board among candidate points: found, refined and checked, or why it is not."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.appearance import Appearance
from thermal_fiducial.calibration.grid_search import BoardPoints, find_board, GridSearch, RefusedGrid
from thermal_fiducial.calibration.keypoints import Keypoints
from thermal_fiducial.calibration.placement import BoardNodes, goes_on, GridRefusal
from thermal_fiducial.calibration.refusals import median_spacing, why_refused, why_unlike
from thermal_fiducial.calibration.subpixel import refine, Refined
from thermal_fiducial.core.types import Float32Array, FloatArray, IntArray, TINY
from thermal_fiducial.errors import InputError

# Largest deviation of the circles' width from the described one: the radius enters where the middle of an image of a
# circle lies, with its square.
_OF_ITS_WIDTH = 0.2
# Smallest share of matching points of a grid that is reported as incomplete; below, it is another pattern.
_ALIKE = 0.5


class BoardNotFound(InputError):  # noqa: N818  (nothing went wrong)
    """The board is not found in a frame; the message says why."""


class Recognised(NamedTuple):
    """Points (N,) of a board and their pixels (N, 2)."""

    points: IntArray
    pixels: FloatArray


def recognise(
    image: Float32Array,
    keypoints: Iterable[Keypoints],
    board: BoardNodes,
    appearance: Appearance,
    another: int,
    *,
    tone_curve: bool = False,
) -> Recognised:
    """Find a board and refine its points to a few hundredths of a pixel.

    Parameters
    ----------
    another : number of similar points beyond the board that make it another one
    tone_curve : whether grey values are some curve of the counts, as in pictures of 8 bit

    Raises
    ------
    BoardNotFound
        It is not in view, or it is another board.
    """
    search = find_board(keypoints, board)
    seen, larger = search.placed, search.refused
    good_of_larger = _good_of_larger(image, search, appearance)
    if seen is not None:
        return _checked(image, seen, board, appearance, another, _Known(good_of_larger, tone_curve))
    if larger is None or good_of_larger is None or len(good_of_larger.points) < _ALIKE * len(larger.nodes):
        raise BoardNotFound(why_refused(image, larger, board, appearance))
    return _within(image, larger, good_of_larger, board, appearance, another)


class _Known(NamedTuple):
    """What else is known of an image: the good points of a larger grid that covers the board, and its tone curve."""

    good_of_larger: Recognised | None
    tone_curve: bool


def _good_of_larger(image: Float32Array, search: GridSearch, appearance: Appearance) -> Recognised | None:
    """Rows and pixels of the points that look like the board's, of a refused grid that covers most of it.

    Its points beyond the board are expected to have the contrast of the board's: in a row of clutter each is as faint
    as the others. Where they lie, they show themselves: beyond a board seen steeply nothing else does.
    """
    seen, grid = search.placed, search.refused
    if grid is None or grid.refusal.placed is None or (seen and len(seen.points) >= grid.refusal.covered):
        return None
    nodes = grid.nodes.astype(np.float64)
    of_board = np.isin(np.arange(len(nodes)), grid.refusal.placed.rows)
    pixels = refine(image, nodes, grid.pixels, nodes, appearance, typical=of_board).pixels
    good = np.flatnonzero(np.isfinite(pixels[:, 0]))
    return Recognised(good, pixels[good])


def _within(
    image: Float32Array, grid: RefusedGrid, good: Recognised, board: BoardNodes, appearance: Appearance, another: int
) -> Recognised:
    """The board among the ``good`` points of a larger grid, after clutter beside it was rejected."""
    placed = board.place(grid.nodes[good.points])
    if isinstance(placed, GridRefusal):
        if placed.another:
            raise BoardNotFound(placed.reason)
        rest = RefusedGrid(grid.nodes[good.points], good.pixels, grid.signal, placed)
        raise BoardNotFound(why_refused(image, rest, board, appearance))
    if len(placed.beyond) >= another:
        raise BoardNotFound(goes_on(len(placed.beyond)))
    return Recognised(placed.points, good.pixels[placed.rows])


def _checked(
    image: Float32Array, seen: BoardPoints, board: BoardNodes, appearance: Appearance, another: int, known: _Known
) -> Recognised:
    """A board found, refined, unless its points show another one."""
    # Points beyond the board are refined too, which rejects clutter but not the points of another board.
    count, beside = len(seen.points), len(seen.beyond_nodes)
    beside = beside if beside >= another else 0
    nodes = np.concatenate([board.nodes[seen.points], seen.beyond_nodes[:beside]]).astype(np.float64)
    starts = np.concatenate([seen.pixels, seen.beyond_pixels[:beside]])
    refined = refine(
        image, nodes, starts, board.nodes.astype(np.float64), appearance, grid=np.arange(len(nodes)) < count
    )
    good = np.isfinite(refined.pixels[:, 0])
    alike = 0 if known.good_of_larger is None else len(known.good_of_larger.points)
    beyond = max(int(np.sum(good[count:])), alike - len(board.nodes))
    if beyond >= another:
        raise BoardNotFound(goes_on(beyond))
    kept = seen.points[good[:count]]
    wide = _of_another_width(refined, nodes, starts, appearance, tone_curve=known.tone_curve)
    if wide or len(kept) < _ALIKE * count:
        reason = why_unlike(image, refined.blur_px, nodes[:count], starts[:count])
        wider = f'the circles are {refined.width / max(appearance.width, TINY):.2f} times as wide as described'
        unlike = f'{len(kept)} of {count} points look as described: of other sizes, or another board'
        raise BoardNotFound(reason or (wider if wide else unlike))
    # Placed again, since rejected points may have been the only ones that determined the placement.
    placed = board.place(board.nodes[kept])
    if isinstance(placed, GridRefusal):
        rest = RefusedGrid(board.nodes[kept], refined.pixels[:count][good[:count]], np.inf, placed)
        raise BoardNotFound(why_refused(image, rest, board, appearance))
    return Recognised(kept, refined.pixels[:count][good[:count]])


def _of_another_width(
    refined: Refined, nodes: FloatArray, starts: FloatArray, appearance: Appearance, *, tone_curve: bool
) -> bool:
    """Whether the circles are clearly wider or narrower than described; corners have no width.

    A tone curve moves an edge within its blur: the grey value half way between two levels is any level between them.
    """
    spacing = median_spacing(nodes, starts)
    uncertain = 3.0 * refined.width_sigma + (refined.blur_px / spacing if tone_curve else 0.0)
    return appearance.width > 0.0 and bool(
        abs(refined.width - appearance.width) > _OF_ITS_WIDTH * appearance.width + uncertain
    )
