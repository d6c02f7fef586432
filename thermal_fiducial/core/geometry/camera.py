"""Camera models of ROS camera_info: plumb_bob, rational_polynomial and equidistant.

Pixels have their centres at integers, (0, 0) is the centre of the top-left one. Lenses are those of OpenCV, with its
derivatives: ``projectPoints`` (plumb_bob, rational_polynomial, without the thin-prism and tilt terms) and ``fisheye``
(equidistant; J. Kannala, S. Brandt, "A generic camera model and calibration method for conventional, wide-angle and
fish-eye lenses", 2006).
"""

from dataclasses import dataclass
from functools import cached_property
import math

import cv2
import numpy as np
from numpy.polynomial import Polynomial
import numpy.typing as npt

from thermal_fiducial.core.geometry.plausibility import require_image
from thermal_fiducial.core.types import BoolArray, Counts, FloatArray, Gray, Stacked, TINY
from thermal_fiducial.errors import InputError

#: Coefficients of each model, in the order of camera_info (shorter lists are filled up with zeros).
MODELS = {
    'plumb_bob': ('k1', 'k2', 'p1', 'p2', 'k3'),
    'rational_polynomial': ('k1', 'k2', 'p1', 'p2', 'k3', 'k4', 'k5', 'k6'),
    'equidistant': ('k1', 'k2', 'k3', 'k4'),
}
# Other tools' names of the models, which drivers copy from their files.
_SYNONYMS = {'fisheye': 'equidistant', 'radtan': 'plumb_bob', 'radial-tangential': 'plumb_bob'}
# Newton's iteration doubles the digits: after a step this small nothing is left, and twelve are enough half a degree
# from the hemisphere of a fisheye lens.
_STEPS, _SHORT = 12, 1e-6
# Widest angle off the optical axis at which markers are looked for: normalised coordinates end at a right angle.
_WIDEST = math.radians(85.0)
# Least length of a step of the angle in the image, as a share of its length in the middle: less is left where a lens
# folds back, or nearly does; number of angles that are looked at.
_LEAST_STEP, _ANGLES = 0.2, 171
# A last coefficient below this has no root at any angle that a lens can have, but makes the others' overflow.
_NO_COEFFICIENT = 1e-15
# Coefficients of the derivative of angle + k1 angle^3 + k2 angle^5 ... with respect to the angle.
_RISE = np.arange(1, 10, 2)
_EYE, _STILL = np.eye(3), np.zeros(3)
# Focal lengths of square pixels differ by less than this share.
_SQUARE_PIXELS = 0.01


