"""Prediction of grid points from their neighbours."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray

# Largest distance of the points that predict another one, in steps of the grid.
REACH = 3
#: Ridge on the curvature: for points known to a pixel and on one side only; and for points accurate enough to show
#: perspective and lens, where a strong ridge would bias the focal length by 0.02 %.
ROUGHLY, CLOSELY = 0.03, 0.00001


@dataclass(frozen=True)
class Surfaces:
    """Local maps of a grid to pixels at P places: pixel = centre + steps n + bends t(n), t the terms of order 2 and 3.

    Parameters
    ----------
    determined : (P,) whether the points around a place determine its surface
    centres : (P, 2) pixel of each place
    steps : (P, 2, 2) to the next nodes along the two axes, by columns [px]
    bends : (P, 2, 7) [px]
    """

    determined: BoolArray
    centres: FloatArray
    steps: FloatArray
    bends: FloatArray

    def rows(self, index: IntArray) -> 'Surfaces':
        """Some of them."""
        return Surfaces(self.determined[index], self.centres[index], self.steps[index], self.bends[index])

    def places(self, offsets: FloatArray) -> FloatArray:
        """Places (P, N, 2) in the grid, relative to each place, of offsets (P, N, 2) in the image [px]."""
        inverse = np.linalg.inv(self.steps).swapaxes(-1, -2)
        bends = self.bends.swapaxes(-1, -2)
        places = offsets @ inverse
        for _ in range(2):
            places = (offsets - _terms(places)[..., 3:] @ bends) @ inverse
        return np.asarray(places)


def _terms(away: FloatArray) -> FloatArray:
    """Monomials (..., 10) of orders zero to three at places (..., 2)."""
    a, b = away[..., 0], away[..., 1]
    aa, bb = a * a, b * b
    terms = np.empty((*a.shape, 10))
    for column, term in enumerate((1.0, a, b, aa, a * b, bb, aa * a, aa * b, a * bb, bb * b)):
        terms[..., column] = term
    return terms


def local_surfaces(nodes: FloatArray, pixels: FloatArray, places: FloatArray, ridge: float = ROUGHLY) -> Surfaces:
    """Surfaces around ``places`` (P, 2), fitted to the points near them with weights that fall with distance.

    Parameters
    ----------
    nodes, pixels : (N, 2) of the grid; a place uses those within :data:`REACH`
    ridge : :data:`ROUGHLY` or :data:`CLOSELY`
    """
    away = nodes - places[:, None]
    along, across = away[..., 0], away[..., 1]
    near = np.maximum(np.abs(along), np.abs(across)) <= REACH
    weight = near / (1.0 + along * along + across * across) ** 2
    weighted = _terms(away) * weight[..., None]
    transposed = weighted.swapaxes(-1, -2)
    normal = transposed @ weighted
    plane = np.linalg.det(normal[:, :3, :3])
    determined = (near.sum(axis=1) >= 3) & (plane >= 1e-4 * normal[:, 0, 0] ** 3)
    curved = np.arange(3, 10)
    normal[:, curved, curved] += ridge * weight.max(axis=1, initial=0.0)[:, None] ** 2
    normal[~determined] = np.eye(10)
    solution = np.linalg.solve(normal, transposed @ (pixels * weight[..., None]))
    surface: FloatArray = np.asarray(solution.swapaxes(-1, -2), dtype=np.float64)
    steps = surface[..., 1:3]
    determined &= np.abs(np.linalg.det(steps)) >= 1.0
    return Surfaces(determined, surface[..., 0], steps, surface[..., 3:])
