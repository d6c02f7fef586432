"""Least squares over the intrinsics of a camera, the pose of a board in every view, and the shape of the board.

The residuals use the package's own camera model, so the estimate is consistent with its use. Distortion coefficients
have a prior that limits the displacement of the image's corner relative to its distance from the centre. It is too weak
to matter where views reach the corner, and constrains what they do not determine. What is claimed where no view
reaches follows from real lenses instead (:func:`lens_prior`).

A board that is not exactly as described bends the lens. Its points are unknowns too where ``board_std`` says how well
they are known: K. Strobl, G. Hirzinger, "More accurate pinhole camera calibration with imperfect planar target", 2011.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from thermal_fiducial.calibration.lens_parameters import (
    by_parameters,
    camera_parameters,
    lens_prior,
    MATRIX,
    prior_sigmas,
    with_parameters,
)
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray, IntArray

# Huber threshold [standard deviations].
_HUBER = 3.0
_MAX_STEPS = 60
# Relative decrease of the cost at convergence; damping at which the fit gives up.
_CONVERGED, _MOST_DAMPED = 1e-7, 1e9
#: Convergence for fits whose errors are only compared to some per cent.
NEARLY = 1e-4
# Most updates of the circles' centroids, and largest change at convergence [px].
_ROUNDS, _SETTLED_PX = 4, 1e-4
# A polygon with the second moments of the circle, so that perspective displaces both centroids equally.
_ANGLE = np.pi / 6.0
_TURNS = np.arange(12) * _ANGLE
_CIRCLE = np.sqrt(3.0 / (2.0 + np.cos(_ANGLE))) * np.stack([np.cos(_TURNS), np.sin(_TURNS), 0.0 * _TURNS], axis=1)


class FittedBoard(NamedTuple):
    """Unknowns of a fit.

    Parameters
    ----------
    camera : with the intrinsics
    T : (V, 4, 4) T_camera_board of each view
    places : (P, 3) of the board's points [m], in the order of their coordinates as described
    """

    camera: Camera
    T: FloatArray
    places: FloatArray


class LensFit:
    """Levenberg-Marquardt for a camera, its views, and the board.

    Parameters
    ----------
    camera : initial values; coefficients that are not ``free`` are held
    radius : of the board's circles [m]; 0 for corners
    free : indices of the coefficients to estimate; None: all
    poses_only : whether the camera is held
    centroids : for each view the offsets (N, 2) of its circles' centroids from their centres [px], held fixed; None:
        computed from the radius
    converged : relative decrease of the cost at convergence
    board_std : standard deviation of each coordinate of the board's points [m]; 0: they are as described

    Attributes
    ----------
    described : (P, 3) the board's points, in the order of a :class:`FittedBoard`
    """

    def __init__(
        self,
        sightings: Sequence[Sighting],
        camera: Camera,
        radius: float,
        free: Sequence[int] | None = None,
        *,
        poses_only: bool = False,
        centroids: Sequence[FloatArray] | None = None,
        converged: float = _CONVERGED,
        board_std: float = 0.0,
    ) -> None:
        points = np.concatenate([sighting.points for sighting in sightings])
        self.described, point = np.unique(points, axis=0, return_inverse=True)
        # Of two dimensions by numpy 2.0 alone.
        self._point = point.reshape(-1)
        self._pixels = np.concatenate([sighting.pixels for sighting in sightings])
        self._lengths = [len(sighting.points) for sighting in sightings]
        self._view = np.repeat(np.arange(len(sightings)), self._lengths)
        # Rows of each view's points, padded by repeated rows of zero weight.
        place, ends = np.arange(max(self._lengths)), np.cumsum(self._lengths)[:, None]
        self._there = place < np.array(self._lengths)[:, None]
        self._rows = np.minimum(ends - np.array(self._lengths)[:, None] + place, ends - 1)
        self._camera, self._radius = camera, radius if centroids is None else 0.0
        self._centroid = np.zeros_like(self._pixels) if centroids is None else np.concatenate(centroids)
        self._converged = converged
        coefficients = range(len(camera.D)) if free is None else sorted(free)
        shared = [] if poses_only else [*range(MATRIX), *(MATRIX + index for index in coefficients)]
        self._free: IntArray = np.array(shared, dtype=np.int64)
        sigmas = prior_sigmas(camera)
        self._prior = np.append(np.zeros(MATRIX), sigmas**-2)
        self._lacking = np.zeros(len(sigmas) - len(camera.D))
        self._board_std = board_std

    def solve(self, T: FloatArray) -> FittedBoard:
        """All unknowns, from initial poses T_camera_board (V, 4, 4)."""
        state = FittedBoard(self._camera, T, self.described)
        for _ in range(_ROUNDS):
            change = self._update_centroids(state)
            state = self._minimise(state)
            if change < _SETTLED_PX:
                break
        return state

    def covariance(self, state: FittedBoard) -> FloatArray:
        """Covariance of fx fy cx cy, all coefficients, held ones too, and decentring that the model lacks.

        It has two parts: the noise of the residuals, and the change by the step to the solution with all of them free,
        as far as :func:`lens_prior` lets them.
        Held-out views do not show a gain below some per cent; a coefficient of five standard deviations may gain less.
        """
        free, self._free = self._free, np.arange(len(self._prior))
        error = self.error(state)
        count = len(self._prior)
        unknowns = count + 6 * len(state.T) + (state.places.size if self._board_std else 0)
        variance = float(np.sum(error**2)) / max(1, error.size - unknowns)
        information, _ = self._normal_equations(state, error, np.inf, 0.0, variance)
        to_prior, known = lens_prior(state.camera)
        information[MATRIX:count, MATRIX:count] += variance * known
        scale = np.sqrt(np.diag(information)) + 1e-12
        inverse = np.linalg.pinv(information / np.outer(scale, scale), hermitian=True) / np.outer(scale, scale)
        _, gradient = self._normal_equations(state, error, _HUBER * _noise(error), 0.0, variance)
        gradient[MATRIX:count] -= variance * known @ to_prior
        change = (inverse @ gradient)[:count]
        self._free = free
        return np.asarray(variance * inverse[:count, :count] + np.outer(change, change))

    def residuals(self, state: FittedBoard) -> list[FloatArray]:
        """Measured minus predicted (N, 2) [px] of each view."""
        return self._by_view(-self.error(state))

    def centroids(self, state: FittedBoard) -> list[FloatArray]:
        """Offsets (N, 2) [px] of the circles' centroids from their centres, per view."""
        self._update_centroids(state)
        return self._by_view(self._centroid)

    def error(self, state: FittedBoard) -> FloatArray:
        """Predicted minus measured (N, 2) [px]; large where the model cannot project a point."""
        predicted = state.camera.project(self._in_camera(state)) + self._centroid
        return np.asarray(np.nan_to_num(predicted - self._pixels, nan=1e3))

    def moved(self, state: FittedBoard, step: FloatArray) -> FittedBoard:
        """The unknowns after a ``step``: free parameters, 6 of each pose, and 3 of each point if these are unknowns."""
        camera, T, places = state
        shared, poses = len(self._free), len(self._free) + 6 * len(T)
        if shared:
            parameters = camera_parameters(camera)
            parameters[self._free] += step[:shared]
            camera = with_parameters(camera, parameters)
        if self._board_std:
            places = places + step[poses:].reshape(-1, 3)
        turn = step[shared:poses].reshape(-1, 6)
        T = se3.transform(se3.so3_exp(turn[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] + turn[:, :3])
        return FittedBoard(camera, T, places)

    def jacobian(self, state: FittedBoard) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of :meth:`error`, by the free parameters (N, 2, I), the pose of the view (N, 2, 6) and the point (N, 2, 3).

        Circles move like their centres to first order.
        """
        T = state.T[self._view]
        points = self._in_camera(state)
        _, by_point = state.camera.project_jacobian(points)
        by_point = np.nan_to_num(by_point)
        by_pose = np.concatenate([by_point, -by_point @ se3.skew(points - T[:, :3, 3])], axis=-1)
        by_shared = by_parameters(state.camera, points, self._free)
        return np.nan_to_num(by_shared), by_pose, by_point @ T[:, :3, :3]

    def _minimise(self, state: FittedBoard) -> FittedBoard:
        error = self.error(state)
        noise = _noise(error)
        cost, damping = self._cost(state, error, noise), 1e-3
        for _ in range(_MAX_STEPS):
            information, gradient = self._normal_equations(state, error, _HUBER * noise, noise**2, noise**2)
            while damping < _MOST_DAMPED:
                damped = information + damping * np.diag(np.diag(information) + 1e-12)
                moved = self.moved(state, -np.asarray(np.linalg.solve(damped, gradient), dtype=np.float64))
                after = self.error(moved)
                lower = self._cost(moved, after, noise)
                if lower < cost:
                    break
                damping *= 10.0
            else:
                break
            gain, state, error, damping = (cost - lower) / cost, moved, after, 0.1 * damping
            if gain < self._converged:
                break
            noise = min(noise, _noise(error))
            cost = self._cost(state, error, noise)
        return state

    def _cost(self, state: FittedBoard, error: FloatArray, noise: float) -> float:
        """Huber's: quadratic up to three times the ``noise`` [px], linear beyond; and the priors'."""
        size, limit = np.abs(error), _HUBER * noise
        misfit = float(np.sum(np.where(size <= limit, 0.5 * size**2, limit * (size - 0.5 * limit))))
        prior = float(self._prior[self._free] @ camera_parameters(state.camera)[self._free] ** 2)
        if self._board_std:
            prior += float(np.sum((state.places - self.described) ** 2)) / self._board_std**2
        return misfit + 0.5 * noise**2 * prior

    def _normal_equations(
        self, state: FittedBoard, error: FloatArray, limit: float, of_lens: float, of_board: float
    ) -> tuple[FloatArray, FloatArray]:
        """Information and gradient; errors beyond ``limit`` [px] count less.

        The priors of lens and board count as for residuals of the variances ``of_lens`` and ``of_board`` [px^2].
        """
        weight = np.minimum(1.0, limit / np.maximum(np.abs(error), 1e-12))
        by_shared, by_pose, by_point = self.jacobian(state)
        views, shared = len(state.T), len(self._free)
        padded = (weight[self._rows] * self._there[..., None]).reshape(views, -1, 1)
        J = np.concatenate([by_shared, by_pose], axis=2)[self._rows].reshape(views, -1, shared + 6)
        weighted = (J * padded).swapaxes(1, 2)
        blocks, slopes = weighted @ J, weighted @ error[self._rows].reshape(views, -1, 1)
        information = np.zeros((shared + 6 * views, shared + 6 * views))
        information[:shared, :shared] = blocks[:, :shared, :shared].sum(axis=0)
        information[:shared, shared:] = np.concatenate(blocks[:, :shared, shared:], axis=1)
        information[shared:, :shared] = information[:shared, shared:].T
        of_poses = np.zeros((views, 6, views, 6))
        of_poses[np.arange(views), :, np.arange(views)] = blocks[:, shared:, shared:]
        information[shared:, shared:] = of_poses.reshape(6 * views, 6 * views)
        gradient = np.concatenate([slopes[:, :shared, 0].sum(axis=0), slopes[:, shared:, 0].reshape(-1)])
        prior = of_lens * self._prior[self._free]
        information[range(shared), range(shared)] += prior
        gradient[:shared] += prior * np.append(camera_parameters(state.camera), self._lacking)[self._free]
        if not self._board_std:
            return information, gradient
        own, cross, slope = self._board_equations(by_shared, by_pose, by_point, weight, error)
        known = of_board / self._board_std**2
        own[range(len(own)), range(len(own))] += known
        slope += known * (state.places - self.described).reshape(-1)
        return np.block([[information, cross.T], [cross, own]]), np.concatenate([gradient, slope])

    def _board_equations(
        self, by_shared: FloatArray, by_pose: FloatArray, by_point: FloatArray, weight: FloatArray, error: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Of the board's points: information (3 P, 3 P), that shared with all other unknowns, and gradient (3 P,)."""
        points, views = len(self.described), len(self._lengths)
        weighted = (by_point * weight[..., None]).swapaxes(1, 2)
        blocks, slopes = np.zeros((points, 3, 3)), np.zeros((points, 3, 1))
        by_lens, by_poses = np.zeros((points, 3, by_shared.shape[2])), np.zeros((points * views, 3, 6))
        np.add.at(blocks, self._point, weighted @ by_point)
        np.add.at(slopes, self._point, weighted @ error[..., None])
        np.add.at(by_lens, self._point, weighted @ by_shared)
        np.add.at(by_poses, self._point * views + self._view, weighted @ by_pose)
        own = np.zeros((points, 3, points, 3))
        own[np.arange(points), :, np.arange(points)] = blocks
        by_poses = by_poses.reshape(points, views, 3, 6).swapaxes(1, 2).reshape(points, 3, -1)
        cross = np.concatenate([by_lens, by_poses], axis=2)
        return own.reshape(3 * points, -1), cross.reshape(3 * points, -1), slopes.reshape(-1)

    def _update_centroids(self, state: FittedBoard) -> float:
        """Update the centroids' offsets; returns the largest change [px]."""
        if self._radius == 0.0:
            return 0.0
        T, points = state.T[self._view], state.places[self._point]
        outline = state.camera.project(se3.apply(T, points[:, None] + self._radius * _CIRCLE))
        centre = state.camera.project(self._in_camera(state))
        before = self._centroid
        self._centroid = np.nan_to_num(_area_centroid(outline) - centre)
        return float(np.abs(self._centroid - before).max())

    def _in_camera(self, state: FittedBoard) -> FloatArray:
        """Points (N, 3) of all views in the camera [m]."""
        T = state.T[self._view]
        return np.asarray(np.einsum('nij,nj->ni', T[:, :3, :3], state.places[self._point]) + T[:, :3, 3])

    def _by_view(self, rows: FloatArray) -> list[FloatArray]:
        """Rows (N, 2) of all points as those of each view."""
        return np.split(rows, np.cumsum(self._lengths)[:-1])


def _noise(error: FloatArray) -> float:
    """Standard deviation of a coordinate, from the median; at least a hundredth of a pixel."""
    return max(1.4826 * float(np.median(np.abs(error))), 0.01)


def _area_centroid(outline: FloatArray) -> FloatArray:
    """Centroid (N, 2) of the areas that closed polygons (N, M, 2) enclose: what the moments of a disc measure."""
    middle = outline.mean(axis=1, keepdims=True)
    a = outline - middle
    b = np.roll(a, -1, axis=1)
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    centroid = np.sum((a + b) * cross[..., None], axis=1) / (3.0 * np.sum(cross, axis=1)[:, None])
    return np.asarray(middle[:, 0] + centroid)
