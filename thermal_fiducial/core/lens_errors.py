"""Errors of a lens model: a smooth function of the place in the image, the same in all frames.

A Gaussian process with a squared exponential covariance, the same for either axis, by its values at nodes over the
image (J. Quinonero-Candela, C. Rasmussen, "A Unifying View of Sparse Approximate Gaussian Process
Regression", JMLR 2005). Poses and maps from one camera have errors of the same draws, wherever these are needed.
"""

from functools import cache
from zlib import crc32

import numpy as np

from thermal_fiducial.core.error_model import DRAWS, SystematicErrors
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray

#: Nodes are at most this many lengths of the process apart: between them its variance is known to 1 %.
_NODES_APART = 1.0
#: Least variance of a node that the others leave unexplained.
_LEAST_INDEPENDENT = 1e-6


class LensErrors:
    """Errors of the lens model at n corners (..., 2) [px].

    Parameters
    ----------
    errors : standard deviation and length of the process
    """

    def __init__(self, corners: FloatArray, camera: Camera, errors: SystematicErrors) -> None:
        length = errors.corner_length * camera.width
        columns, rows = (
            _modes(corners[..., axis], size, length) for axis, size in ((0, camera.width), (1, camera.height))
        )
        #: (..., I) factors of independent variables of variance one, for errors of 1 px
        self.modes: FloatArray = (columns[..., :, None] * rows[..., None, :]).reshape(*corners.shape[:-1], -1)
        self._px, self._camera = errors.corner_px, camera

    def covariance(self, gains: FloatArray) -> FloatArray:
        """Covariance (m, m) of what has derivatives ``gains`` (n, m, 2) [1/px] by the corners."""
        mixed = np.tensordot(self.modes.reshape(len(gains), -1), self._px * gains, axes=([0], [0]))
        return np.asarray(np.tensordot(mixed, mixed, axes=([0, 2], [0, 2])))

    def drawn(self, chosen: slice = slice(None)) -> FloatArray:
        """The errors (..., 2, k) [px] in the ``chosen`` ones of :data:`DRAWS` draws."""
        variables = _variables(crc32(np.ascontiguousarray(self._camera.K).tobytes()), self.modes.shape[-1])
        return np.asarray(np.tensordot(self.modes, self._px * variables[..., chosen], axes=1))


def _modes(places: FloatArray, size: int, length: float) -> FloatArray:
    """(..., I) factors of the process along one axis of an image at ``places`` (...) [px]."""
    nodes, to_modes = _nodes(size, length)
    return np.asarray(np.exp(-0.5 * np.square((places[..., None] - nodes) / length)) @ to_modes)


@cache
def _nodes(size: int, length: float) -> tuple[FloatArray, FloatArray]:
    """Nodes (I,) over the ``size`` of an image [px], and (I, I) from correlations with them to independent factors."""
    nodes = np.linspace(0.0, size, 2 + int(size / (_NODES_APART * length)))
    K = np.exp(-0.5 * np.square((nodes[:, None] - nodes) / length)) + _LEAST_INDEPENDENT * np.eye(len(nodes))
    return nodes, np.linalg.inv(np.linalg.cholesky(K)).T


@cache
def _variables(seed: int, modes: int) -> FloatArray:
    """Variables (modes, 2, DRAWS) of one camera, of variance one; uncorrelated as far as there are draws."""
    most, fewest = max(2 * modes, DRAWS), min(2 * modes, DRAWS)
    axes = np.linalg.qr(np.random.default_rng(seed).standard_normal((most, fewest)))[0]
    return np.asarray(np.sqrt(most) * (axes.T if fewest < DRAWS else axes).reshape(modes, 2, DRAWS))
