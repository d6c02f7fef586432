"""What the errors of an adjusted map come from, as joint draws: noise, the markers' shapes, and the lens.

Two markers that are seen in the same frames have nearly the same error, which a covariance of each does not say. Draws
of all markers together do: the error of a pose by several markers is its derivative times theirs, draw by draw.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.error_model import (
    arms_of_scale,
    covariance_by_draws,
    covariance_root,
    DRAWS,
    scale_of_map,
    shape_of_corners,
    SystematicErrors,
)
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.mapping.adjustment_problem import Linearised, MapProblem
from thermal_fiducial.core.mapping.normal_equations import BorderedSystem, Vectors
from thermal_fiducial.core.types import FloatArray

#: Draws that are propagated at a time, which bounds the memory.
_AT_ONCE = 32
_SOME_DRAWS = [slice(first, first + _AT_ONCE) for first in range(0, DRAWS, _AT_ONCE)]
#: Right sides of the normal equations for some of the draws.
DrawnSides = Callable[[slice], Vectors]


class MapErrors(NamedTuple):
    """Errors of M adjusted markers, and of the lens."""

    #: (M, 6, 6), and (M, 6, K) joint draws of all but the scale's
    covariances: FloatArray
    draws: FloatArray
    #: (K,) draws of what is left of the aspect ratio's error, as a share of the declared one
    aspect_left: FloatArray


@dataclass(frozen=True)
class ErrorSources:
    """Errors of the M markers of an adjustment by those of what it was made from."""

    problem: MapProblem
    system: BorderedSystem
    now: Linearised
    #: (n,) robust weights of the views
    weights: FloatArray
    rng: np.random.Generator

    def of_markers(self, widened: float, errors: SystematicErrors, known: FloatArray) -> MapErrors:
        """Errors of the markers, and what is left of the aspect ratio's.

        Parameters
        ----------
        widened : factor of all variances; covariances of priors come divided by it
        known : (M, 6, K) draws of the held markers; others are not used
        """
        system, problem, positions = self.system, self.problem, self.now.state.T_map_marker[:, :3, 3]
        by_corners, by_noise = self._solved(self._lasting(errors)), self._solved(self._noise(widened))
        by_held = system.by_held(np.concatenate([known, np.zeros_like(known[:1])]))
        # By noise alone: the error of the aspect ratio is among the lasting ones.
        noise_of_common = system.covariance - problem.lens_information * system.covariance @ system.covariance
        covariances = widened * system.covariances(noise_of_common)[:-1]
        covariances += covariance_by_draws(by_corners.nodes[:-1]) + covariance_by_draws(by_held.nodes[:-1])
        covariances += scale_of_map(arms_of_scale(positions, positions[problem.anchors]), errors)
        nodes = by_corners.nodes + by_noise.nodes + by_held.nodes
        common = by_corners.common + by_noise.common + by_held.common
        lens = LensErrors(problem.corners[:1], problem.cameras[problem.lens], errors)
        return MapErrors(covariances, nodes[:-1], lens.aspect_draws - common[0])

    def of_aspect(self, widened: float, errors: SystematicErrors) -> FloatArray:
        """Some draws of what is estimated of the aspect ratio's error, by itself, noise and all other errors."""
        some = _SOME_DRAWS[0]
        of_all = (self.system.common(sides(some))[0] for sides in (self._lasting(errors), self._noise(widened)))
        return np.asarray(sum(of_all))

    def _noise(self, widened: float) -> DrawnSides:
        """Of noise of corners and priors."""
        problem, roots = self.problem, np.sqrt(widened * self.weights)[:, None, None]
        of_frame = np.sqrt(widened) * covariance_root(problem.odometry.weighted(self.now.camera_chi2))
        of_marker = np.sqrt(widened) * covariance_root(problem.known.weighted(self.now.marker_chi2))

        def sides(_: slice) -> Vectors:
            of_views = roots * self._normal(len(roots), 8)
            of_odometry = of_frame @ self._normal(len(of_frame), 6)
            return problem.sides(self.now, of_views, of_odometry, of_marker @ self._normal(len(of_marker), 6))

        return sides

    def _lasting(self, errors: SystematicErrors) -> DrawnSides:
        """Of corner errors that are the same in all views of a marker, and by those of the lens.

        They do not average out and leave no residuals: the shape of a fixed marker rotates the whole map, and a lens
        that is wrong bends it.
        """
        problem, weights = self.problem, self.weights[:, None, None]
        shapes = self._shapes(errors)[:, None, None, None]
        views = [problem.camera == index for index in range(len(problem.cameras))]
        lenses = [
            LensErrors(problem.corners[own], camera, errors) for own, camera in zip(views, problem.cameras, strict=True)
        ]

        no_priors = [np.zeros((number, 6, _AT_ONCE)) for number in (len(problem.stamps), len(problem.ids))]

        def sides(chosen: slice) -> Vectors:
            off = (shapes * self._normal(len(shapes), 4, 2))[problem.marker]
            for own, lens in zip(views, lenses, strict=True):
                off[own] += lens.drawn(chosen)
            of_views = weights * (problem.W @ off).reshape(-1, 8, _AT_ONCE)
            return problem.sides(self.now, of_views, *no_priors)

        return sides

    def _solved(self, sides: DrawnSides) -> Vectors:
        """Errors of all unknowns."""
        parts = zip(*(self.system.solve(sides(some)) for some in _SOME_DRAWS), strict=True)
        return Vectors(*(np.concatenate(part, axis=-1) for part in parts))

    def _normal(self, *shape: int) -> FloatArray:
        return self.rng.standard_normal((*shape, _AT_ONCE))

    def _shapes(self, errors: SystematicErrors) -> FloatArray:
        """Standard deviations (M,) [px] of corner errors that are the same in all views of a marker."""
        problem = self.problem
        precision = 0.5 * np.mean(np.sum(problem.W**2, axis=(2, 3)), axis=1)
        views = np.bincount(problem.marker)
        middle = np.cumsum(views) - 1 - views // 2
        typical = 1.0 / precision[np.lexsort((precision, problem.marker))[middle]]
        return shape_of_corners(views / np.bincount(problem.marker, precision), typical, errors)
