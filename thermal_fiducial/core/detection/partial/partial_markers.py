"""Partially visible known markers: those that the border of the image cuts, or that fill the image.

The visible cells must correlate with the predicted marker. The pose is fitted to all visible edges between cells,
inside the marker and along its sides, most of which must agree with it. The corners follow from the pose, those outside
the image included.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corners.corner_errors import (
    OF_BENT_SCALE_PX,
    of_motion_blur,
    OF_SIDES_PX,
    RefinedCorners,
)
from thermal_fiducial.core.detection.corners.gray_scale import GrayScale
from thermal_fiducial.core.detection.partial.grid import (
    adjusted,
    grid_edges,
    Layer,
    layer_of,
    on_marker,
    places_of_points,
    pose_jacobian,
    PoseFit,
)
from thermal_fiducial.core.detection.partial.visible_cells import VisibleCells
from thermal_fiducial.core.detection.patterns import CELL_SAMPLES, Decoder, most_similar, NEAR_CELLS
from thermal_fiducial.core.detection.prediction.frame import Frame
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.types import BoolArray, FloatArray, Gray, IntArray

# Least width of cells for separate straight edges [px]; approximate width of cells in the coarse layer [px].
_NARROWEST_PX, _COARSE_PX = 5.0, 8.0
# Largest number of markers, the largest ones, that are looked for in a frame.
_MOST = 2
# Grid of offsets from the prediction that are tried: spacing [cells]; extent in standard deviations of the prediction;
# most steps to either side.
_APART, _UNSURE, _MOST_STEPS = 0.7, 2.5, 7
# Least number of visible bits: fewer are those of many markers.
_FEWEST_BITS = 12
# Correlation from which the prediction needs no search, and below which the marker is given up; least correlation at
# the fitted pose. Of 240 drawings of other markers, turned ones, random cells and stripes one reaches 0.8, none 0.9.
_SIMILAR, _HINT, _ALIKE = 0.8, 0.55, 0.9
# Least share of the visible edges that show a step of the common contrast and agree with the pose.
_AGREEING = 0.6
# Largest number of adjustments on the fine layer, and the step below which a pose has converged [px].
_STEPS, _SETTLED_PX = 9, 0.1
# Standard deviation [px] and distance outside the image [image widths] beyond which a corner is not published.
_KNOWN_PX, _OUTSIDE = 8.0, 1.0


@dataclass(frozen=True, slots=True)
class _PartialMarker:
    """A predicted marker that is partially in view."""

    id: int
    size: float
    #: (4, 4) predicted pose
    T_camera_marker: FloatArray
    #: (4, 2) rectangle of the visible cells, in shares of the sides
    window: FloatArray
    #: width of its visible cells [px], and standard deviation of its predicted place [cells]
    cell_px: float
    unsure_cells: float

    def window_in_camera(self) -> FloatArray:
        """The window (4, 3) in the camera [m]."""
        return se3.apply(self.T_camera_marker, on_marker(self.window, self.size))


class PartialMarkerSearch:
    """Finds known markers that are partially in view; ``bits`` (M, n, n) are those of the decoder's dictionary."""

    def __init__(self, decoder: Decoder, bits: Gray) -> None:
        self._bits, self._cells = bits, decoder.cells
        self._visible = VisibleCells(decoder)

    def find(
        self,
        frame: Frame,
        gray_scale: GrayScale,
        candidates: list[tuple[int, FloatArray, float]],
        unsure_m: float,
        config: ArucoDetectorConfig,
    ) -> tuple[IntArray, RefinedCorners]:
        """Those of the ``candidates`` that the frame shows: IDs (N,) and corners.

        Parameters
        ----------
        frame : whose twist is known
        candidates : of :meth:`KnownMarkers.partially_visible`
        gray_scale : of the display, as far as whole markers have shown it; counts have none
        unsure_m : standard deviation of the predicted camera position [m]
        """
        in_view = (self._predicted(frame.camera, key, size, T, unsure_m) for key, T, size in candidates)
        largest = sorted((marker for marker in in_view if marker is not None), key=lambda marker: -marker.cell_px)
        if frame.displayed and largest:
            frame = frame.in_counts(gray_scale.counts)
        ids, found = list[int](), RefinedCorners.none()
        for marker in largest[:_MOST]:
            corners = self._refined(frame, marker, config)
            if corners is not None:
                ids, found = [*ids, marker.id], found.joined(corners)
        return np.array(ids, dtype=np.int64), found

    def _refined(self, frame: Frame, marker: _PartialMarker, config: ArucoDetectorConfig) -> RefinedCorners | None:
        """Corners of a marker by a fit at low, then at full resolution; None if it does not show its pattern."""
        points = on_marker(self._visible.places, marker.size)
        factor = int(2 ** np.clip(np.floor(np.log2(marker.cell_px / _COARSE_PX)), 0, 3))
        coarse = layer_of(frame, marker.window_in_camera(), factor)
        T = self._aligned(marker, points, coarse, marker.cell_px / factor)
        if T is None:
            return None
        pattern = grid_edges(self._bits[marker.id])
        rough = adjusted(T, marker.size, pattern, coarse, config.plate_thickness)
        least_counts = config.guided_min_contrast * frame.noise
        if rough is None or self._contrast(rough, marker, coarse) < least_counts:
            return None
        fine, fit = layer_of(frame, marker.window_in_camera()), rough
        for _ in range(_STEPS):
            step = adjusted(fit.T_camera_marker, marker.size, pattern, fine, config.plate_thickness)
            if step is None:
                return None
            fit = step
            if fit.moved_px < _SETTLED_PX:
                break
        if fit.moved_px > _SETTLED_PX or fit.agreeing < _AGREEING * fit.visible:
            return None
        return _corners(frame, marker, fit)

    def _predicted(
        self, camera: Camera, marker_id: int, size: float, T_camera_marker: FloatArray, unsure_m: float
    ) -> _PartialMarker | None:
        """The prediction of a marker with its visible part; None if that is too small."""
        px = camera.project(se3.apply(T_camera_marker, on_marker(self._visible.places, size)))
        inside: BoolArray = np.asarray(camera.contains(px).reshape(-1, 9).all(axis=1))
        if inside[self._visible.bits].sum() < _FEWEST_BITS:
            return None
        samples = px.reshape(-1, 9, 2)[inside]
        right, down = samples[:, 2] - samples[:, 0], samples[:, 6] - samples[:, 0]
        area = np.abs(right[:, 0] * down[:, 1] - right[:, 1] * down[:, 0])
        cell_px = float(np.sqrt(np.median(area)) / np.ptp(CELL_SAMPLES))
        if cell_px < _NARROWEST_PX:
            return None
        shares = np.clip(self._visible.places.reshape(-1, 9, 2)[inside].reshape(-1, 2), 0.0, 1.0)
        (left, top), (right_end, bottom) = shares.min(axis=0), shares.max(axis=0)
        window = np.array([[left, top], [right_end, top], [right_end, bottom], [left, bottom]])
        return _PartialMarker(marker_id, size, T_camera_marker, window, cell_px, unsure_m * self._cells / size)

    def _aligned(self, marker: _PartialMarker, points: FloatArray, layer: Layer, cell_px: float) -> FloatArray | None:
        """The predicted pose (4, 4), translated to the best correlation of the pattern; None without any."""
        px = layer.project(se3.apply(marker.T_camera_marker, points))

        def similar(places: FloatArray) -> FloatArray:
            return np.abs(self._visible.correlation(layer.image, px + places[:, None], marker.id))

        at, near = np.zeros(2), cell_px * NEAR_CELLS
        similarity = similar(near)
        if similarity.max() < _SIMILAR:
            far = cell_px * _offsets_around(marker.unsure_cells)
            at = far[np.argmax(similar(far))]
            similarity = similar(at + near)
        if similarity.max() < _HINT:
            return None
        shift = at + most_similar(similarity[None], near[None])[0]
        visible = np.flatnonzero(layer.camera.contains(px))
        J = pose_jacobian(marker.T_camera_marker, points[visible], layer.camera)[..., :3].reshape(-1, 3)
        step = np.linalg.lstsq(J, np.tile(shift, len(visible)), rcond=1e-3)[0]
        return se3.transform(marker.T_camera_marker[:3, :3], marker.T_camera_marker[:3, 3] + step)

    def _contrast(self, rough: PoseFit, marker: _PartialMarker, layer: Layer) -> float:
        """Contrast [counts] of the marker at a pose; 0 where the visible cells do not show its pattern."""
        places = se3.apply(rough.T_camera_marker, on_marker(self._visible.places, marker.size))
        (correlation,) = self._visible.correlation(layer.image, layer.project(places)[None], marker.id).tolist()
        return rough.contrast * np.sign(correlation) if abs(correlation) >= _ALIKE else 0.0


