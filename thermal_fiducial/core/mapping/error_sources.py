"""What the errors of an adjusted map come from, as joint draws: noise, the markers' shapes, and the lens.

Two markers that are seen in the same frames have nearly the same error, which a covariance of each does not say. Draws
of all markers together do: the error of a pose by several markers is its derivative times theirs, draw by draw.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from thermal_fiducial.core.error_model import (
    arms_of_scale,
    covariance_by_draws,
    covariance_root,
    drawn_sum,
    DRAWS,
    scale_of_map,
    shape_of_corners,
    SystematicErrors,
)
from thermal_fiducial.core.lens_errors import LensErrors
from thermal_fiducial.core.mapping.adjustment_problem import Linearised, MapProblem
from thermal_fiducial.core.mapping.normal_equations import ReducedSystem, Vectors
from thermal_fiducial.core.types import FloatArray, IntArray


class MapErrors(NamedTuple):
    """Errors of M adjusted markers, and of the lens."""

    #: (M, 6, 6), and (M, 6, K) joint draws of all but the scale's
    covariances: FloatArray
    draws: FloatArray
    #: (K,) draws of what is left of the aspect ratio's error, as a share of the declared one
    aspect_left: FloatArray
    #: standard deviation of the readout time's estimate, in units of its prior
    readout_std: float


@dataclass(frozen=True)
class ErrorSources:
    """Errors of the M markers of an adjustment by those of what it was made from."""

    problem: MapProblem
    system: ReducedSystem
    now: Linearised
    #: (n,) robust weights of the views
    weights: FloatArray
    #: systematic errors as declared, those of corners as learned
    errors: SystematicErrors
    #: by which the residuals widen all variances; covariances of priors come divided by it
    variance_factor: float
    rng: np.random.Generator

    def of_markers(self, known: FloatArray) -> MapErrors:
        """Errors of the markers, and what is left of those of aspect ratio and readout time.

        Parameters
        ----------
        known : (M, 6, K) draws of the held markers; others are not used
        """
        system, problem, positions = self.system, self.problem, self.now.state.T_map_marker[:, :3, 3]
        by_corners = system.solve(self._lasting())
        by_held = system.by_held(np.concatenate([known, np.zeros_like(known[:1])]))
        common = covariance_root(self.noise_of_common) @ self.rng.standard_normal((len(by_corners.common), DRAWS))
        by_noise = np.sqrt(self.variance_factor) * system.drawn(common, self.rng)
        covariances = self.variance_factor * system.covariances(self.noise_of_common)[:-1]
        covariances += covariance_by_draws(by_corners.nodes[:-1]) + covariance_by_draws(by_held.nodes[:-1])
        covariances += scale_of_map(arms_of_scale(positions, positions[problem.anchors]), self.errors)
        draws = by_corners.nodes + by_noise + by_held.nodes
        found = by_corners.common + np.sqrt(self.variance_factor) * common + by_held.common
        aspect = LensErrors(problem.corners[:1], problem.camera, self.errors).aspect_draws
        return MapErrors(covariances, draws[:-1], aspect - found[0], float(np.sqrt(np.mean(found[1] ** 2))))

    @property
    def noise_of_common(self) -> FloatArray:
        """Covariance (2, 2) by noise and the prior of the readout time; the aspect ratio's error is a lasting one."""
        covariance = self.system.covariance
        by_aspect = covariance[:, :1]
        return np.asarray(covariance - self.problem.common_information[0] * by_aspect @ by_aspect.T)

    def _lasting(self) -> Vectors:
        """Right sides by corner errors that are the same in all views of a marker, and by those of the lens.

        They do not average out and leave no residuals: the shape of a fixed marker rotates the whole map, and a lens
        that is wrong bends it.
        """
        problem, now = self.problem, self.now
        shapes = self._shapes()[:, None, None] * self.rng.standard_normal((len(problem.ids), 8, DRAWS))
        # What is common has its part of each keyframe's views, too.
        J_frame = np.concatenate([now.J @ np.swapaxes(now.to_camera, -1, -2), problem.J_common], axis=-1)
        of_frames, of_markers = self._by_corners(J_frame), self._by_corners(now.J)
        frames = self._by_lens(of_frames, problem.frame, len(problem.stamps))
        nodes = self._by_lens(of_markers, problem.marker, len(problem.ids))
        # Each marker has one shape, and a keyframe many markers.
        nodes += np.swapaxes(problem.over_markers(of_markers), 1, 2).reshape(len(nodes), 6, 8) @ shapes
        of_views = np.swapaxes(of_frames, 1, 2).reshape(len(of_frames), -1, 8)
        starts = np.flatnonzero(np.diff(problem.frame))
        for frame, views in enumerate(np.split(np.arange(len(of_views)), starts + 1)):
            frames[frame] += drawn_sum(of_views[views], shapes[problem.marker[views]])
        return Vectors(frames[:, :6], np.concatenate([nodes, np.zeros_like(nodes[:1])]), frames[:, 6:].sum(axis=0))

    def _by_lens(self, gains: FloatArray, group: IntArray, count: int) -> FloatArray:
        """Draws (count, m, K) by the lens of what has derivatives (n, 4, m, 2), summed over views by ``group`` (n,)."""
        order, result = np.argsort(group, kind='stable'), np.zeros((count, gains.shape[2], DRAWS))
        some, starts = np.unique(group[order], return_index=True)
        lens = LensErrors(self.problem.corners[order], self.problem.camera, self.errors)
        result[some] = lens.drawn_sums(gains[order].reshape(4 * len(order), -1, 2), 4 * starts)
        return result

    def _by_corners(self, J: FloatArray) -> FloatArray:
        """Derivatives (n, 4, m, 2) of right sides by errors of the corners [1/px], from whitened ones (n, 8, m)."""
        weighted = (self.weights[:, None, None] * J).reshape(len(J), 4, 2, -1)
        return np.asarray(np.swapaxes(weighted, -1, -2) @ self.problem.W)

    def _shapes(self) -> FloatArray:
        """Standard deviations (M,) [px] of corner errors that are the same in all views of a marker."""
        problem = self.problem
        precision = 0.5 * np.mean(np.sum(problem.W**2, axis=(2, 3)), axis=1)
        views = np.bincount(problem.marker)
        middle = np.cumsum(views) - 1 - views // 2
        typical = 1.0 / precision[np.lexsort((precision, problem.marker))[middle]]
        return shape_of_corners(views / np.bincount(problem.marker, precision), typical, self.errors)
