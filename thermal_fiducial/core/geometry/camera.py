"""Camera models of ROS camera_info: plumb_bob, rational_polynomial and equidistant.

Pixels have their centres at integers, (0, 0) is the centre of the top-left one. Sources: OpenCV's
``projectPoints`` (plumb_bob, rational_polynomial, without the thin-prism and tilt terms) and
J. Kannala, S. Brandt, "A generic camera model and calibration method for conventional, wide-angle and
fish-eye lenses", 2006, as ``cv2.fisheye`` has it (equidistant).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from thermal_fiducial.core.geometry.distortion import EquidistantLens, LensModel, PolynomialLens
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray
from thermal_fiducial.errors import InputError

#: Number of coefficients that each model takes (shorter lists are filled up with zeros).
MODELS = {'plumb_bob': 5, 'rational_polynomial': 8, 'equidistant': 4}


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Parameters
    ----------
    width, height : image size [px]
    K : (3, 3) camera matrix [px]
    model : a key of :data:`MODELS`
    D : distortion coefficients in the order of camera_info

    Raises
    ------
    InputError
        Unknown model, wrong number of coefficients, or a K that can't be one (not finite, no focal length).
    """

    width: int
    height: int
    K: FloatArray
    model: str = 'plumb_bob'
    D: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        K = np.array(self.K, dtype=np.float64).reshape(3, 3)
        D = np.zeros(0) if self.D is None else np.array(self.D, dtype=np.float64).reshape(-1)
        if self.model not in MODELS:
            raise InputError(f'distortion model {self.model!r} is not one of {", ".join(MODELS)}')
        if len(D) > MODELS[self.model] and np.any(D[MODELS[self.model] :]):
            raise InputError(f'{self.model} takes {MODELS[self.model]} coefficients, not {len(D)}')
        if not (np.all(np.isfinite(K)) and np.all(np.isfinite(D)) and K[0, 0] > 0 and K[1, 1] > 0):
            raise InputError('camera matrix without a focal length: the camera is not calibrated')
        if self.width <= 0 or self.height <= 0:
            raise InputError(f'image size {self.width}x{self.height} in the calibration')
        filled = np.zeros(MODELS[self.model])
        filled[: min(len(D), len(filled))] = D[: len(filled)]
        object.__setattr__(self, 'K', K)
        object.__setattr__(self, 'D', filled)

    @cached_property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths [px]."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    def matches(self, other: 'Camera') -> bool:
        """Whether ``other`` is the same calibration."""
        return (
            (self.width, self.height, self.model) == (other.width, other.height, other.model)
            and np.array_equal(self.K, other.K)
            and np.array_equal(self.D, other.D)
        )

    def project(self, points: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3) in the camera frame [m].

        A point that the lens cannot show (behind a perspective camera, or beyond the radius where the
        model folds back) gives NaN.
        """
        points = np.asarray(points, dtype=np.float64)
        x, visible = self._normalised(points)
        uv = self._to_pixels(self._lens.distort(x))
        return np.where(visible[..., None], uv, np.nan)

    def project_jacobian(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pixels (..., 2) of points (..., 3), and their derivative (..., 2, 3) [px/m]."""
        points = np.asarray(points, dtype=np.float64)
        x, visible = self._normalised(points)
        distorted, dd_dx = self._lens.linearise(x)
        uv = np.where(visible[..., None], self._to_pixels(distorted), np.nan)
        inverse_z = 1.0 / points[..., 2]
        dx_dp = np.zeros((*points.shape[:-1], 2, 3))
        dx_dp[..., 0, 0] = dx_dp[..., 1, 1] = inverse_z
        dx_dp[..., :, 2] = -x * inverse_z[..., None]
        return uv, self.K[:2, :2] @ dd_dx @ dx_dp

    def distort(self, normalised: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) of normalised image coordinates x/z, y/z (..., 2)."""
        return self._to_pixels(self._lens.distort(np.asarray(normalised, dtype=np.float64)))

    def distort_linearised(self, normalised: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """:meth:`distort`, and its derivative (..., 2, 2) [px]."""
        x, J = self._lens.linearise(np.asarray(normalised, dtype=np.float64))
        return self._to_pixels(x), self.K[:2, :2] @ J

    def normalise(self, uv: npt.ArrayLike) -> FloatArray:
        """Normalised image coordinates x/z, y/z (..., 2) of pixels (..., 2): the inverse of :meth:`distort`.

        Newton's method on the distortion, which at the border of a fisheye converges where OpenCV's fixed-point
        iteration does not; in the angle alone where the model is purely radial.
        """
        uv = np.asarray(uv, dtype=np.float64)
        return self._lens.undistort((uv - self.K[:2, 2]) @ self._inverse_focal.T)

    def rays(self, uv: npt.ArrayLike) -> FloatArray:
        """Unit viewing directions (..., 3) of pixels (..., 2)."""
        x = self.normalise(uv)
        ray = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def contains(self, uv: npt.ArrayLike, margin_px: float = 0.0) -> BoolArray:
        """Whether pixels (..., 2) lie in the image, ``margin_px`` away from its border; False for NaN."""
        uv = np.asarray(uv, dtype=np.float64)
        last = self._last_pixel - margin_px
        return np.asarray(((uv >= margin_px) & (uv <= last)).all(axis=-1))

    def _to_pixels(self, x: FloatArray) -> FloatArray:
        # One product of matrices costs less than one for each row of points.
        return np.asarray((x.reshape(-1, 2) @ self.K[:2, :2].T + self.K[:2, 2]).reshape(x.shape))

    def _normalised(self, points: FloatArray) -> tuple[FloatArray, BoolArray]:
        z = points[..., 2]
        in_front = z > 1e-9
        x = points[..., :2] / np.where(in_front, z, 1.0)[..., None]
        return x, np.asarray(in_front & ((x * x).sum(axis=-1) < self._fold_radius**2))

    @cached_property
    def _fold_radius(self) -> float:
        """Normalised radius up to which the distorted radius grows: beyond it two points share a pixel."""
        r = np.linspace(0.0, 12.0, 4801)
        falling = np.flatnonzero(np.diff(self._lens.radius(r)) <= 0.0)
        return float(r[falling[0]]) if len(falling) else np.inf

    @cached_property
    def _lens(self) -> LensModel:
        return EquidistantLens(self.D) if self.model == 'equidistant' else PolynomialLens(self.D)

    @cached_property
    def _last_pixel(self) -> FloatArray:
        return np.array([self.width - 1.0, self.height - 1.0])

    @cached_property
    def _inverse_focal(self) -> FloatArray:
        """(2, 2) [1/px]."""
        return np.asarray(np.linalg.inv(self.K[:2, :2]))


@dataclass(frozen=True, slots=True)
class ImagePoints:
    """Points of an image in both coordinates.

    Parameters
    ----------
    px : (..., 2)
    x : (..., 2) normalised
    J : (..., 2, 2) derivative of pixels by normalised coordinates
    inverse : (..., 2, 2) that of normalised coordinates by pixels; both also for points some pixels away
    """

    px: FloatArray
    x: FloatArray
    J: FloatArray
    inverse: FloatArray

    @staticmethod
    def at(px: FloatArray, camera: Camera) -> 'ImagePoints':
        """Those at pixels (..., 2)."""
        return ImagePoints.seen_at(camera.normalise(px), camera)

    @staticmethod
    def seen_at(x: FloatArray, camera: Camera) -> 'ImagePoints':
        """Those at normalised coordinates (..., 2)."""
        px, J = camera.distort_linearised(x)
        return ImagePoints(px, x, J, inverse_2x2(J))

    def moved(self, shift_px: FloatArray, camera: Camera) -> 'ImagePoints':
        """Those some pixels (..., 2) away: undistorting them anew would cost more than it is worth."""
        x = self.x + (self.inverse @ shift_px[..., None])[..., 0]
        return ImagePoints(camera.distort(x), x, self.J, self.inverse)

    def at_pixels(self, px: FloatArray) -> 'ImagePoints':
        """Those at pixels (..., 2) that are so near that what is left of the distortion's curvature is nothing."""
        return ImagePoints(px, self.x + (self.inverse @ (px - self.px)[..., None])[..., 0], self.J, self.inverse)

    def only(self, keep: BoolArray | IntArray) -> 'ImagePoints':
        """Those at the places ``keep`` of the first axis."""
        return ImagePoints(self.px[keep], self.x[keep], self.J[keep], self.inverse[keep])


def inverse_2x2(J: FloatArray) -> FloatArray:
    """Inverses of matrices (..., 2, 2), not finite where they are singular."""
    a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
    inverse = np.empty_like(J)
    inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 0], inverse[..., 1, 1] = d, -b, -c, a
    inverse /= (a * d - b * c)[..., None, None]
    return inverse
