"""Image models of board points, in units of the grid spacing (steps)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, Self

import numpy as np
from scipy.special import ndtr

from thermal_fiducial.core.types import FloatArray, IntArray

# Smallest half width of a window [px].
_LEAST_REACH = 2.7
# Margin of background around a disc in its window [px].
_GROUND = 4.0
_MOST_INSET = 0.3
# Bounds of a disc's radius [steps]; at half a step discs touch.
_RADIUS_BOUNDS = (0.05, 0.5)
# Extent of a blurred edge in standard deviations: for the size of a window, and where it has vanished.
_TAIL, _NOTHING_LEFT = 3.0, 5.0
# Placeholder position of missing neighbours, out of reach [steps].
_NOWHERE = 1e3


class Appearance(Protocol):
    """A pattern around each of P points, between two levels."""

    @property
    def bent(self) -> bool:
        """Whether perspective within a window is modelled; discs are treated as ellipses, as in the least squares."""

    @property
    def width(self) -> float:
        """Initial inset of squares, or radius of a disc [steps]."""

    @property
    def least_visible(self) -> float:
        """Share of its window that must lie in the image."""

    def at(self, nodes: FloatArray, board: FloatArray) -> Self:
        """The model at ``nodes`` (P, 2) among the nodes (N, 2) of a board."""

    def rows(self, index: IntArray) -> Self:
        """The model at a subset of the points."""

    def of_width(self, width: float) -> Self:
        """The model for a measured ``width``, by which windows are chosen."""

    def reach(self, spacing: FloatArray, blur: FloatArray | None) -> FloatArray:
        """Half widths (P,) [steps] of windows for a point ``spacing`` (P,) [px]; blur (P,) [px] if known."""

    def shape(
        self, places: FloatArray, blur: FloatArray, width: FloatArray, free: int
    ) -> tuple[FloatArray, FloatArray]:
        """Pattern (P, N) at places (P, N, 2) relative to the points, and its derivatives (free, P, N).

        If only the place is free, without the contribution of :meth:`beside`.

        Parameters
        ----------
        blur : (P, 2) along the axes [steps]
        width : (P,)
        free : number of derivatives, in the order place (2), logarithm of the blur, width
        """

    def beside(self, places: FloatArray, blur: FloatArray, width: FloatArray) -> FloatArray:
        """Contribution of the neighbours to :meth:`shape` (P, N), with neighbours fixed at their grid positions."""


@dataclass(frozen=True)
class SquaresMeet:
    """Corner of a chessboard whose squares of one colour may be inset.

    Paint bleeds, foil is cut short, and heat spreads: the squares of one colour shrink from the grid lines, and
    those of the other colour join at the corners.

    Parameters
    ----------
    parity : (P,) sign, -1 where the colours are swapped
    """

    parity: FloatArray = field(default_factory=lambda: np.ones(1))
    bent = True
    width = 0.0
    least_visible = 0.5

    def at(self, nodes: FloatArray, board: FloatArray) -> 'SquaresMeet':
        """See :class:`Appearance`."""
        return SquaresMeet(1.0 - 2.0 * (nodes.sum(axis=1) % 2))

    def rows(self, index: IntArray) -> 'SquaresMeet':
        """See :class:`Appearance`."""
        return SquaresMeet(self.parity[index])

    def of_width(self, width: float) -> 'SquaresMeet':
        """See :class:`Appearance`; the window of a corner does not depend on the inset."""
        return self

    def reach(self, spacing: FloatArray, blur: FloatArray | None) -> FloatArray:
        """See :class:`Appearance`."""
        return np.maximum(0.45, _LEAST_REACH / spacing)

    def shape(
        self, places: FloatArray, blur: FloatArray, width: FloatArray, free: int
    ) -> tuple[FloatArray, FloatArray]:
        """See :class:`Appearance`; a negative ``width`` insets the squares of the other colour."""
        sign = np.where(width >= 0.0, 1.0, -1.0)
        inset = np.minimum(np.abs(width), _MOST_INSET)
        turned = sign * self.parity
        along = _bands(places[..., 0], inset, blur[:, 0], free)
        across = _bands(places[..., 1] * turned[:, None], inset, blur[:, 1], free)
        scale = (2.0 * sign)[:, None]
        values = scale * (along[0] * across[0]).sum(axis=0) - sign[:, None]
        # Derivatives by the place, per axis; then by blur and width, which are common to both axes.
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
    """A disc of a common radius.

    Parameters
    ----------
    width : radius [steps]
    others : (P, K, 2) positions of its neighbours relative to it [steps], whose blur reaches into the window
    """

    width: float
    others: FloatArray = field(default_factory=lambda: np.zeros((1, 0, 2)))
    bent = False
    #: nearly the whole disc, since a part of it does not determine its centre
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

    def of_width(self, width: float) -> 'Disc':
        """See :class:`Appearance`."""
        return Disc(float(np.clip(width, *_RADIUS_BOUNDS)), self.others)

    def reach(self, spacing: FloatArray, blur: FloatArray | None) -> FloatArray:
        """See :class:`Appearance`; excludes the next disc except its blur."""
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
        """Add the contribution of the neighbours to the values and derivatives."""
        visible = width + _NOTHING_LEFT * blur.max(axis=1)
        # Neighbours are at least a step away and do not contribute near the centre.
        from_middle = np.hypot(places[..., 0], places[..., 1])
        point, pixel = np.nonzero(from_middle > (1.0 - visible)[:, None])
        away = places[point, pixel][:, None] - self.others[point]
        row, neighbour = np.nonzero(np.hypot(away[..., 0], away[..., 1]) < visible[point][:, None])
        point, pixel = point[row], pixel[row]
        more, more_slopes = _disc(away[row, neighbour], blur[point], width[point], len(totals) - 1)
        for total, part in zip(totals, (more, *more_slopes), strict=True):
            total += np.bincount(point * total.shape[1] + pixel, part, total.size).reshape(total.shape)


def _disc(places: FloatArray, blur: FloatArray, width: FloatArray, free: int) -> tuple[FloatArray, FloatArray]:
    """Disc (...) at places (..., 2) relative to its centre, and its derivatives as in :class:`Appearance`.

    An edge of radius of curvature r, blurred by s along it, moves inwards by s^2 / 2 r: a disc of 1.6 blurs keeps 0.72
    of its contrast, with straight edges it would keep 0.94. ``hypot(distance, s)`` for the distance from the centre
    has that shift, and differs from the true profile (Marcum's Q) by 0.02 there.

    Parameters
    ----------
    blur : (..., 2)
    width : (...) radius
    """
    x, y = places[..., 0], places[..., 1]
    xx, yy, x_blur, y_blur = x * x, y * y, blur[..., 0] ** 2, blur[..., 1] ** 2
    square = xx + yy + 1e-18
    # Variances of the blur across the edge and along it.
    across, along = (xx * x_blur + yy * y_blur) / square + 1e-18, (yy * x_blur + xx * y_blur) / square
    distance = np.sqrt(square + along)
    by_radius = 1.0 / np.sqrt(across)
    inside = (width - distance) * by_radius
    density = _density(inside)
    slopes = np.empty((free, *x.shape))
    if free > 0:
        outwards, turning = density * by_radius / distance, density * inside / (across * square)
        slopes[0] = -x * (outwards * (1.0 + (y_blur - along) / square) + turning * (x_blur - across))
        slopes[1] = -y * (outwards * (1.0 + (x_blur - along) / square) + turning * (y_blur - across))
    if free > 2:
        slopes[2] = -density * (inside + along / distance * by_radius)
    if free > 3:
        slopes[3] = density * by_radius
    return np.asarray(ndtr(inside)), slopes
