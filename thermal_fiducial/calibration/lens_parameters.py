"""Parameters of a camera as a fit has them, their derivatives, and what is known of them without views."""

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import FloatArray, IntArray

# Shares of the distance from the centre by which the first radial term, a higher one and the tangential terms may move
# the image's corner (standard deviations): lenses of 40 to 100 degrees have up to 0.3, 0.07 and 0.005.
_FIRST, _HIGHER, _TANGENTIAL = 0.3, 0.1, 0.02
# Real lenses are nearly equidistant: shares of the radius by which each of the terms theta^3 to theta^9 moves the
# image's corner (standard deviations). Published calibrations of a Tau 2, a Boson and cameras of visible light, fitted
# without such terms, or with the first alone, where the radius is below 0.35 to 0.8 of the corner's, are off there by
# 0.04 and 0.01 (rms), with two by 0.008. Their polynomials count as far as an angle is magnified by less than 1.3 times
# as much as in the middle: beyond, they turn up where their own views ended.
_OF_REAL_LENSES = np.array([0.05, 0.01, 0.01, 0.006])
# Least share of their prior standard deviations that coefficients keep where others do the same.
_LEAST = 0.01
# Number of angles from the axis at which lenses are compared, and the widest [rad]: a pinhole has none beyond 1.57.
_ANGLES, _WIDEST = 40, 1.4
#: Number of fx fy cx cy, which come before the coefficients.
MATRIX = 4


def camera_parameters(camera: Camera) -> FloatArray:
    """Values of fx fy cx cy and the distortion coefficients."""
    K = camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], camera.D])


def by_parameters(camera: Camera, points: FloatArray, chosen: IntArray | None = None) -> FloatArray:
    """Derivative (N, 2, K) of the pixels of points (N, 3) by the ``chosen`` of all parameters; None: by each of them.

    These are fx fy cx cy, the coefficients, and where the model has no tangential ones two that would decentre it.
    """
    parameters = camera_parameters(camera)
    chosen = np.arange(MATRIX + len(prior_sigmas(camera))) if chosen is None else chosen
    J = np.zeros((len(points), 2, len(chosen)))
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    uv, by_coefficients = camera.distort_by_coefficients(points[:, :2] / points[:, 2:])
    distorted = (uv - camera.principal_point) / focal
    for place, index in enumerate(chosen.tolist()):
        if index < MATRIX:
            J[:, index % 2, place] = distorted[:, index] if index < 2 else 1.0
        elif index < len(parameters):
            J[:, :, place] = by_coefficients[:, :, index - MATRIX]
        else:
            J[:, :, place] = focal * _decentred(distorted, index - len(parameters))
    return J


def _decentred(x: FloatArray, axis: int) -> FloatArray:
    """Displacement (N, 2) of directions (N, 2) by a unit of tangential distortion (D. C. Brown, 1966)."""
    mixed, along = 2.0 * x[:, 0] * x[:, 1], np.sum(x * x, axis=1) + 2.0 * x[:, 1 - axis] ** 2
    return np.stack([mixed, along] if axis == 0 else [along, mixed], axis=1)


def with_parameters(camera: Camera, parameters: FloatArray) -> Camera:
    """The camera with other values of fx fy cx cy and the distortion coefficients."""
    fx, fy, cx, cy = parameters[:MATRIX]
    K = np.array([[max(fx, 1.0), 0.0, cx], [0.0, max(fy, 1.0), cy], [0.0, 0.0, 1.0]])
    return Camera(camera.width, camera.height, K, camera.model, parameters[MATRIX:])


def prior_sigmas(camera: Camera) -> FloatArray:
    """Standard deviations about zero of the distortion coefficients (D,), then of decentring that the model lacks."""
    reach = _reach(camera)
    if camera.model == 'equidistant':
        radial = np.array([_FIRST, _HIGHER, _HIGHER, _HIGHER]) / reach ** np.array([2, 4, 6, 8])
        return np.asarray(np.append(radial, [_TANGENTIAL / reach] * 2))
    sigmas = np.array([_FIRST, _HIGHER, _TANGENTIAL, _TANGENTIAL, _HIGHER, _FIRST, _HIGHER, _HIGHER])
    powers = np.array([2, 4, 1, 1, 6, 2, 4, 6])
    return np.asarray((sigmas / reach**powers)[: len(camera.D)])


def _reach(camera: Camera) -> float:
    """Distance from the centre to the farthest corner in units of the focal length."""
    last, focal = np.array([camera.width, camera.height]) - 1.0, np.array([camera.K[0, 0], camera.K[1, 1]])
    return float(np.linalg.norm(np.maximum(camera.principal_point, last - camera.principal_point) / focal))


def lens_prior(camera: Camera) -> tuple[FloatArray, FloatArray]:
    """What is known of lenses without views: an equidistant one, off by what real ones are.

    Returns
    -------
    The step (D,) from the camera's coefficients, and from decentring that the model lacks, to those of such a lens, and
    their information (D, D) about it.
    """
    sigmas = prior_sigmas(camera)
    tangential = np.arange(2, 4) if camera.model != 'equidistant' else np.arange(len(camera.D), len(sigmas))
    radial = np.setdiff1d(np.arange(len(sigmas)), tangential)
    farthest, focal = min(_reach(camera), _WIDEST), np.array([camera.K[0, 0], camera.K[1, 1]])
    angles, along = farthest * (np.arange(_ANGLES) + 1.0) / _ANGLES, np.full(2, np.sqrt(0.5))
    rays = np.tan(angles)[:, None] * along
    distance = (camera.distort(rays) - camera.principal_point) / focal @ along
    by_coefficients = by_parameters(camera, np.column_stack([rays, np.ones(_ANGLES)]), MATRIX + radial)
    by_coefficients = np.swapaxes(by_coefficients, 1, 2) / focal @ along
    terms = _OF_REAL_LENSES * angles[:, None] * (angles[:, None] / farthest) ** np.array([2, 4, 6, 8])
    # The last unknown is the focal length of the equidistant lens.
    unknowns = np.column_stack([by_coefficients * sigmas[radial], angles])
    fitted = np.linalg.lstsq(unknowns, np.column_stack([-distance, terms]), rcond=_LEAST**2)[0][:-1]
    fitted *= sigmas[radial, None]
    step, information = np.zeros(len(sigmas)), np.diag(sigmas**-2)
    step[radial] = fitted[:, 0]
    step[tangential] = -np.append(camera.D, np.zeros(2))[tangential]
    covariance = fitted[:, 1:] @ fitted[:, 1:].T + np.diag((_LEAST * sigmas[radial]) ** 2)
    information[np.ix_(radial, radial)] = np.linalg.inv(covariance)
    return step, information
