"""Validity of a lens model up to the image corners, and its error over the image."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from thermal_fiducial.calibration.lens_parameters import by_parameters
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.types import BoolArray, FloatArray

# A model has to go on growing to this many times the distance of the farthest corner.
_BEYOND_CORNER = 1.05
# Angles from the axis [rad] and directions around it that are looked at.
_ANGLES, _DIRECTIONS = np.linspace(0.0, 1.5, 301), 16
# Places across and down the image where its error is worked out; the corners are among them.
_PLACES = (17, 13)


def reaches_corners(camera: Camera) -> bool:
    """Whether the distance from the centre grows with the angle all the way to the image's corners."""
    around = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    ray = np.stack([np.cos(around), np.sin(around)], axis=-1)
    uv = camera.distort(np.tan(_ANGLES)[:, None, None] * ray)
    distance = np.linalg.norm(uv - camera.principal_point, axis=-1)
    last = np.array([camera.width, camera.height]) - 1.0
    needed = _BEYOND_CORNER * float(np.linalg.norm(np.maximum(camera.principal_point, last - camera.principal_point)))
    inside = np.maximum.accumulate(distance, axis=0)[:-1] < needed
    growing = np.diff(distance, axis=0) > 0.0
    return bool(np.all(growing | ~inside) and np.all(distance.max(axis=0) >= needed))


@dataclass(frozen=True)
class ImageError:
    """How far off a calibration may be over the image.

    Parameters
    ----------
    u, v : (A,), (B,) places [px]
    sigma_px : (B, A) standard deviation of a pixel (length of the 2-vector), after the best-fitting rotation
    covered : (B, A) whether views reach there
    covered_share : of the image's area
    """

    u: FloatArray
    v: FloatArray
    sigma_px: FloatArray
    covered: BoolArray
    covered_share: float

    @property
    def inside_px(self) -> float:
        """Largest standard deviation where the views reach."""
        return float(self.sigma_px[self.covered].max(initial=0.0))

    @property
    def outside_px(self) -> float:
        """Largest standard deviation where they do not; 0 where they reach everywhere."""
        return float(self.sigma_px[~self.covered].max(initial=0.0))

    def sentence(self) -> str:
        """Coverage and errors in words."""
        text = f'the views cover {100.0 * self.covered_share:.0f} % of the image, where the lens is known to '
        text += f'{self.inside_px:.2g} px'
        return (
            text
            + (f'; outside it may be off by {self.outside_px:.2g} px' if self.outside_px > 0.0 else '')
            + ' (1 sigma)'
        )


def image_error(camera: Camera, covariance: FloatArray, sightings: Sequence[Sighting]) -> ImageError:
    """Error of a pixel's place, over the image, from the covariance of a :class:`Calibration`.

    A rotation of the whole camera is not a lens error: the one that fits best where the views are is removed.
    """
    mask = _covered(sightings, camera.width, camera.height)
    u, v = np.linspace(0, camera.width - 1, _PLACES[0]), np.linspace(0, camera.height - 1, _PLACES[1])
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    at = np.rint(uv).astype(np.int64)
    covered = mask[at[:, 1], at[:, 0]]
    points = np.column_stack([camera.normalise(uv), np.ones(len(uv))])
    J = by_parameters(camera, points)
    _, by_point = camera.project_jacobian(points)
    turned = -by_point @ se3.skew(points)
    reached = covered if covered.any() else np.ones(len(uv), dtype=np.bool_)
    A = turned[reached].reshape(-1, 3)
    J = J - turned @ np.linalg.lstsq(A, J[reached].reshape(-1, J.shape[2]), rcond=None)[0]
    variance = np.einsum('nik,kl,nil->n', J, covariance, J)
    shape = (len(v), len(u))
    sigma = np.sqrt(np.nan_to_num(variance, nan=np.inf).reshape(shape))
    return ImageError(u, v, sigma, covered.reshape(shape), float(mask.mean()))


def _covered(sightings: Sequence[Sighting], width: int, height: int) -> BoolArray:
    """Pixels (height, width) that lie within the points of a view."""
    mask = np.zeros((height, width), np.uint8)
    for sighting in sightings:
        hull = cv2.convexHull(np.rint(sighting.pixels).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 1)
    return np.asarray(mask > 0)