def _offsets_around(unsure_cells: float) -> FloatArray:
    """Places (P, 2) round one that is known so well, in cells."""
    steps = min(round(_UNSURE * unsure_cells / _APART), _MOST_STEPS)
    along = _APART * np.arange(-steps, steps + 1)
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def _corners(frame: Frame, marker: _PartialMarker, fit: PoseFit) -> RefinedCorners | None:
    """The corners that follow from a marker's pose, with covariances (2, 2) that claim no more than is known of it.

    None where they are too uncertain, or too far outside the image.
    """
    T, points = fit.T_camera_marker, marker_corners(marker.size)
    corners = frame.camera.project(se3.apply(T, points))
    limit = _OUTSIDE * frame.camera.width
    if not frame.camera.contains(corners, -limit).all():
        return None
    J = pose_jacobian(T, points, frame.camera)
    information: FloatArray = np.asarray(np.linalg.inv(_pose_covariance(frame, marker, fit)))
    blocks = _independent(J, information)
    deviation = np.sqrt(np.trace(blocks, axis1=1, axis2=2).max())
    if not deviation < _KNOWN_PX:
        return None
    contrast, noise, doubt = (np.array([value]) for value in (fit.contrast, fit.noise, 0.0))
    return RefinedCorners.by_edges(corners[None], blocks[None], contrast, noise, doubt)