def _numbers(what: str, values: npt.ArrayLike) -> FloatArray:
    """``values`` as an array; InputError if they are no real numbers."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f'{what} that is not of real numbers') from None


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera.

    Parameters
    ----------
    width, height : image size [px]
    K : (3, 3) camera matrix [px]
    model : a key of :data:`MODELS`, or another tool's name of it
    D : distortion coefficients in the order of camera_info

    Raises
    ------
    InputError
        Unknown model, wrong number of coefficients, no image size, or a K that can't be one (of another form, not
        finite, no focal length).
    """

    width: int
    height: int
    K: FloatArray
    model: str = 'plumb_bob'
    D: FloatArray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        K, D = _numbers('camera matrix', self.K), _numbers('distortion', [] if self.D is None else self.D).reshape(-1)
        model = _SYNONYMS.get(self.model, self.model)
        if model not in MODELS:
            raise InputError(f'distortion model {self.model!r} is not one of {", ".join(MODELS)}')
        count = len(MODELS[model])
        if D[count:].any():
            raise InputError(f'{model} takes {count} coefficients, not {len(D)}')
        if K.size != 9:
            raise InputError(f'camera matrix of shape {K.shape}, not (3, 3)')
        K = K.reshape(3, 3)
        if not (np.all(np.isfinite(K)) and np.all(np.isfinite(D)) and K[0, 0] > 0 and K[1, 1] > 0):
            raise InputError('camera matrix without a focal length: the camera is not calibrated')
        if K[1, 0] != 0.0 or not np.array_equal(K[2], (0.0, 0.0, 1.0)) or not abs(K[0, 1]) < K[0, 0]:
            raise InputError('camera matrix that is not of the form fx s cx, 0 fy cy, 0 0 1')
        if not all(isinstance(side, (int, np.integer)) and side > 0 for side in (self.width, self.height)):
            raise InputError(f'image size {self.width}x{self.height} in the calibration')
        filled = np.zeros(count)
        filled[: len(D)] = D[:count]
        object.__setattr__(self, 'K', K)
        object.__setattr__(self, 'model', model)
        object.__setattr__(self, 'D', filled)

    @cached_property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths [px]."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    @cached_property
    def aspect_error(self) -> FloatArray:
        """Half of what the focal lengths differ by, as shares (2,) of them: an error, as pixels are square."""
        along, across = self.K[0, 0], self.K[1, 1]
        share = (along - across) / (along + across)
        return np.asarray(share * np.array([1.0, -1.0]) * (2.0 * abs(share) < _SQUARE_PIXELS))

    @property
    def principal_point(self) -> FloatArray:
        """(2,) [px]."""
        return self.K[:2, 2]

    def require_size_of(self, image: Counts | Gray) -> None:
        """Raise InputError if ``image`` (H, W) is none of 8 or 16 bits, or of another size than the calibration."""
        require_image(image)
        height, width = image.shape
        if (height, width) != (self.height, self.width):
            raise InputError(f'image of {width}x{height}, camera_info of {self.width}x{self.height} pixels')

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
        x, _, visible = self._in_front(points)
        return np.where(visible, self.distort(x), np.nan)

    def project_jacobian(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pixels (..., 2) of points (..., 3), and their derivative (..., 2, 3) [px/m]."""
        x, depth, visible = self._in_front(points)
        uv, by_x = self.distort_linearised(x)
        by_depth = -by_x @ x[..., None]
        by_point = np.concatenate([by_x, by_depth], axis=-1) / depth[..., None]
        return np.where(visible, uv, np.nan), by_point

    def _in_front(self, points: npt.ArrayLike) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Normalised coordinates (..., 2) of points, their depths and which the lens can show, (..., 1) both."""
        points = np.asarray(points, dtype=np.float64)
        depth = points[..., 2:]
        in_front = depth > TINY
        depth = np.where(in_front, depth, 1.0)
        x = points[..., :2] / depth
        a, b = x[..., :1], x[..., 1:]
        return x, depth, in_front & (a * a + b * b < self._fold_radius**2)

    def distort(self, normalised: npt.ArrayLike) -> FloatArray:
        """Pixels (..., 2) of normalised image coordinates x/z, y/z (..., 2)."""
        return self.distort_linearised(normalised)[0]

    def distort_linearised(self, normalised: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """:meth:`distort`, and its derivative (..., 2, 2) [px]."""
        x = np.asarray(normalised, dtype=np.float64)
        if not x.size:
            return x, np.zeros((*x.shape, 2))
        uv, J = self._distorted(x)
        # At depth 1 its derivative by a translation of the camera is the one wanted.
        J = J[:, 11:13] if self.model == 'equidistant' else J[:, 3:5]
        # One product of matrices costs less than one for each point.
        by_x = J.reshape(-1, 4) @ self._focal_lengths_by_rows
        return uv.reshape(x.shape), by_x.reshape(*x.shape, 2)

    def distort_by_coefficients(self, normalised: FloatArray) -> tuple[FloatArray, FloatArray]:
        """:meth:`distort` (N, 2) of (N, 2), and its derivative (N, 2, D) by the distortion coefficients [px]."""
        uv, J = self._distorted(normalised)
        first = 4 if self.model == 'equidistant' else 10
        return uv, self.K[:2, :2] @ J[:, first : first + len(self.D)].reshape(len(uv), 2, -1)

    def _distorted(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (N, 2) of N normalised coordinates, and OpenCV's derivative (2 N, K) of them before K is applied."""
        points = np.empty((x.size // 2, 1, 3))
        points[:, 0, :2], points[:, 0, 2] = x.reshape(-1, 2), 1.0
        # OpenCV leaves a skew of K out.
        project = cv2.fisheye.projectPoints if self.model == 'equidistant' else cv2.projectPoints
        distorted, J = project(points, _STILL, _STILL, _EYE, self.D)
        return distorted.reshape(-1, 2) @ self.K[:2, :2].T + self.K[:2, 2], np.asarray(J, np.float64)

    def normalise(self, uv: npt.ArrayLike) -> FloatArray:
        """Normalised image coordinates x/z, y/z (..., 2) of pixels (..., 2): the inverse of :meth:`distort`."""
        return self.normalise_linearised(uv)[0]

    def normalise_linearised(self, uv: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """:meth:`normalise`, and the derivative (..., 2, 2) of :meth:`distort` there, to a millionth.

        Newton's method converges at the border of a lens, where OpenCV's iterations do not: that of ``fisheye`` ends at
        a distorted radius of a right angle, which lenses reach at smaller angles. Pixels that show what is no longer in
        front of the camera have no such coordinates; what they give is huge or not finite.
        """
        uv = np.asarray(uv, dtype=np.float64)
        x = (uv - self.K[:2, 2]) @ self._inverse_focal.T
        for _ in range(_STEPS):
            reached, J = self.distort_linearised(x)
            with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
                step = (inverse_2x2(J) @ (uv - reached)[..., None])[..., 0]
            x = x + step
            if np.abs(step).max(initial=0.0) < _SHORT:
                break
        return np.asarray(x), J

    def rays(self, uv: npt.ArrayLike) -> FloatArray:
        """Unit viewing directions (..., 3) of pixels (..., 2); not finite where the lens shows nothing."""
        x = self.normalise(uv)
        ray = np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)
        with np.errstate(invalid='ignore'):
            return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def readout_shares(self, rows: FloatArray) -> FloatArray:
        """Shares (...) of the readout of a rolling shutter at which ``rows`` (...) [px] are sampled.

        -1/2 in the first row and 1/2 in the last: the stamp is that of the middle one.
        """
        return rows / (self.height - 1) - 0.5

    def contains(self, uv: npt.ArrayLike, margin_px: float = 0.0) -> BoolArray:
        """Whether pixels (..., 2) lie in the image, ``margin_px`` away from its border; False for NaN."""
        uv = np.asarray(uv, dtype=np.float64)
        last = self._last_pixel - margin_px
        return np.asarray(((uv >= margin_px) & (uv <= last)).all(axis=-1))

    def shows(self, uv: npt.ArrayLike) -> BoolArray:
        """Whether pixels (..., 2) show what is less than 85 degrees off the axis, before the lens nearly folds back."""
        off_axis = np.asarray(uv, dtype=np.float64) - self.K[:2, 2]
        if self._shown_px == math.inf:
            return np.ones(off_axis.shape[:-1], dtype=np.bool_)
        return np.asarray(np.hypot(off_axis[..., 0], off_axis[..., 1]) < self._shown_px)

    @cached_property
    def _shown_px(self) -> float:
        """Radius [px] around the principal point that the lens shows; inf if that is all of the image."""
        shown = float(self._radii_px(np.array([math.tan(self._steep_angle)]))[0])
        corners = np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]) * self._last_pixel
        return shown if np.linalg.norm(corners - self.principal_point, axis=1).max() > shown else math.inf

    @cached_property
    def _steep_angle(self) -> float:
        """Angle off the axis [rad] up to which steps of the angle are long enough in the image."""
        angles = np.linspace(0.0, _WIDEST, _ANGLES)
        short = np.diff(self._radii_px(np.tan(angles))) < _LEAST_STEP * self.focal_px * angles[1]
        return float(angles[np.argmax(short)]) if short.any() else _WIDEST

    def _radii_px(self, radii: FloatArray) -> FloatArray:
        """Distances (R,) [px] from the principal point of normalised radii (R,), the least of four directions."""
        around = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
        at = self.distort(radii[:, None, None] * around)
        return np.asarray(np.linalg.norm(at - self.principal_point, axis=-1).min(axis=1))

    @cached_property
    def _fold_radius(self) -> float:
        """Normalised radius up to which the distorted radius grows: beyond it two points share a pixel."""
        if self.model == 'equidistant':
            angle = math.sqrt(_least_root(Polynomial(_RISE * [1.0, *self.D])))
            return math.tan(angle) if angle < 0.5 * math.pi else math.inf
        k1, k2, _, _, k3, k4, k5, k6 = [*self.D, 0.0, 0.0, 0.0][:8]
        above, below, s = Polynomial((1.0, k1, k2, k3)), Polynomial((1.0, k4, k5, k6)), Polynomial((0.0, 1.0))
        # Numerator of the derivative of r above(r^2) / below(r^2), and the pole.
        with np.errstate(over='ignore', invalid='ignore'):
            rise = above * below + 2.0 * s * (above.deriv() * below - above * below.deriv())
        return math.sqrt(min(_least_root(rise), _least_root(below)))

    @cached_property
    def _last_pixel(self) -> FloatArray:
        return np.array([self.width - 1.0, self.height - 1.0])

    @cached_property
    def _focal_lengths_by_rows(self) -> FloatArray:
        """(4, 4) by which derivatives (2, 2) of distorted coordinates, written in rows, become those of pixels."""
        return np.asarray(np.kron(self.K[:2, :2].T, np.eye(2)))

    @cached_property
    def _inverse_focal(self) -> FloatArray:
        """(2, 2) [1/px]."""
        return np.asarray(np.linalg.inv(self.K[:2, :2]))


@dataclass(frozen=True, slots=True)
class ImagePoints(Stacked):
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
        x, J = camera.normalise_linearised(px)
        return ImagePoints(px, x, J, inverse_2x2(J))

    @staticmethod
    def seen_at(x: FloatArray, camera: Camera) -> 'ImagePoints':
        """Those at normalised coordinates (..., 2)."""
        px, J = camera.distort_linearised(x)
        return ImagePoints(px, x, J, inverse_2x2(J))

    def at_pixels(self, px: FloatArray) -> 'ImagePoints':
        """Points at pixels (..., 2) so near that the curvature of the distortion is negligible."""
        return ImagePoints(px, self.x + (self.inverse @ (px - self.px)[..., None])[..., 0], self.J, self.inverse)


def by_other_calibration(px: FloatArray, before: Camera, now: Camera) -> tuple[FloatArray, FloatArray]:
    """Pixels (..., 2) ``now`` of directions by the calibration of ``before``, and their derivatives (..., 2, 2)."""
    at = ImagePoints.at(px, before)
    uv, J = now.distort_linearised(at.x)
    return uv, J @ at.inverse


def _least_root(polynomial: Polynomial) -> float:
    """Smallest positive real root; inf if there is none."""
    if not np.isfinite(polynomial.coef).all():
        return math.inf
    roots = polynomial.trim(_NO_COEFFICIENT).roots()
    real = roots.real[np.abs(roots.imag) < TINY * (1.0 + np.abs(roots.real))]
    return float(real[real > 0.0].min(initial=np.inf))


def inverse_2x2(J: FloatArray) -> FloatArray:
    """Inverses of matrices (..., 2, 2), not finite where they are singular."""
    a, b, c, d = J[..., 0, 0], J[..., 0, 1], J[..., 1, 0], J[..., 1, 1]
    inverse = np.empty_like(J)
    inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 0], inverse[..., 1, 1] = d, -b, -c, a
    inverse /= (a * d - b * c)[..., None, None]
    return inverse
