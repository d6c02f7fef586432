"""A pinhole with Brown's distortion, by the formula in OpenCV's documents (``calib3d``)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

#: Rays are converged when the distorted point is off by less than this: a ten-thousandth of a pixel.
_CONVERGED = 1e-7
_ITERATIONS = 200
#: Slope of the distorted radius over the true one that any part of the image keeps; at 0 a lens folds back.
_SLOPE = 0.4


@dataclass(frozen=True, eq=False)
class Lens:
    """Intrinsics of a camera.

    Parameters
    ----------
    width, height : image size [px]
    focal, centre : (2,) along x and y [px]
    distortion : (4,) k1, k2, p1, p2
    """

    width: int
    height: int
    focal: np.ndarray
    centre: np.ndarray
    distortion: np.ndarray

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3)."""
        return np.array([[self.focal[0], 0.0, self.centre[0]], [0.0, self.focal[1], self.centre[1]], [0.0, 0.0, 1.0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) before the camera."""
        return self._distorted(points[..., :2] / points[..., 2:]) * self.focal + self.centre

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Points (..., 2) at depth 1 that are seen at pixels (..., 2).

        Raises
        ------
        ValueError
            The lens folds there.
        """
        goal = (pixels - self.centre) / self.focal
        xy = goal
        for _ in range(_ITERATIONS):
            step = (goal - self._distorted(xy)) / self._radial(xy)
            if np.abs(step).max() < _CONVERGED:
                return xy
            xy = xy + step
        raise ValueError('the lens folds inside the image')

    def pixels(self, per_side: int = 1) -> np.ndarray:
        """Positions (per_side height, per_side width, 2) of ``per_side`` times ``per_side`` points in each pixel."""
        u, v = ((np.arange(per_side * size) + 0.5) / per_side - 0.5 for size in (self.width, self.height))
        return np.stack(np.meshgrid(u, v), axis=-1)

    @property
    def folds(self) -> bool:
        """Whether it folds back, or nearly so, in a corner of the image."""
        corners = self.pixels()[:: self.height - 1, :: self.width - 1]
        farthest = np.linalg.norm((corners - self.centre) / self.focal, axis=-1).max()
        k1, k2 = self.distortion[:2]
        r = np.linspace(0.0, 3.0, 3001)
        bent = 1.0 + 3.0 * k1 * r**2 + 5.0 * k2 * r**4 < _SLOPE
        first = r[np.argmax(bent)]
        return bool(bent.any() and first * (1.0 + k1 * first**2 + k2 * first**4) < farthest)

    @cached_property
    def _reach(self) -> float:
        """Radius at depth 1 that the image ends at: points far beyond may be folded back into it."""
        return float(np.linalg.norm(self.rays(self.pixels()[:: self.height - 1, :: self.width - 1]), axis=-1).max())

    def sees(self, points: np.ndarray) -> bool:
        """Whether all of the points (N, 3) are in the image."""
        if points[:, 2].min() <= 0.0 or np.linalg.norm(points[:, :2] / points[:, 2:], axis=1).max() > self._reach:
            return False
        return bool(np.all((self.project(points) >= 0.0) & (self.project(points) <= [self.width - 1, self.height - 1])))

    def _radial(self, xy: np.ndarray) -> np.ndarray:
        """(..., 1)."""
        k1, k2 = self.distortion[:2]
        r2 = np.sum(xy**2, axis=-1, keepdims=True)
        return 1.0 + k1 * r2 + k2 * r2**2

    def _distorted(self, xy: np.ndarray) -> np.ndarray:
        p1, p2 = self.distortion[2:]
        r2 = np.sum(xy**2, axis=-1, keepdims=True)
        tangential = 2.0 * xy * (xy @ [p2, p1])[..., None] + r2 * [p2, p1]
        return xy * self._radial(xy) + tangential
