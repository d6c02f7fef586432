"""What the errors of an adjusted map come from, as joint draws: noise, the markers' shapes, and the lens.

Two markers that are seen in the same frames have nearly the same error, which a covariance of each does not say. Draws
of all markers together do: the error of a pose by several markers is its derivative times theirs, draw by draw.
"""

from collections.abc import Callable
from dataclasses import dataclass

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
from thermal_fiducial.core.mapping.normal_equations import ReducedSystem
from thermal_fiducial.core.types import FloatArray

#: Right sides (F, 6, k) and (M + 1, 6, k) of the normal equations.
RightSides = tuple[FloatArray, FloatArray]
#: Draws that are propagated at a time, which bounds the memory.
_AT_ONCE = 32


@dataclass(frozen=True)
class ErrorSources:
    """Errors of the M markers of an adjustment by those of what it was made from."""

    problem: MapProblem
    system: ReducedSystem
    now: Linearised
    #: (n,) robust weights of the views
    weights: FloatArray
    rng: np.random.Generator

    def of_markers(self, widened: float, errors: SystematicErrors, known: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Covariances (M, 6, 6) of the markers, and joint draws (M, 6, K) of their errors but for the scale.

        Parameters
        ----------
        widened : factor of all variances; covariances of priors come divided by it
        known : (M, 6, K) draws of the held markers; others are not used
        """
        of_odometry = np.zeros_like(known[:1])
        lasting, of_held = self._lasting(errors), self.system.by_held(np.concatenate([known, of_odometry]))[:-1]
        positions = self.now.state.T_map_marker[:, :3, 3]
        covariances = (
            widened * self.system.covariances()[:-1] + covariance_by_draws(lasting) + covariance_by_draws(of_held)
        )
        covariances += scale_of_map(arms_of_scale(positions, positions[self.problem.anchors]), errors)
        return covariances, lasting + self._noise(widened) + of_held

    def _noise(self, widened: float) -> FloatArray:
        """(M, 6, K) by noise of corners and priors."""
        problem, roots = self.problem, np.sqrt(widened * self.weights)[:, None, None]
        of_frame = np.sqrt(widened) * covariance_root(problem.odometry.weighted(self.now.camera_chi2))
        of_marker = np.sqrt(widened) * covariance_root(problem.known.weighted(self.now.marker_chi2))

        def sides(_: slice) -> RightSides:
            of_views = roots * self._normal(len(roots), 8)
            of_odometry = of_frame @ self._normal(len(of_frame), 6)
            return problem.sides(self.now, of_views, of_odometry, of_marker @ self._normal(len(of_marker), 6))

        return self._solved(sides)

    def _lasting(self, errors: SystematicErrors) -> FloatArray:
        """(M, 6, K) by corner errors that are the same in all views of a marker, and by those of the lens.

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

        def sides(chosen: slice) -> RightSides:
            off = (shapes * self._normal(len(shapes), 4, 2))[problem.marker]
            for own, lens in zip(views, lenses, strict=True):
                off[own] += lens.drawn(chosen)
            of_views = weights * (problem.W @ off).reshape(-1, 8, _AT_ONCE)
            return problem.sides(self.now, of_views, *no_priors)

        return self._solved(sides)

    def _solved(self, sides: Callable[[slice], RightSides]) -> FloatArray:
        """Errors (M, 6, K) by right sides of the normal equations, which come for some of the draws at a time."""
        chosen = (slice(first, first + _AT_ONCE) for first in range(0, DRAWS, _AT_ONCE))
        return np.concatenate([self.system.solve(*sides(some))[1][:-1] for some in chosen], axis=-1)

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
