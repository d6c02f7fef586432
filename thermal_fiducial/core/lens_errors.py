"""Errors of a camera model: a smooth function of the place in the image, the same in all frames, and focal lengths.

A Gaussian process with a squared exponential covariance, the same for either axis, by its values at nodes over the
image (J. Quinonero-Candela, C. Rasmussen, "A Unifying View of Sparse Approximate Gaussian Process
Regression", JMLR 2005). Poses and maps from one camera have errors of the same draws, wherever these are needed.
"""

from functools import cache, cached_property, lru_cache
from itertools import pairwise
from zlib import crc32

import numpy as np

from thermal_fiducial.core.error_model import CORNER_LENGTH, DRAWS, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray, IntArray

#: Nodes are at most this many lengths of the process apart: between them its variance is known to 1 %.
_NODES_APART = 1.0
#: Number of cameras whose draws are kept.
_CAMERAS = 16
#: Least variance of a node that the others leave unexplained.
_LEAST_INDEPENDENT = 1e-6


class LensErrors:
    """Errors of the lens model at n corners (..., 2) [px]; ``errors`` gives their size."""

    def __init__(self, corners: FloatArray, camera: Camera, errors: SystematicErrors) -> None:
        length = CORNER_LENGTH * camera.width
        columns, rows = (
            _modes(corners[..., axis], size, length) for axis, size in ((0, camera.width), (1, camera.height))
        )
        #: (..., I) factors of independent variables of variance one, for errors of 1 px
        self.modes: FloatArray = (columns[..., :, None] * rows[..., None, :]).reshape(*corners.shape[:-1], -1)
        self._px, self._camera, self._aspect_left = errors.corner_px, camera, errors.aspect_left
        arms = corners - camera.principal_point
        #: (..., 2) by one standard deviation of the focal length, and of the aspect ratio [px]
        self.of_focal_length: FloatArray = errors.focal_length_std * arms
        self._of_aspect: FloatArray = of_aspect(corners, camera, errors)

    @property
    def aspect_draws(self) -> FloatArray:
        """(K,) of what is not known of the aspect ratio."""
        return self._variables[2]

    def covariance(self, gains: FloatArray) -> FloatArray:
        """Covariance (m, m) of what has derivatives ``gains`` (n, m, 2) [1/px] by the corners."""
        mixed = np.tensordot(self.modes.reshape(len(gains), -1), self._px * gains, axes=([0], [0]))
        left = 1.0 if self._aspect_left is None else float(np.sqrt(np.mean(self._aspect_left**2)))
        lengths = np.stack([self.of_focal_length.reshape(-1, 2), left * self._of_aspect.reshape(-1, 2)])
        of_lengths = np.tensordot(gains, lengths, axes=([0, 2], [1, 2]))
        return np.asarray(np.tensordot(mixed, mixed, axes=([0, 2], [0, 2])) + of_lengths @ of_lengths.T)

    def drawn_sums(self, gains: FloatArray, starts: IntArray) -> FloatArray:
        """:data:`DRAWS` draws (G, m, K) of sums over groups of successive corners.

        Parameters
        ----------
        gains : (n, m, 2) derivatives by the corners [1/px]
        starts : (G,) first corner of each group
        """
        modes, by_axes = self.modes.reshape(len(gains), -1), gains.reshape(len(gains), -1)
        bounds = pairwise([*starts.tolist(), len(gains)])
        smooth = np.stack([modes[first:end].T @ by_axes[first:end] for first, end in bounds])
        smooth = smooth.reshape(*smooth.shape[:2], *gains.shape[1:])
        lens, focal_length, aspect = self._variables
        draws = np.tensordot(smooth, self._px * lens, axes=([1, 3], [0, 1]))
        for of_length, drawn in ((self.of_focal_length, focal_length), (self._of_aspect, aspect)):
            moved = np.einsum('nmu,nu->nm', gains, of_length.reshape(-1, 2))
            draws += np.add.reduceat(moved, starts, axis=0)[..., None] * drawn
        return np.asarray(draws)

    def drawn_sum(self, gains: FloatArray) -> FloatArray:
        """:data:`DRAWS` draws (m, K) of what has derivatives ``gains`` (n, m, 2) [1/px] by the corners."""
        return np.asarray(self.drawn_sums(gains, np.zeros(1, dtype=np.int64))[0])

    def drawn(self) -> FloatArray:
        """The errors (..., 2, K) [px] in :data:`DRAWS` draws."""
        lens, focal_length, aspect = self._variables
        smooth = np.tensordot(self.modes, self._px * lens, axes=1)
        of_lengths = self.of_focal_length[..., None] * focal_length + self._of_aspect[..., None] * aspect
        return np.asarray(smooth + of_lengths)

    @cached_property
    def _variables(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Draws of the smooth error (I, 2, K), of the focal length (K,), and of the aspect ratio (K,)."""
        seed = crc32(np.ascontiguousarray(self._camera.K).tobytes())
        smooth, (focal_length, aspect) = _drawn_variables(seed, self.modes.shape[-1])
        return smooth, focal_length, aspect if self._aspect_left is None else self._aspect_left


def of_aspect(corners: FloatArray, camera: Camera, errors: SystematicErrors) -> FloatArray:
    """Errors (..., 2) [px] of corners (..., 2) by one standard deviation of the aspect ratio."""
    return np.asarray(errors.aspect * camera.aspect_error * (corners - camera.principal_point))


def without_found_aspect(corners: FloatArray, camera: Camera, errors: SystematicErrors) -> FloatArray:
    """Corners (..., 2) [px] without what an adjustment of the map has found of the error of the aspect ratio."""
    if not errors.aspect_found:
        return corners
    return np.asarray(corners - errors.aspect_found * of_aspect(corners, camera, errors))


def _modes(places: FloatArray, size: int, length: float) -> FloatArray:
    """Values (..., I) at ``places`` (...) [px] of functions of one axis: the smooth error is a random sum of them."""
    nodes, to_modes = _nodes(size, length)
    return np.asarray(np.exp(-0.5 * np.square((places[..., None] - nodes) / length)) @ to_modes)


@cache
def _nodes(size: int, length: float) -> tuple[FloatArray, FloatArray]:
    """Nodes (I,) over the ``size`` of an image [px], and (I, I) from correlations with them to independent factors."""
    nodes = np.linspace(0.0, size, 2 + int(size / (_NODES_APART * length)))
    K = np.exp(-0.5 * np.square((nodes[:, None] - nodes) / length)) + _LEAST_INDEPENDENT * np.eye(len(nodes))
    return nodes, np.linalg.inv(np.linalg.cholesky(K)).T


@lru_cache(maxsize=_CAMERAS)
def _drawn_variables(seed: int, modes: int) -> tuple[FloatArray, FloatArray]:
    """Variables (modes, 2, DRAWS), (2, DRAWS) of a camera, of variance one; uncorrelated as far as there are draws."""
    count = 2 * modes + 2
    most, fewest = max(count, DRAWS), min(count, DRAWS)
    axes = np.linalg.qr(np.random.default_rng(seed).standard_normal((most, fewest)))[0]
    variables = np.sqrt(most) * (axes.T if fewest < DRAWS else axes)
    return variables[:-2].reshape(modes, 2, DRAWS), variables[-2:]
