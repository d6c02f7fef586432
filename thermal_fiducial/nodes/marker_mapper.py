"""Node ``marker_mapper``: markers to the camera's pose in the map, and the map itself."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
import sys
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
import numpy as np
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.geometry.se3 import apply, inverse
from thermal_fiducial.core.imaging.frame_cleaner import LATEST_NS
from thermal_fiducial.core.mapping.bundle_adjustment import refine, Refinement, Snapshot
from thermal_fiducial.core.mapping.mapper import MapJump, MapperResult, MarkerMap, MarkerMapper
from thermal_fiducial.core.measurements import CameraPose, in_moved_map
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.dictionary import other_patterns
from thermal_fiducial.files.map_history import save_with_history, undo
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.point_cloud import load_alignment, load_cloud, thinned
from thermal_fiducial.ros import clouds, convert, display, qos
from thermal_fiducial.ros.camera_node import CameraStageNode
from thermal_fiducial.ros.node import OK, WARN
from thermal_fiducial.ros.run import run
from thermal_fiducial.ros.worker import Background, Foreground

# Points of the cloud that is shown: 0.7 MB, which goes through shared memory in one piece.
_CLOUD_POINTS = 60_000
_XYZ = np.dtype([(axis, '<f4') for axis in 'xyz'])


@dataclass(frozen=True)
class _Drawing:
    """What RViz has been shown, and how many it was."""

    in_view: frozenset[int]
    listeners: int


class MarkerMapperNode(CameraStageNode[MarkerMapperConfig]):
    """Algorithm 1 of the paper behind topics and services; saves the map on request and on shutdown."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('marker_mapper', MarkerMapperConfig, **kwargs)
        empty = MarkerMap(frame_id=self.config.map_frame, dictionary=self.config.dictionary)
        self._other_dictionary = ''
        marker_map = self.attempt(self._load_map, empty)
        self.mapper = MarkerMapper(self.config, marker_map)
        self._save_path = self._choose_save_path()
        self._refiner = self._make_refiner()
        self._result = MapperResult(0, None, 'no markers yet')
        self._newest_ns = 0
        self._correction: tuple[int, FloatArray] = 0, np.eye(4)
        self._drawn: _Drawing | None = None
        self._camera_pose = self.advertise(PoseWithCovarianceStamped, 'camera_pose')
        self._marker_map = self.advertise(PointCloud2, 'marker_map', qos.LATCHED)
        self._map_markers = self.advertise(MarkerArray, 'marker_map/markers', qos.LATCHED)
        self._map_correction = self.advertise(TransformStamped, 'map_correction')
        self._map_cloud = self.advertise(PointCloud2, 'marker_map/cloud', qos.LATCHED)
        self.subscribe(PointCloud2, 'markers', self._on_markers, qos.RESULT)
        self.follow_hints()
        self.serve(Trigger, '~/save', self._on_save)
        self.serve(Trigger, '~/load', self._on_load)
        self.serve(Trigger, '~/undo', self._on_undo)
        self.serve(Trigger, '~/reset', self._on_reset)
        self.serve(Trigger, '~/refine', self._on_refine)
        self.serve(SetBool, '~/freeze', self._on_freeze)
        self._publish_map()
        self._draw_map()
        self.attempt(self._publish_cloud, None)

    def _load_map(self) -> MarkerMap:
        config = self.config
        if not config.map_file:
            return MarkerMap(frame_id=config.map_frame, dictionary=config.dictionary)
        return self._read_map(Path(config.map_file))

    def _read_map(self, path: Path) -> MarkerMap:
        config = self.config
        marker_map = load_map(path, config.marker_size, size_overrides(config.marker_size_overrides))
        self._other_dictionary = other_patterns(marker_map.markers, marker_map.dictionary, config.dictionary)
        return marker_map

    def _choose_save_path(self) -> Path | None:
        """The map's file; one beside it where that holds something that could not be read."""
        if not self.config.map_file:
            return None
        path = Path(self.config.map_file)
        return path.with_name(f'{path.stem}.new{path.suffix}') if self.faults and path.exists() else path

    def _make_refiner(self) -> Foreground[Snapshot, Refinement | None] | Background[Snapshot, Refinement | None]:
        return Background(refine) if self.live and self.config.mode == 'mapping' else Foreground(refine)

    def configure(self, config: MarkerMapperConfig) -> None:
        """Take over live parameters."""
        super().configure(config)
        self.mapper.config = config

    def _on_markers(self, message: PointCloud2) -> None:
        stamp = convert.stamp_ns(message.header.stamp)
        frame = self.mapper.locate(stamp, clouds.markers(message), self.camera(), self.odometry)
        self._newest_ns = max(stamp, self._newest_ns) if stamp >= self._newest_ns - LATEST_NS else stamp
        if frame.pose is not None:
            head, told = convert.header(stamp, self.config.map_frame), self._as_told(frame.pose)
            self._camera_pose.send(convert.pose_with_covariance(told.T_map_camera, told.covariance, head))
        # The pose is on its way by now.
        self._result = result = self.mapper.learn(frame)
        jump = self._refine(stamp)
        if jump is not None:
            self._tell(jump)
        elif result.map_changed:
            self._publish_map()

    def _tell(self, jump: MapJump | None) -> None:
        """Publish a map that has moved, and how where poses move with it, with the stamp of the newest frame before."""
        if jump is not None and jump.moves_poses:
            frame, self._correction = self.config.map_frame, (self._newest_ns, jump.T_new_old)
            self._map_correction.send(
                convert.transform_message(jump.T_new_old, self._newest_ns, frame, f'{frame}_before')
            )
        self._publish_map()

    def _as_told(self, pose: CameraPose) -> CameraPose:
        """A pose in the map that its stamp stands for: late frames from before a correction are taken to be older."""
        corrected_ns, T_new_old = self._correction
        if 0 <= corrected_ns - pose.stamp_ns <= LATEST_NS:
            return in_moved_map(pose, inverse(T_new_old))
        return pose

    def _refine(self, stamp: int) -> MapJump | None:
        """Start a joint refinement where one is due, take over one that is done."""
        if not self._refiner.busy and self.mapper.refinement_due(stamp):
            self._start_refinement()
        refinement = self._refiner.take()
        return None if refinement is None else self.mapper.apply(refinement)

    def _start_refinement(self) -> bool:
        snapshot = self.mapper.snapshot()
        if snapshot is not None:
            self._refiner.start(snapshot)
        return snapshot is not None

    def _publish_map(self) -> None:
        rows = self.mapper.map.rows(self._result.in_view)
        self._marker_map.send(clouds.cloud(rows, convert.header(self._result.stamp_ns, self.config.map_frame)))
        self._drawn = None

    def _draw_map(self) -> None:
        """The markers for RViz: all when they have changed or someone new looks on, else those of another colour."""
        now = _Drawing(self._result.in_view, self._map_markers.listeners)
        whole = self._drawn is None or now.listeners > self._drawn.listeners
        recoloured = now.in_view if self._drawn is None else now.in_view ^ self._drawn.in_view
        if whole or recoloured:
            rows = self.mapper.map.rows(now.in_view)
            head = convert.header(self._result.stamp_ns, self.config.map_frame)
            shown = rows if whole else rows[np.isin(rows['id'], list(recoloured))]
            self._map_markers.send(display.map_markers(shown, head, whole=whole))
        self._drawn = now

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics, and draw the map: once a second, as a thousand markers take a while."""
        super().diagnose(stamp_ns)
        if self._map_markers.listeners:
            self._draw_map()
        else:
            self._drawn = None

    def _publish_cloud(self) -> None:
        """The point cloud of the place, in the frame of the map, once: for RViz beside the markers."""
        config = self.config
        if not config.cloud_file:
            return
        T_cloud_map = load_alignment(config.cloud_alignment_file) if config.cloud_alignment_file else np.eye(4)
        points = apply(inverse(T_cloud_map), thinned(load_cloud(config.cloud_file), _CLOUD_POINTS))
        rows = np.ascontiguousarray(points, '<f4').view(_XYZ)[:, 0]
        self._map_cloud.send(clouds.cloud(rows, convert.header(0, config.map_frame)))

    def _on_save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return _answered(response, self._save)

    def _save(self) -> str:
        save_with_history(self._map_file(), self.mapper.map, 'save')
        return f'{len(self.mapper.map.markers)} markers saved to {self._save_path}'

    def _map_file(self) -> Path:
        if self._save_path is None:
            raise InputError('parameter map_file is empty: there is no map on disk')
        return self._save_path

    def _on_load(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return _answered(response, self._load)

    def _load(self) -> str:
        """Take over the map file as it is now: what ``thermal-fiducial map`` has made of it."""
        self._refuse_frozen()
        loaded = self._read_map(self._map_file())
        self._tell(self.mapper.load(loaded))
        return f'{len(loaded.markers)} markers loaded from {self._save_path}'

    def _on_undo(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return _answered(response, self._undo)

    def _undo(self) -> str:
        self._refuse_frozen()
        entry = undo(self._map_file())
        return f'undone: {entry.action}; {self._load()}'

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        return _answered(response, self._reset)

    def _reset(self) -> str:
        self._refuse_frozen()
        self._tell(self.mapper.reset())
        return f'{len(self.mapper.map.markers)} markers left'

    def _refuse_frozen(self) -> None:
        if self.mapper.frozen:
            raise InputError('the map is frozen')

    def _on_refine(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._refiner.busy:
            response.message = 'a refinement is under way'
        else:
            response.success = self._start_refinement()
            response.message = 'refinement started' if response.success else 'nothing to refine yet'
        return response

    def _on_freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.mapper.frozen = bool(request.data)
        response.success, response.message = True, 'map frozen' if request.data else 'map free'
        return response

    def close(self) -> None:
        """End the refinement; save what was mapped."""
        self._refiner.close()
        if self.config.mode != 'mapping' or self._save_path is None or not self.mapper.map.markers:
            return
        try:
            self.get_logger().info(self._save())
        except InputError as error:
            self.get_logger().error(str(error))

    def state(self) -> tuple[bytes, str]:
        """Why the last frame gave no pose, whether the map is meant, and which markers are not trusted."""
        if self._result.reason or self._other_dictionary:
            return WARN, '; '.join(filter(None, (self._result.reason, self._other_dictionary)))
        if self._result.quarantined:
            return WARN, f'quarantined: {_listed(self._result.quarantined)}'
        return OK, 'map frozen' if self.mapper.frozen else 'ok'

    def figures(self) -> dict[str, object]:
        """The map in numbers, and what waits to enter it."""
        result = self._result
        waiting = '; '.join(f'{key}: {reason}' for key, reason in result.candidates.items())
        return super().figures() | {
            'markers in map': len(self.mapper.map.markers),
            'map version': self.mapper.map.version,
            'map corrections': self.mapper.resets,
            'in view': _listed(sorted(result.in_view)),
            'quarantined': _listed(result.quarantined),
            'candidates': waiting,
        }


def _answered(response: Trigger.Response, act: Callable[[], str]) -> Trigger.Response:
    """``response`` with what ``act`` says of what it did, or why it could not."""
    try:
        response.message = act()
        response.success = True
    except InputError as error:
        response.message = str(error)
    return response


def _listed(ids: Iterable[int]) -> str:
    return ', '.join(str(key) for key in ids)


def main() -> int:
    """Run the node."""
    return run(MarkerMapperNode)


if __name__ == '__main__':
    sys.exit(main())
