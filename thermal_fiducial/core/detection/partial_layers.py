"""The frame as partially visible markers are fitted to it: at lower resolution, or freed of its lag tail."""

import math

import cv2
import numpy as np

from thermal_fiducial.core.detection.corners.grid import Layer
from thermal_fiducial.core.detection.frame import expected_displacement, Frame, lag_tail, Places
from thermal_fiducial.core.detection.lag import LAG_TAIL_AGE, markers_deblurred, REMAINING, SPREAD
from thermal_fiducial.core.detection.refining import sides_px, worth_deblurring
from thermal_fiducial.core.detection.twist import interaction
from thermal_fiducial.core.geometry.camera import Camera, ImagePoints
from thermal_fiducial.core.types import FloatArray

# Depth of points that are no longer in front of the camera [m].
_LEAST_DEPTH = 1e-3


def plain_layer(frame: Frame, window: FloatArray, blur_px: float, factor: int) -> Layer:
    """The frame at one resolution in ``factor``, as blurred as it is round a ``window`` (4, 3) in the camera."""
    camera = _coarser(frame.camera, factor)
    image = frame.image
    if factor > 1:
        cropped = image[: camera.height * factor, : camera.width * factor]
        image = np.asarray(cv2.resize(cropped, (camera.width, camera.height), interpolation=cv2.INTER_AREA))
    blur = math.hypot(blur_px / factor, math.sqrt((1.0 - 1.0 / factor**2) / 12.0))

    def displacement(points: FloatArray) -> FloatArray:
        return _displaced(frame, points, 0.0) / factor

    return Layer(image, camera, displacement, blur, _lag_blur(frame, window) / factor)


def deblurred_layer(frame: Frame, window: FloatArray, contrast: float, blur_px: float, cells: int) -> Layer:
    """The frame as it is; without old lag tails round the window (4, 3), where that is worth its noise."""
    places, twist = places_of_points(window, frame.camera), frame.twist
    mean = _lag_blur(frame, window)
    cnr = np.array([contrast / frame.noise])
    cell = sides_px(places.at.px) / cells
    if twist is None or not worth_deblurring(np.array([mean @ mean]), cell, cells, cnr)[0]:
        return plain_layer(frame, window, blur_px, 1)
    shown = places.at.px + _displaced(frame, window, 1.0 - REMAINING)
    image = markers_deblurred(frame.image, shown, lag_tail(places, twist, frame))

    def displacement(points: FloatArray) -> FloatArray:
        return _displaced(frame, points, 1.0 - REMAINING)

    return Layer(image, frame.camera, displacement, blur_px, SPREAD * mean)


def _displaced(frame: Frame, points: FloatArray, removed: float) -> FloatArray:
    """By how much points (P, 3) in the camera appear displaced (P, 2) [px], such a share of lag tails taken out."""
    twist, lag = frame.twist, frame.lag
    if twist is None:
        return np.zeros((len(points), 2))
    depth = np.maximum(points[:, 2], _LEAST_DEPTH)
    x = points[:, :2] / depth[:, None]
    back = -lag * (twist.ago(lag) - removed * twist.ago(LAG_TAIL_AGE * lag))
    shift = (frame.camera.distort_linearised(x)[1] @ (interaction(x, depth) @ back)[..., None])[..., 0]
    if frame.readout == 0.0:
        return np.asarray(shift)
    return np.asarray(shift + expected_displacement(places_of_points(points, frame.camera), twist, frame)[0])


def _lag_blur(frame: Frame, window: FloatArray) -> FloatArray:
    """Mean motion blur (2,) [px] of what is seen of a marker, whose window is (4, 3) in the camera."""
    if frame.twist is None:
        return np.zeros(2)
    return np.asarray(places_of_points(window, frame.camera).lag_blur(frame.twist, frame.lag)[0].mean(axis=0))


def _coarser(camera: Camera, factor: int) -> Camera:
    """The camera of an image of which each pixel is the mean of so many squared."""
    if factor == 1:
        return camera
    K = camera.K.copy()
    K[:2, 2] += 0.5 - 0.5 * factor
    K[:2] /= factor
    return Camera(camera.width // factor, camera.height // factor, K, camera.model, camera.D)


def places_of_points(points: FloatArray, camera: Camera) -> Places:
    """Places (1, P) of points (P, 3) in the camera."""
    depth = np.maximum(points[None, :, 2], _LEAST_DEPTH)
    return Places.of(ImagePoints.seen_at(points[None, :, :2] / depth[..., None], camera), depth)