def _pose_covariance(frame: Frame, marker: _PartialMarker, fit: PoseFit) -> FloatArray:
    """Covariance (6, 6) of a pose by the noise of its edges, and by systematic errors of edges and motion."""
    T = fit.T_camera_marker
    window = on_marker(marker.window, marker.size)
    J = pose_jacobian(T, window, frame.camera).reshape(8, 6)
    blocks = np.broadcast_to((OF_BENT_SCALE_PX if frame.displayed else OF_SIDES_PX) ** 2 * np.eye(2), (4, 2, 2))
    if frame.twist is not None:
        places = places_of_points(se3.apply(T, window), frame.camera)
        lag_blur, twist_covariance = places.lag_blur(frame.twist, frame.lag), frame.twist.covariance
        by_twist, displayed = frame.lag * places.flow, frame.displayed
        blocks = blocks + of_motion_blur(by_twist, twist_covariance, lag_blur, displayed=displayed)[0]
    gain = np.linalg.pinv(J).reshape(6, 4, 2)
    systematic = np.einsum('ick,ckl,jcl->ij', gain, blocks, gain)
    return np.asarray(fit.covariance + systematic)


def _independent(J: FloatArray, information: FloatArray) -> FloatArray:
    """Covariances (4, 2, 2) of corners that, taken as independent, give a pose no better than its covariance.

    Parameters
    ----------
    J : (4, 2, 6) derivative of the corners by the pose
    information : (6, 6) on it
    """
    covariance = np.linalg.inv(information)
    blocks = J @ covariance @ np.swapaxes(J, 1, 2)
    information = np.sum(np.swapaxes(J, 1, 2) @ np.linalg.inv(blocks) @ J, axis=0)
    L = np.linalg.cholesky(covariance)
    return np.asarray(np.linalg.eigvalsh(L.T @ information @ L)[-1] * blocks)
