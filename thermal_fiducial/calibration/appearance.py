"""What boards look like around one of their points, in steps of their grid."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.special import ndtr

from thermal_fiducial.core.types import FloatArray

# Least reach of a window [px].
_LEAST_REACH = 2.7
# Ground beside a disc that its window shows [px].
_GROUND = 4.0
_MOST_INSET = 0.3
# A blurred edge is over after so many standard deviations.
_TAIL = 3.0


class Appearance(Protocol):
    """A pattern around a point, between two levels."""

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
    def least_seen(self) -> float:
        """Share of its window that must lie in the image."""

    def at(self, node: FloatArray, board: FloatArray) -> 'Appearance':
        """What it looks like at ``node`` (2,) among the nodes (N, 2) of a board."""

    def reach(self, spacing: float, blur: float | None) -> float:
        """How far [steps] a window reaches where points are ``spacing`` [px] apart; blur [px] where it is known."""

    def shape(self, place: FloatArray, blur: FloatArray, width: float) -> FloatArray:
        """Pattern (N,) at places (N, 2) relative to the point, blurred by ``blur`` (2,) along the axes [steps]."""


@dataclass(frozen=True)
class SquaresMeet:
    """Corner of a chessboard, whose squares of one colour may be smaller than those of the other.

    Paint bleeds, foil is cut short, and heat spreads: where squares of one colour draw back from the lines of the
    grid, those of the other touch along more than a point.

    Parameters
    ----------
    parity : -1 where the squares are the other way round
    """

    parity: float = 1.0
    bent = True
    width = 0.0
    width_free = True
    least_seen = 0.5

    def at(self, node: FloatArray, board: FloatArray) -> 'SquaresMeet':
        """See :class:`Appearance`."""
        return SquaresMeet(1.0 - 2.0 * float(np.sum(node) % 2))

    def reach(self, spacing: float, blur: float | None) -> float:
        """See :class:`Appearance`."""
        return max(0.45, _LEAST_REACH / spacing)

    def shape(self, place: FloatArray, blur: FloatArray, width: float) -> FloatArray:
        """See :class:`Appearance`; where ``width`` is negative, the squares of the other colour draw back."""
        sign = 1.0 if width >= 0.0 else -1.0
        inset = min(abs(width), _MOST_INSET)
        x, y = place[:, 0] / blur[0], sign * self.parity * place[:, 1] / blur[1]
        (near_x, near_y), (far_x, far_y) = inset / blur, (1.0 - inset) / blur
        ahead = (ndtr(x - near_x) - ndtr(x - far_x)) * (ndtr(y - near_y) - ndtr(y - far_y))
        behind = (ndtr(-x - near_x) - ndtr(-x - far_x)) * (ndtr(-y - near_y) - ndtr(-y - far_y))
        return np.asarray(sign * (2.0 * (ahead + behind) - 1.0))


@dataclass(frozen=True)
class Disc:
    """A disc of a known radius.

    Parameters
    ----------
    width : radius [steps]
    others : (K, 2) where its neighbours are, relative to it [steps]: blurred they reach into its window
    """

    width: float
    others: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    bent = False
    width_free = False
    #: the whole disc: a part of it does not show its middle
    least_seen = 0.9

    def at(self, node: FloatArray, board: FloatArray) -> 'Disc':
        """See :class:`Appearance`."""
        away = board - node
        near = np.max(np.abs(away), axis=1) == 1.0
        return Disc(self.width, away[near])

    def reach(self, spacing: float, blur: float | None) -> float:
        """See :class:`Appearance`; the next disc stays outside, but for its blur."""
        most = 1.0 - self.width - 1.0 / spacing
        enough = 2.0 * self.width + 1.0 / spacing if blur is None else self.width + max(_GROUND, _TAIL * blur) / spacing
        return max(min(enough, most), _LEAST_REACH / spacing)

    def shape(self, place: FloatArray, blur: FloatArray, width: float) -> FloatArray:
        """See :class:`Appearance`."""
        # Farther than this, nothing of a neighbour is seen.
        seen = np.abs(place).max() + width + _TAIL * float(blur.max())
        near = self.others[np.hypot(self.others[:, 0], self.others[:, 1]) < seen]
        # A row a disc: sums run over long rows then, many times faster than over short ones.
        x = np.concatenate([place[None, :, 0], place[:, 0] - near[:, :1]])
        y = np.concatenate([place[None, :, 1], place[:, 1] - near[:, 1:]])
        radius = np.sqrt(x * x + y * y) + 1e-9
        across = radius / np.maximum(np.sqrt((x / blur[0]) ** 2 + (y / blur[1]) ** 2), 1e-9)
        return np.asarray(ndtr((width - radius) / across).sum(axis=0))
