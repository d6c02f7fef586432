"""Intrinsics from sightings of a board: fit of one lens model, outlier views, covariance.

Formulation of Z. Zhang, "A flexible new technique for camera calibration", 2000; OpenCV only gives the initial values.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import cv2
import numpy as np

from thermal_fiducial.calibration.board_shape import BoardShape
from thermal_fiducial.calibration.lens_fit import LensFit
from thermal_fiducial.calibration.lens_parameters import camera_parameters, MATRIX
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera, MODELS
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.errors import InputError

#: Fewest views: a camera can still be fitted without one of them.
LEAST_VIEWS = 6
# A view whose rms is this many times the median view's was moving, half hidden or wrongly numbered.
_OUTLIER_RATIO = 2.5
_NAMES = ('fx', 'fy', 'cx', 'cy')


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Parameters
    ----------
    camera : with the estimated intrinsics
    free : coefficients that were estimated; the others are zero
    covariance : (4 + D, 4 + D) of fx fy cx cy and the distortion coefficients, what those at zero may be included; two
        more for the decentring of models without tangential coefficients
    T_camera_board : (V, 4, 4)
    residuals : V arrays (N, 2) measured minus predicted [px]
    views : (V,) indices of the sightings that were used
    dropped : indices of the sightings rejected as outliers
    board : its points
    held_out_px : rms error of held-out views, and its standard error
    """

    camera: Camera
    free: tuple[int, ...]
    covariance: FloatArray
    T_camera_board: FloatArray
    residuals: list[FloatArray]
    views: IntArray
    dropped: list[int]
    board: BoardShape
    held_out_px: tuple[float, float] = (np.nan, np.nan)

    @property
    def rms_px(self) -> float:
        """Over all points, of the length of the 2-vector."""
        every = np.concatenate(self.residuals)
        return float(np.sqrt(np.mean(np.sum(every**2, axis=1))))

    @property
    def sigmas(self) -> FloatArray:
        """Standard deviations of fx fy cx cy and the distortion coefficients."""
        return np.asarray(np.sqrt(np.diag(self.covariance))[: MATRIX + len(self.camera.D)])

    def parameter_rows(self) -> list[tuple[str, float, float]]:
        """Name, value and standard deviation of every intrinsic parameter."""
        names = (*_NAMES, *MODELS[self.camera.model])
        values = camera_parameters(self.camera).tolist()
        return list(zip(names, values, self.sigmas.tolist(), strict=True))

    def lens_name(self) -> str:
        """Model and the coefficients that were estimated, e.g. ``plumb_bob (k1, k2)``."""
        names = [MODELS[self.camera.model][index] for index in self.free]
        return f'{self.camera.model} ({", ".join(names) or "no coefficient"})'


def calibrate(
    sightings: Sequence[Sighting],
    width: int,
    height: int,
    model: str,
    *,
    radius: float = 0.0,
    focal_px: float = 600.0,
    free: Sequence[int] | None = None,
) -> Calibration:
    """Fit one model; views that fit far worse than the others are dropped and the rest fitted again.

    Parameters
    ----------
    radius : of the board's circles [m]; their observed centroids are compared with centroids, not with centres
    focal_px : rough focal length to start from [px]
    free : indices of the coefficients to estimate, the others being zero; None: all

    Raises
    ------
    InputError
        Too few views, or views from which no camera follows.
    """
    if len(sightings) < LEAST_VIEWS:
        raise InputError(f'{number_of(len(sightings), "view")} of the board: a calibration needs {LEAST_VIEWS} or more')
    camera = _start(sightings, width, height, model, focal_px)
    posed, poses = list[int](), list[FloatArray]()
    for index, sighting in enumerate(sightings):
        # A view that is numbered at random may have no pose at all.
        with suppress(InputError):
            poses.append(board_pose(sighting, camera))
            posed.append(index)
    if len(posed) < LEAST_VIEWS:
        raise InputError(f'{number_of(len(sightings) - len(posed), "view")} from which no pose of the board follows')
    fit = calibrate_from([sightings[index] for index in posed], camera, np.stack(poses), radius=radius, free=free)
    views = np.array(posed)[fit.views]
    return replace(fit, views=views, dropped=sorted(set(range(len(sightings))) - set(views.tolist())))


def calibrate_from(
    sightings: Sequence[Sighting],
    camera: Camera,
    T: FloatArray,
    *,
    radius: float = 0.0,
    free: Sequence[int] | None = None,
    drop: bool = True,
    board_std: float = 0.0,
) -> Calibration:
    """:func:`calibrate` from a ``camera`` and poses ``T`` (V, 4, 4) near the solution.

    Parameters
    ----------
    drop : whether outlying views are dropped
    board_std : standard deviation of each coordinate of the board's points [m]; 0: they are as described
    """
    used = np.arange(len(sightings))
    while True:
        fit = LensFit([sightings[index] for index in used.tolist()], camera, radius, free, board_std=board_std)
        state = fit.solve(T)
        residuals = fit.residuals(state)
        rms = np.array([np.sqrt(np.mean(residual**2)) for residual in residuals])
        keep = rms <= _OUTLIER_RATIO * np.median(rms)
        if not drop or np.all(keep) or np.sum(keep) < LEAST_VIEWS:
            break
        camera, T, used = state.camera, state.T[keep], used[keep]
    dropped = sorted(set(range(len(sightings))) - set(used.tolist()))
    chosen = tuple(range(len(camera.D)) if free is None else sorted(free))
    covariance, board = fit.covariance(state), BoardShape(fit.described, state.places)
    return Calibration(state.camera, chosen, covariance, state.T, residuals, used, dropped, board)


def board_pose(sighting: Sighting, camera: Camera) -> FloatArray:
    """T_camera_board (4, 4) by OpenCV on undistorted points."""
    normalised = camera.normalise(sighting.pixels)
    # ITERATIVE begins with a linear fit of 12 numbers, which a board that is nearly flat does not determine.
    found, rotation, translation = cv2.solvePnP(
        sighting.points, normalised, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_SQPNP
    )
    T = se3.transform(se3.so3_exp(rotation.reshape(3)), translation.reshape(3))
    # All points: the origin of a marker map may lie behind the camera.
    if not found or not np.all(se3.apply(T, sighting.points)[:, 2] > 0.0):
        raise InputError('a view from which no pose of the board follows')
    return T


def _start(sightings: Sequence[Sighting], width: int, height: int, model: str, focal_px: float) -> Camera:
    """Focal length by OpenCV without distortion; the least squares find the rest from there."""
    K = np.array([[focal_px, 0.0, 0.5 * (width - 1)], [0.0, focal_px, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    points = [sighting.points.astype(np.float32) for sighting in sightings]
    pixels = [sighting.pixels.astype(np.float32) for sighting in sightings]
    threads = cv2.getNumThreads()
    # Threads add up the views in the order in which they finish: two runs differed in the last digits of their files.
    cv2.setNumThreads(1)
    try:
        _, K, _, _, _ = cv2.calibrateCamera(points, pixels, (width, height), K, np.zeros(5), flags=flags)
    except cv2.error as error:
        raise InputError(f'views from which no camera follows: {error.err}') from None
    finally:
        cv2.setNumThreads(threads)
    if not 0.1 * width < K[0, 0] < 20.0 * width:
        K[0, 0] = K[1, 1] = focal_px
    return Camera(width, height, np.asarray(K, dtype=np.float64), model)
