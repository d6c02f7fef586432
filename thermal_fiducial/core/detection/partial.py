"""Known markers that the border of the image cuts, or that fill it.

Where the map and the odometry expect one, its visible cells must look like it and like nothing else there. All edges
between its cells that are in view, inside and along its sides, then show its pose, and that shows its corners, those
outside the image as well.
"""

from dataclasses import dataclass

import numpy as np

from thermal_fiducial.config import ArucoDetectorConfig
from thermal_fiducial.core.detection.corner_errors import OF_BENT_SCALE_PX, of_motion_blur, OF_SIDES_PX
from thermal_fiducial.core.detection.corners.grid import (
    adjusted,
    grid_edges,
    Layer,
    layer_of,
    on_marker,
    places_of_points,
    pose_jacobian,
    PoseFit,
)
from thermal_fiducial.core.detection.frame import Frame
from thermal_fiducial.core.detection.known_markers import PartialMarkers
from thermal_fiducial.core.detection.patterns import CELL_SAMPLES, Decoder, most_similar, NEAR_CELLS
from thermal_fiducial.core.detection.refining import RefinedCorners
from thermal_fiducial.core.detection.visible_cells import VisibleCells
from thermal_fiducial.core.geometry import se3
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.planar_pose import marker_corners
from thermal_fiducial.core.types import BoolArray, FloatArray, Gray, IntArray

# Cells narrower than this show no straight edges apart from each other [px]; those of the coarsest layer are no wider.
_NARROWEST_PX, _COARSE_PX = 5.0, 8.0
# So many markers at most, the largest, are looked for in a frame: more show little more.
_MOST = 2
# Places farther from the prediction that are tried [cells]: so far apart, as far as so many standard deviations of the
# prediction reach, but at least and at most so far.
_APART, _UNSURE, _LEAST_REACH, _REACH = 0.7, 2.5, 1.4, 4.9
# Least number of cells in view, and of those by which any other marker differs, lest a stain make it another.
_CELLS, _DIFFERENT = 16, 2
# Least correlation, difference to the most similar other pattern as a share of what a perfect view has, and of squares.
_SIMILAR, _MARGIN, _EVIDENCE = 0.8, 0.5, 25.0
# Correlation of a marker that need not be looked for elsewhere, and of a place that is worth a closer look.
_THERE, _HINT = 0.95, 0.55
# Least share of the edges in view that show a step like the others', and agree with the pose.
_SHOWN, _AGREEING = 0.7, 0.6
# Adjustments on the fine layer at most, and the last step of a pose that has settled [px].
_STEPS, _SETTLED_PX = 9, 0.1
# A corner that is known no better shows nothing, nor one so far outside the image, in image widths [px].
_KNOWN_PX, _OUTSIDE = 8.0, 1.0


@dataclass(frozen=True, slots=True)
class _PartialMarker:
    """A marker that is looked for."""

    id: int
    size: float
    #: (4, 4) where it is expected
    T_camera_marker: FloatArray
    #: (4, 2) shares of the sides between which it is in view
    window: FloatArray
    #: width of its cells in view [px], and standard deviation of its place, in cells
    cell_px: float
    unsure_cells: float

    def seen(self) -> FloatArray:
        """The window (4, 3) in the camera [m]."""
        return se3.apply(self.T_camera_marker, on_marker(self.window, self.size))


