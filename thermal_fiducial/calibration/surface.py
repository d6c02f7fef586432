"""Where the points of a grid should be, from those around them."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import FloatArray

# How far the points that predict another one lie away from it, in steps of the grid.
REACH = 3
#: How firmly curvature is held down where points are known to a pixel and lie on one side only; and where they are
#: known so well that perspective and lens show: held down then, it would cost 0.02 % of the focal length.
ROUGHLY, CLOSELY = 0.03, 0.00001


@dataclass(frozen=True)
class Surface:
    """A grid around one of its nodes: pixel = centre + steps n + bend t(n), t its second and third powers.

    Parameters
    ----------
    centre : (2,) pixel of the node
    steps : (2, 2) to the next nodes along the two axes, by columns [px]
    bend : (2, 7) [px]
    """

    centre: FloatArray
    steps: FloatArray
    bend: FloatArray

    def place(self, offset: FloatArray) -> FloatArray:
        """Places (N, 2) in the grid, relative to the node, of offsets (N, 2) in the image [px]."""
        inverse = np.linalg.inv(self.steps)
        place = offset @ inverse.T
        for _ in range(2):
            bent = _bends(place) @ self.bend.T
            place = (offset - bent) @ inverse.T
        return np.asarray(place)


def _bends(place: FloatArray) -> FloatArray:
    """Terms (N, 7) of second and third order."""
    a, b = place.T
    return np.column_stack([a * a, a * b, b * b, a**3, a * a * b, a * b * b, b**3])


def local_surface(nodes: FloatArray, pixels: FloatArray, node: FloatArray, ridge: float = ROUGHLY) -> Surface | None:
    """Surface around ``node`` through points (N, 2) near it, the nearer the closer; None where they don't say.

    Parameters
    ----------
    nodes, pixels : (N, 2) of the grid; those farther than :data:`REACH` do not count
    ridge : :data:`ROUGHLY` or :data:`CLOSELY`
    """
    away = nodes - node
    near = np.max(np.abs(away), axis=1) <= REACH
    a, b = away[near].T
    weight = 1.0 / (1.0 + a * a + b * b) ** 2
    design = np.column_stack([np.ones_like(a), a, b, _bends(away[near])]) * weight[:, None]
    normal = design.T @ design
    if len(a) < 3 or np.linalg.det(normal[:3, :3]) < 1e-4 * normal[0, 0] ** 3:
        return None
    normal[range(3, 10), range(3, 10)] += ridge * weight.max() ** 2
    surface = np.linalg.solve(normal, design.T @ (pixels[near] * weight[:, None]))
    steps = surface[1:3].T
    if abs(np.linalg.det(steps)) < 1.0:
        return None
    return Surface(surface[0], steps, surface[3:].T)
