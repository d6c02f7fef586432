"""The shape of a calibration board: where its points are described, and where the views show them."""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.core.types import FloatArray


@dataclass(frozen=True)
class BoardShape:
    """Points of a board.

    Parameters
    ----------
    described : (P, 3) as described [m]
    places : (P, 3) as found [m]
    """

    described: FloatArray
    places: FloatArray

    @property
    def rms_m(self) -> float:
        """Distance of the points from where they are described, root mean square."""
        return float(np.sqrt(np.mean(np.sum((self.places - self.described) ** 2, axis=1))))

    @property
    def largest_m(self) -> float:
        """Largest distance of a point from where it is described."""
        return float(np.linalg.norm(self.places - self.described, axis=1).max())

    def found(self, point: FloatArray) -> FloatArray:
        """Where a point (3,) as described was found [m]; as described if no view shows it."""
        there = np.flatnonzero(np.all(self.described == point, axis=1))
        return np.asarray(self.places[there[0]] if len(there) else point)

    def sentence(self) -> str:
        """How far off the points are, in words."""
        if self.largest_m == 0.0:
            return 'the points of the board are taken for exact'
        off = f'{1e3 * self.rms_m:.2g} mm (rms) from where it is described, {1e3 * self.largest_m:.2g} mm at most'
        return f'the points of the board are {off}'

    def seen_from_the_front(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Described points (P, 2) in the plane that fits them best, how far off they are in it (P, 2), and across (P,).

        All in metres, from the side to which the largest coordinate of the plane's normal points.
        """
        _, _, axes = np.linalg.svd(self.described - self.described.mean(axis=0), full_matrices=False)
        normal = axes[2] * np.sign(axes[2][np.argmax(np.abs(axes[2]))])
        # The first axis of the drawing is the axis of the board that is nearest to the plane.
        across = np.eye(3)[np.argmin(np.abs(normal[:2]))]
        across = across - normal * (normal @ across)
        across /= np.linalg.norm(across)
        plane = np.stack([across, np.cross(normal, across)])
        off = self.places - self.described
        return self.described @ plane.T, off @ plane.T, off @ normal
