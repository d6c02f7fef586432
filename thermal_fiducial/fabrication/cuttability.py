"""Which markers can be cut from one sheet in one piece.

A black cell is acrylic, a white one a hole. A piece of acrylic that is not joined to the border by an edge of a
cell falls out; where two holes touch at a point, so does the acrylic, which breaks there.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.core.types import BoolArray, Gray, IntArray


@dataclass(frozen=True)
class Cuttability:
    """Properties of a marker that decide whether it can be cut.

    Parameters
    ----------
    islands : pieces of acrylic that no edge joins to the border
    point_contacts : corners of cells where two holes touch, so that the acrylic between them has no width
    longest_arm : largest distance of an acrylic cell from the border, through acrylic [cells]
    """

    islands: int
    point_contacts: int
    longest_arm: int

    @property
    def cuttable(self) -> bool:
        """Whether the marker is one piece of acrylic, so that it needs no bridges."""
        return self.islands == 0 and self.point_contacts == 0


def acrylic_cells(bits: Gray) -> BoolArray:
    """Acrylic cells (n + 2, n + 2) of a marker with bits (n, n): the border of one cell and the black bits."""
    return np.pad(np.asarray(bits) == 0, 1, constant_values=True)


def pieces(acrylic: BoolArray) -> tuple[int, IntArray]:
    """Number of pieces joined by edges, and the label of each cell: 0 hole, 1 the piece with the border, 2 ..."""
    count, labels = cv2.connectedComponents(acrylic.astype(np.uint8), connectivity=4)
    return count - 1, np.asarray(labels, dtype=np.int64)


def point_contacts(acrylic: BoolArray) -> BoolArray:
    """Whether holes touch at each inner corner of the cells; one row and column fewer than ``acrylic``."""
    a, b, c, d = acrylic[:-1, :-1], acrylic[:-1, 1:], acrylic[1:, :-1], acrylic[1:, 1:]
    return np.asarray((a == d) & (b == c) & (a != b))


def examine(bits: Gray) -> Cuttability:
    """Cuttability of the marker with ``bits`` (n, n), 1 for white."""
    acrylic = acrylic_cells(bits)
    count, _ = pieces(acrylic)
    return Cuttability(count - 1, int(np.sum(point_contacts(acrylic))), _longest_arm(acrylic))


def _longest_arm(acrylic: BoolArray) -> int:
    reached = np.zeros_like(acrylic)
    reached[[0, -1]] = reached[:, [0, -1]] = True
    steps = 0
    while True:
        grown = reached.copy()
        grown[1:] |= reached[:-1]
        grown[:-1] |= reached[1:]
        grown[:, 1:] |= reached[:, :-1]
        grown[:, :-1] |= reached[:, 1:]
        grown &= acrylic
        if np.array_equal(grown, reached):
            return steps
        reached, steps = grown, steps + 1