class PartialMarkerSearch:
    """Looks for known markers that are not wholly in view.

    Parameters
    ----------
    decoder, bits : of the dictionary, (M, n, n)
    """

    def __init__(self, decoder: Decoder, bits: Gray) -> None:
        self._bits, self._cells = bits, decoder.cells
        self._visible = VisibleCells(decoder)

    def look(
        self,
        frame: Frame,
        candidates: PartialMarkers,
        unsure_m: float,
        allowed: BoolArray,
        config: ArucoDetectorConfig,
    ) -> tuple[IntArray, RefinedCorners]:
        """Those of the ``candidates`` that the frame shows: IDs (N,) and corners.

        Parameters
        ----------
        frame : whose twist is known
        unsure_m : standard deviation of where they are expected
        allowed : (M,) IDs that there may be
        """
        in_view = (
            self._expected(frame.camera, marker_id, size, T, unsure_m)
            for marker_id, T, size in zip(
                candidates.ids.tolist(), candidates.T_camera_marker, candidates.sizes.tolist(), strict=True
            )
        )
        largest = sorted((marker for marker in in_view if marker is not None), key=lambda marker: -marker.cell_px)
        ids, found = list[int](), RefinedCorners.none()
        for marker in largest[:_MOST]:
            corners = self._one(frame, marker, allowed, config)
            if corners is not None:
                ids, found = [*ids, marker.id], found.joined(corners)
        return np.array(ids, dtype=np.int64), found

    def _one(
        self, frame: Frame, marker: _PartialMarker, allowed: BoolArray, config: ArucoDetectorConfig
    ) -> RefinedCorners | None:
        points = on_marker(self._visible.places, marker.size)
        factor = int(2 ** np.clip(np.floor(np.log2(marker.cell_px / _COARSE_PX)), 0, 3))
        coarse = layer_of(frame, marker.seen(), config.blur_px, factor)
        T = self._moved(marker, points, coarse, marker.cell_px / factor)
        if T is None:
            return None
        pattern = grid_edges(self._bits[marker.id])
        rough = adjusted(T, marker.size, pattern, coarse)
        if rough is None or not self._recognised(rough, marker, coarse, allowed, frame.noise, config):
            return None
        fine, fit = layer_of(frame, marker.seen(), config.blur_px), rough
        for _ in range(_STEPS):
            step = adjusted(fit.T_camera_marker, marker.size, pattern, fine)
            if step is None:
                return None
            fit = step
            if fit.moved_px < _SETTLED_PX:
                break
        if fit.moved_px > _SETTLED_PX or not _agrees(fit):
            return None
        return _corners(frame, marker, fit)

    def _expected(
        self, camera: Camera, marker_id: int, size: float, T_camera_marker: FloatArray, unsure_m: float
    ) -> _PartialMarker | None:
        """A marker as far as it should be in view; None where that is too little."""
        px = camera.project(se3.apply(T_camera_marker, on_marker(self._visible.places, size)))
        inside = camera.contains(px).reshape(-1, 9).all(axis=1)
        if inside.sum() < _CELLS:
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

    def _moved(self, marker: _PartialMarker, points: FloatArray, layer: Layer, cell_px: float) -> FloatArray | None:
        """The expected pose (4, 4) moved to where the pattern correlates best; None where it does nowhere."""
        px = layer.project(se3.apply(marker.T_camera_marker, points))

        def similar(places: FloatArray) -> FloatArray:
            return np.abs(self._visible.match(layer.image, px + places[:, None], marker.id))

        if similar(np.zeros((1, 2)))[0] > _THERE:
            return marker.T_camera_marker
        at, near = np.zeros(2), cell_px * NEAR_CELLS
        similarity = similar(near)
        if similarity.max() < _SIMILAR:
            far = cell_px * _around(marker.unsure_cells)
            at = far[np.argmax(similar(far))]
            similarity = similar(at + near)
        if similarity.max() < _HINT:
            return None
        shift = at + most_similar(similarity[None], near[None])[0]
        seen = np.flatnonzero(layer.camera.contains(px))
        J = pose_jacobian(marker.T_camera_marker, points[seen], layer.camera)[..., :3].reshape(-1, 3)
        step = np.linalg.lstsq(J, np.tile(shift, len(seen)), rcond=1e-3)[0]
        return se3.transform(marker.T_camera_marker[:3, :3], marker.T_camera_marker[:3, 3] + step)

    def _recognised(
        self,
        rough: PoseFit,
        marker: _PartialMarker,
        layer: Layer,
        allowed: BoolArray,
        noise: float,
        config: ArucoDetectorConfig,
    ) -> bool:
        """Whether the cells in view show the marker beyond doubt."""
        places = se3.apply(rough.T_camera_marker, on_marker(self._visible.places, marker.size))
        likeness = self._visible.likeness(layer.image, layer.project(places), marker.id, allowed)
        correlation, margin = abs(likeness.correlation), _MARGIN * (1.0 - likeness.perfect)
        return bool(
            likeness.cells >= _CELLS
            and correlation >= _SIMILAR
            and correlation - likeness.runner_up >= margin
            and likeness.distance >= _DIFFERENT
            and likeness.evidence >= _EVIDENCE
            and likeness.contrast * np.sign(rough.contrast) >= config.guided_min_contrast * noise
        )


def _agrees(fit: PoseFit) -> bool:
    """Whether most edges in view are there, where the pose has them."""
    return fit.shown >= _SHOWN * fit.visible and fit.agreeing >= _AGREEING * fit.visible


def _around(unsure_cells: float) -> FloatArray:
    """Places (P, 2) round one that is known so well, in cells."""
    steps = round(np.clip(_UNSURE * unsure_cells, _LEAST_REACH, _REACH) / _APART)
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
    scalars = (np.array([value]) for value in (fit.contrast, fit.noise, 0.0))
    return RefinedCorners(corners[None], blocks[None], *scalars)


def _pose_covariance(frame: Frame, marker: _PartialMarker, fit: PoseFit) -> FloatArray:
    """Covariance (6, 6) of a pose by its edges' noise, and by what displaces all of them alike or in some order."""
    T = fit.T_camera_marker
    window = on_marker(marker.window, marker.size)
    J = pose_jacobian(T, window, frame.camera).reshape(8, 6)
    blocks = np.broadcast_to((OF_BENT_SCALE_PX if frame.displayed else OF_SIDES_PX) ** 2 * np.eye(2), (4, 2, 2))
    if frame.twist is not None:
        places = places_of_points(se3.apply(T, window), frame.camera)
        lag_blur, twist_covariance = places.lag_blur(frame.twist, frame.lag), frame.twist.covariance_ago(frame.lag)
        blocks = blocks + of_motion_blur(frame.lag * places.flow, twist_covariance, lag_blur)[0]
    gain = np.linalg.pinv(J).reshape(6, 4, 2)
    systematic = np.einsum('ick,ckl,jcl->ij', gain, blocks, gain)
    return np.asarray(np.linalg.inv(fit.information) + systematic)


def _independent(J: FloatArray, information: FloatArray) -> FloatArray:
    """Covariances (4, 2, 2) of corners that, taken for independent, show a pose no better than it is known.

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
