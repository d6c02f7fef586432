"""Plausible ranges of cameras, positions and covariances, which every stage may rely on.

They are far beyond anything real, and small enough that squares and products of accepted values stay finite.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from thermal_fiducial.config import LARGEST_SIDE
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.types import Counts, FloatArray, Gray
from thermal_fiducial.errors import InputError

if TYPE_CHECKING:
    from thermal_fiducial.core.geometry.camera import Camera

#: Variances [m^2, rad^2, px^2]: from a tenth of a nanometre to ten kilometres, which others write for "unknown".
SMALLEST_VARIANCE, LARGEST_VARIANCE = 1e-20, 1e8
#: Least share of a variance that the other components may leave unexplained; rounding takes less than a tenth of it.
LEAST_INDEPENDENT = 1e-12
#: Kinds of numpy's types that are real numbers: floating-point, integers with and without sign.
_REAL_NUMBERS = 'fiu'
#: Relative difference of entries that should be equal, by rounding of a few operations.
_ROUNDING = 1e-9
#: Added to variances that may be zero, before the check, beside that share of the largest one [m^2, rad^2].
_NO_VARIANCE = 1e-15
#: Focal length and distance of the principal point from the image, in longer sides of the image.
_FOCAL_RANGE, _FARTHEST_CENTRE = (0.02, 1000.0), 1.0
_IMAGE_SIDES = (8, 16384)
#: Distance of the principal point from the middle of the image, as a share of its sides, beyond which the calibration
#: is doubted: half a resolution makes it 0.25; of six published calibrations of other cameras the largest is 0.07.
_DOUBTFUL_CENTRE = 0.2
#: How far a rotation matrix times its transpose may be off the identity: one that was written down with four digits.
_ORTHONORMAL = 1e-3
#: Error [px] to which a distortion must be invertible half-way from the centre to the corners.
_ROUND_TRIP_PX = 1.0


def checked_covariance(values: FloatArray, what: str, *, partial: bool = False) -> FloatArray:
    """``values``, or the symmetric part (..., n, n) of covariances that rounding alone does not make asymmetric.

    ``partial``: of errors that may have no variance in some directions.

    Raises
    ------
    InputError
        Not finite, not positive definite, or with a variance beyond the bounds.
    """
    symmetric = 0.5 * values + 0.5 * np.swapaxes(values, -1, -2)
    if not np.isfinite(symmetric).all():
        raise InputError(f'{what} that is not finite')
    P, eye = symmetric, np.eye(values.shape[-1])
    if partial:
        largest = max(float(np.diagonal(P, axis1=-2, axis2=-1).max()), 0.0)
        P = P + (_ROUNDING * largest + _NO_VARIANCE) * eye
    variances = np.diagonal(P, axis1=-2, axis2=-1)
    low, high = float(variances.min()), float(variances.max())
    if not (low > SMALLEST_VARIANCE and high < LARGEST_VARIANCE):
        raise InputError(f'{what} with a variance of {low if low <= SMALLEST_VARIANCE else high:.3g}')
    # Of a positive definite matrix the largest is on the diagonal; Cholesky's squares of what is larger may overflow.
    if not np.abs(P).max() <= high:
        raise InputError(f'{what} that is not positive definite')
    try:
        # A reduced diagonal tests the least own variance of each component, whatever their units.
        np.linalg.cholesky(P - LEAST_INDEPENDENT * eye * P)
    except np.linalg.LinAlgError:
        raise InputError(f'{what} that is not positive definite') from None
    return values if (np.abs(symmetric - values) <= _ROUNDING * np.abs(values)).all() else symmetric


def is_rigid(T: FloatArray) -> bool:
    """Whether ``T`` (4, 4) is finite, and a rotation with a translation: neither scaled nor mirrored."""
    if not np.isfinite(T).all():
        return False
    R = T[:3, :3]
    is_rotation = np.abs(R @ R.T - np.eye(3)).max() < _ORTHONORMAL and np.linalg.det(R) > 0.0
    return bool(is_rotation and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0)))


def require_pose(T: FloatArray, what: str) -> None:
    """Raise InputError if ``T`` (4, 4) is no finite rotation and translation within the bounds of a map."""
    if not is_rigid(T):
        raise InputError(f'{what}: no finite rotation and translation')
    if not np.abs(T[:3, 3]).max() < LARGEST_COORDINATE:
        raise InputError(f'{what}: {np.abs(T[:3, 3]).max():.3g} m away')


def require_numbers(values: FloatArray, shape: tuple[int, ...], what: str) -> None:
    """Raise InputError if ``values`` are no numpy array of real numbers in ``shape``."""
    if getattr(values, 'shape', None) != shape:
        found = f'is a {type(values).__name__} of shape {np.shape(values)}'
        raise InputError(f'{what} {found}, not a numpy array of shape {shape}')
    if values.dtype.kind not in _REAL_NUMBERS:
        raise InputError(f'{what} is an array of {values.dtype}, not of real numbers')


def require_side(size: object, what: str) -> None:
    """Raise InputError if ``size`` is no side of a marker [m]."""
    if not (isinstance(size, (int, float, np.floating)) and 0.0 < size <= LARGEST_SIDE):
        raise InputError(f'{what}: {size!r} is not a side in metres')


def require_image(image: Counts | Gray) -> None:
    """Raise InputError if ``image`` is no array (height, width) of 8 or 16 bits in the byte order of this computer."""
    if not isinstance(image, np.ndarray):
        raise InputError(f'{type(image).__name__} is no image: an array (height, width) of uint16 or uint8 is one')
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        raise InputError(f'frame of {image.dtype} with shape {image.shape} is not an 8 or 16 bit image')


def require_usable(camera: 'Camera') -> 'Camera':
    """``camera``, if it is plausible.

    Raises
    ------
    InputError
        An image size, camera matrix or distortion that no lens has.
    """
    K, longer = camera.K, max(camera.width, camera.height)
    if not all(_IMAGE_SIDES[0] <= side <= _IMAGE_SIDES[1] for side in (camera.width, camera.height)):
        raise InputError(f'calibration of an image of {camera.width}x{camera.height} pixels')
    for name, focal in (('fx', K[0, 0]), ('fy', K[1, 1])):
        if not _FOCAL_RANGE[0] * longer < focal < _FOCAL_RANGE[1] * longer:
            raise InputError(f'camera matrix with {name} {focal:.6g} for an image of {camera.width}x{camera.height}')
    for name, centre, size in (('cx', K[0, 2], camera.width), ('cy', K[1, 2], camera.height)):
        if not -_FARTHEST_CENTRE * size < centre < (1.0 + _FARTHEST_CENTRE) * size:
            raise InputError(f'camera matrix with {name} {centre:.6g} for an image of {camera.width}x{camera.height}')
    _require_invertible(camera)
    return camera


def doubt_of_resolution(camera: 'Camera') -> str:
    """Warning if the principal point is far from the middle of the image; else empty."""
    size = np.array([camera.width, camera.height])
    if np.abs(camera.principal_point / size - 0.5).max() < _DOUBTFUL_CENTRE:
        return ''
    u, v = camera.principal_point
    centre = f'principal point ({u:.0f}, {v:.0f}) in images of {camera.width}x{camera.height} pixels'
    return f'camera_info: {centre}: is the calibration of another resolution?'


def doubt_of_place(name: str, position: Sequence[float]) -> str:
    """Warning if a camera's ``position`` [m] in the IMU's frame was left at its default, which none has; else empty."""
    if any(position):
        return ''
    return f'{name} is [0, 0, 0], the default: poses are off by as much as the camera is away from the IMU'


def _require_invertible(camera: 'Camera') -> None:
    size = np.array([camera.width, camera.height], dtype=np.float64)
    half_way = 0.5 * np.array([[0, 0], [-1, -1], [1, -1], [1, 1], [-1, 1]])
    pixels = 0.5 * size * (1.0 + half_way)
    with np.errstate(all='ignore'):
        error = np.abs(camera.distort(camera.normalise(pixels)) - pixels).max()
    if not error < _ROUND_TRIP_PX:
        raise InputError(f'distortion {np.array2string(camera.D, precision=4)} that no lens has')
