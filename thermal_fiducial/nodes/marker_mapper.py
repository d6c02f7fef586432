"""Node ``marker_mapper``: markers to the camera's pose in the map, and the map itself."""

from pathlib import Path
import sys
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from thermal_fiducial.config import MarkerMapperConfig, size_overrides
from thermal_fiducial.core.marker_map import MarkerMap, MarkerMapper
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.marker_map import load_map, save_map
from thermal_fiducial.ros import convert, display, qos
from thermal_fiducial.ros.camera_node import CameraStageNode
from thermal_fiducial.ros.node import OK, WARN
from thermal_fiducial.ros.run import run


class MarkerMapperNode(CameraStageNode[MarkerMapperConfig]):
    """Algorithm 1 of the paper behind topics and services; saves the map on request and on shutdown."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('marker_mapper', MarkerMapperConfig, **kwargs)
        empty = MarkerMap(frame_id=self.config.map_frame, dictionary=self.config.dictionary)
        marker_map = self.attempt(self._load_map, empty)
        self.mapper = MarkerMapper(self.config, marker_map)
        self._save_path = self._choose_save_path()
        self._reason = 'no markers yet'
        self._stamp = 0
        self._camera_pose = self.advertise(PoseWithCovarianceStamped, 'camera_pose')
        self._marker_map = self.advertise(PointCloud2, 'marker_map', qos.LATCHED)
        self._map_markers = self.advertise(MarkerArray, 'marker_map/markers', qos.LATCHED)
        self.subscribe(PointCloud2, 'markers', self._on_markers, qos.RESULT)
        self.follow_hints()
        self.create_service(Trigger, '~/save', self._on_save)
        self.create_service(Trigger, '~/reset', self._on_reset)
        self.create_service(SetBool, '~/freeze', self._on_freeze)
        self._publish_map()

    def _load_map(self) -> MarkerMap:
        config = self.config
        sizes = size_overrides(config.marker_size_overrides)
        if not config.map_file:
            return MarkerMap(frame_id=config.map_frame, dictionary=config.dictionary)
        return load_map(config.map_file, config.marker_size, sizes)

    def _choose_save_path(self) -> Path | None:
        """The map's file; one beside it where that holds something that could not be read."""
        if not self.config.map_file:
            return None
        path = Path(self.config.map_file)
        return path.with_name(f'{path.stem}.new{path.suffix}') if self.faults and path.exists() else path

    def configure(self, config: MarkerMapperConfig) -> None:
        """Take over live parameters."""
        super().configure(config)
        self.mapper.config = config

    def _on_markers(self, message: PointCloud2) -> None:
        stamp = convert.stamp_ns(message.header.stamp)
        result = self.mapper.process(stamp, convert.markers(message), self.camera(), self.odometry())
        self._reason, self._stamp = result.reason, stamp
        if result.pose is not None:
            head = convert.header(stamp, self.config.map_frame)
            pose = convert.pose_with_covariance(result.pose.T_map_camera, result.pose.covariance, head)
            self._camera_pose.send(pose)
        refined = self.mapper.refinement_due(stamp) and self.mapper.refine() is not None
        if result.map_changed or refined:
            self._publish_map()

    def _publish_map(self) -> None:
        rows = self.mapper.map.rows()
        head = convert.header(self._stamp, self.config.map_frame)
        self._marker_map.send(convert.cloud(rows, head))
        self._map_markers.send(display.map_markers(rows, head))

    def _on_save(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message = self._save()
            response.success = True
        except InputError as error:
            response.message = str(error)
        return response

    def _save(self) -> str:
        if self._save_path is None:
            raise InputError('parameter map_file is empty: nowhere to save the map')
        save_map(self._save_path, self.mapper.map)
        return f'{len(self.mapper.map.markers)} markers saved to {self._save_path}'

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.mapper.reset()
        self._publish_map()
        response.success, response.message = True, f'{len(self.mapper.map.markers)} markers left'
        return response

    def _on_freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self.mapper.frozen = bool(request.data)
        response.success, response.message = True, 'map frozen' if request.data else 'map free'
        return response

    def close(self) -> None:
        """Save what was mapped."""
        if self.config.mode != 'mapping' or self._save_path is None or not self.mapper.map.markers:
            return
        try:
            self.get_logger().info(self._save())
        except InputError as error:
            self.get_logger().error(str(error))

    def state(self) -> tuple[bytes, str]:
        """Why the last frame gave no pose."""
        if self._reason:
            return WARN, self._reason
        return OK, 'map frozen' if self.mapper.frozen else 'ok'

    def figures(self) -> dict[str, object]:
        """Size and version of the map."""
        return super().figures() | {
            'markers in map': len(self.mapper.map.markers),
            'map version': self.mapper.map.version,
        }


def main() -> int:
    """Run the node."""
    return run(MarkerMapperNode)


if __name__ == '__main__':
    sys.exit(main())
