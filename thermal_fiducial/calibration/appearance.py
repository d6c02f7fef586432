"""What boards look like around their points, in steps of their grid."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from scipy.special import ndtr

from thermal_fiducial.core.types import FloatArray, IntArray

# Least reach of a window [px].
_LEAST_REACH = 2.7
# Ground beside a disc that its window shows [px].
_GROUND = 4.0
_MOST_INSET = 0.3
# A blurred edge is over after so many standard deviations, for a window's size, and as good as nothing is left of it.
_TAIL, _NOTHING_LEFT = 3.0, 5.0
# Where a disc has fewer neighbours than another: none is seen from so far [steps].
_NOWHERE = 1e3


class Appearance(Protocol):
    """A pattern around each of P points, between two levels."""

    @property
    def bent(self) -> bool:
        """Whether perspective bends it within a window; discs are taken for ellipses, as the least squares do."""

    @property
    def width(self) -> float:
        """How far squares draw back, or radius of a disc, to start from [steps of the grid]."""

    @property
    def width_free(self) -> bool:
        """Whether ``width`` is to be found."""

    @property
    def least_visible(self) -> float:
        """Share of its window that must lie in the image."""

    def at(self, nodes: FloatArray, board: FloatArray) -> Self:
        """What it looks like at ``nodes`` (P, 2) among the nodes (N, 2) of a board."""

    def rows(self, index: IntArray) -> Self:
        """What it looks like at some of the points."""

    def reach(self, spacing: FloatArray, blur: FloatArray | None) -> FloatArray:
        """How far (P,) [steps] windows reach where points are ``spacing`` (P,) [px] apart; blur (P,) [px] if known."""

    def shape(
        self, places: FloatArray, blur: FloatArray, width: FloatArray, free: int
    ) -> tuple[FloatArray, FloatArray]:
        """Pattern (P, N) at places (P, N, 2) relative to the points, and its derivatives (free, P, N).

        Where the place alone is free, without what is :meth:`beside` the point.

        Parameters
        ----------
        blur : (P, 2) along the axes [steps]
        width : (P,)
        free : derivatives are by the place (2), the logarithm of the blur and the width: the first so many of them
        """

    def beside(self, places: FloatArray, blur: FloatArray, width: FloatArray) -> FloatArray:
        """What neighbours of the points add to :meth:`shape` (P, N) when they stay where the grid has them."""


@dataclass(frozen=True)
class SquaresMeet:
    """Corner of a chessboard, whose squares of one colour may be smaller than those of the other.

    Paint bleeds, foil is cut short, and heat spreads: where squares of one colour draw back from the lines of the
    grid, those of the other touch along more than a point.

    Parameters
    ----------
    parity : (P,) -1 where the squares are the other way round
    """

    parity: FloatArray = field(default_factory=lambda: np.ones(1))
    bent = True
    width = 0.0
    width_free = True
    least_visible = 0.5

    def at(self, nodes: FloatArray, board: FloatArray) -> 'SquaresMeet':
        """See :class:`Appearance`."""
        return SquaresMeet(1.0 - 2.0 * (nodes.sum(axis=1) % 2))

    def rows(self, index: IntArray) -> 'SquaresMeet':
        """See :class:`Appearance`."""
        return SquaresMeet(self.parity[index])

    def reach(self, spacing: FloatArray, blur: FloatArray | None) -> FloatArray:
        """See :class:`Appearance`."""
        return np.maximum(0.45, _LEAST_REACH / spacing)

    def shape(
        self, places: FloatArray, blur: FloatArray, width: FloatArray, free: int
    ) -> tuple[FloatArray, FloatArray]:
        """See :class:`Appearance`; where ``width`` is negative, the squares of the other colour draw back."""
        sign = np.where(width >= 0.0, 1.0, -1.0)
        inset = np.minimum(np.abs(width), _MOST_INSET)
        turned = sign * self.parity
        along = _bands(places[..., 0], inset, blur[:, 0], free)
        across = _bands(places[..., 1] * turned[:, None], inset, blur[:, 1], free)
        scale = (2.0 * sign)[:, None]
        values = scale * (along[0] * across[0]).sum(axis=0) - sign[:, None]
        # By place, each along its own axis; by blur and width, which both axes have in common.
        slopes = [scale * (along[1] * across[0]).sum(axis=0)]
        slopes.append((scale * turned[:, None]) * (along[0] * across[1]).sum(axis=0))
        for number in range(2, free):
            slopes.append(scale * (along[number] * across[0] + along[0] * across[number]).sum(axis=0))
        if free > 3:
            slopes[3] *= (sign * (np.abs(width) < _MOST_INSET))[:, None]
        return values, np.stack(slopes)

    def beside(self, places: FloatArray, blur: FloatArray, width: FloatArray) -> FloatArray:
        """See :class:`Appearance`; the squares around are part of the shape."""
        return np.zeros(places.shape[:2])


def _bands(places: FloatArray, inset: FloatArray, blur: FloatArray, free: int) -> FloatArray:
    """Blurred bands ahead of a line and behind it, at ``places`` (P, N) beside it [steps]: (4, 2, P, N).

    The bands, then their derivatives by the place, the logarithm of the blur and the inset, the last two where
    ``free`` is more than 2.
    """
    value, by_place, by_log_blur, by_inset = bands = np.zeros((4, 2, *places.shape))
    to_far = (1.0 - inset - np.abs(places).max(axis=1)) / blur
    for side, sign in enumerate((1.0, -1.0)):
        for end, line in ((1.0, inset), (-1.0, 1.0 - inset)):
            if end < 0.0 and to_far.min() > _NOTHING_LEFT:
                continue
            beyond = (sign * places - line[:, None]) / blur[:, None]
            value[side] += end * ndtr(beyond)
            density = _density(beyond)
            by_place[side] += density * (end * sign / blur)[:, None]
            if free > 2:
                by_log_blur[side] -= end * beyond * density
                by_inset[side] -= density / blur[:, None]
    return bands


def _density(x: FloatArray) -> FloatArray:
    """Density of the standard normal distribution."""
    return np.asarray(np.exp(-0.5 * x * x) * (1.0 / np.sqrt(2.0 * np.pi)))


@dataclass(frozen=True)
class Disc:
    """A disc of a known radius.

    Parameters
    ----------
    width : radius [steps]
    others : (P, K, 2) where its neighbours are, relative to it [steps]: blurred they reach into its window
    """

    width: float
    others: FloatArray = field(default_factory=lambda: np.zeros((1, 0, 2)))
    bent = False
    width_free = False
    #: the whole disc: a part of it does not show its middle
    least_visible = 0.9

    def at(self, nodes: FloatArray, board: FloatArray) -> 'Disc':
        """See :class:`Appearance`; the nearest neighbours come first."""
        away = board - nodes[:, None]
        distance = np.where(np.abs(away).max(axis=-1) == 1.0, np.hypot(away[..., 0], away[..., 1]), _NOWHERE)
        order = np.argsort(distance, axis=1, kind='stable')[:, :8]
        near = np.take_along_axis(distance, order, 1)[..., None] < _NOWHERE
        return Disc(self.width, np.where(near, np.take_along_axis(away, order[..., None], 1), _NOWHERE))

    def rows(self, index: IntArray) -> 'Disc':
        """See :class:`Appearance`."""
        return Disc(self.width, self.others[index])

    def reach(self, spacing: FloatArray, blur: FloatArray | None) -> FloatArray:
        """See :class:`Appearance`; the next disc stays outside, but for its blur."""
        most = 1.0 - self.width - 1.0 / spacing
        if blur is None:
            enough = 2.0 * self.width + 1.0 / spacing
        else:
            enough = self.width + np.maximum(_GROUND, _TAIL * blur) / spacing
        return np.maximum(np.minimum(enough, most), _LEAST_REACH / spacing)

    def shape(
        self, places: FloatArray, blur: FloatArray, width: FloatArray, free: int
    ) -> tuple[FloatArray, FloatArray]:
        """See :class:`Appearance`."""
        values, slopes = _disc(places, blur[:, None], width[:, None], free)
        if free > 2:
            self._add_neighbours((values, *slopes), places, blur, width)
        return values, slopes

    def beside(self, places: FloatArray, blur: FloatArray, width: FloatArray) -> FloatArray:
        """See :class:`Appearance`."""
        values = np.zeros(places.shape[:2])
        self._add_neighbours((values,), places, blur, width)
        return values

    def _add_neighbours(
        self, totals: Sequence[FloatArray], places: FloatArray, blur: FloatArray, width: FloatArray
    ) -> None:
        """Add what the neighbours show to the values, and to as many derivatives as there are."""
        visible = width + _NOTHING_LEFT * blur.max(axis=1)
        # Neighbours are a step away or more: pixels near the middle see nothing of them.
        from_middle = np.hypot(places[..., 0], places[..., 1])
        point, pixel = np.nonzero(from_middle > (1.0 - visible)[:, None])
        away = places[point, pixel][:, None] - self.others[point]
        row, neighbour = np.nonzero(np.hypot(away[..., 0], away[..., 1]) < visible[point][:, None])
        point, pixel = point[row], pixel[row]
        more, more_slopes = _disc(away[row, neighbour], blur[point], width[point], len(totals) - 1)
        for total, part in zip(totals, (more, *more_slopes), strict=True):
            total += np.bincount(point * total.shape[1] + pixel, part, total.size).reshape(total.shape)


def _disc(places: FloatArray, blur: FloatArray, width: FloatArray, free: int) -> tuple[FloatArray, FloatArray]:
    """Disc (...) at places (..., 2) relative to its middle, and its derivatives as of :class:`Appearance`.

    Parameters
    ----------
    blur : (..., 2)
    width : (...) radius
    """
    x, y = places[..., 0], places[..., 1]
    x_blur, y_blur = x / blur[..., 0] ** 2, y / blur[..., 1] ** 2
    radius = np.sqrt(x * x + y * y) + 1e-9
    # Distance from the middle in blurs of the direction, and distance from the edge in the same.
    steps = np.sqrt(x * x_blur + y * y_blur) + 1e-9
    outwards = width / radius - 1.0
    inside = outwards * steps
    density = _density(inside)
    by_blur, by_radius = outwards / steps * density, width * steps / radius**3 * density
    slopes = np.empty((free, *x.shape))
    if free > 0:
        slopes[0] = x_blur * by_blur - x * by_radius
        slopes[1] = y_blur * by_blur - y * by_radius
    if free > 2:
        slopes[2] = -inside * density
    return np.asarray(ndtr(inside)), slopes
