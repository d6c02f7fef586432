"""Node ``marker_mapper``: detections to the camera's pose in the map, and the map itself."""

import sys
from typing import Any

from sensor_msgs.msg import PointCloud2

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.mapping.map_data import MapperResult
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.camera_nodes.camera_node import CameraStageNode
from thermal_fiducial.ros.mapper_node import map_status
from thermal_fiducial.ros.mapper_node.camera_poses import CameraPoses
from thermal_fiducial.ros.mapper_node.map_services import MapServices
from thermal_fiducial.ros.mapper_node.map_topics import MapTopics
from thermal_fiducial.ros.messages import clouds
from thermal_fiducial.ros.process.run import run


class MarkerMapperNode(CameraStageNode[MarkerMapperConfig]):
    """Topics and services of the mapper (the paper's Algorithm 1); saves the map on request and on shutdown."""

    stage = 2

    def __init__(self, **kwargs: Any) -> None:
        super().__init__('marker_mapper', MarkerMapperConfig, **kwargs)
        self._map = MapServices(self, self._publish_jump)
        self.mapper = self._map.mapper
        self._result = MapperResult(0, None, 'no markers yet')
        self._misfit = map_status.Misfit()
        self._topics = MapTopics(self)
        self._frames = self.subscribe_newest(PointCloud2, 'markers', self._on_markers, qos.RESULT, raw=True)
        self._poses = CameraPoses(self, self.mapper)
        self.subscribe_to_camera_and_filter()
        self._publish_map()
        self._topics.draw(self.mapper.map, self._result.in_view, 0)

    def configure(self, config: MarkerMapperConfig) -> None:
        """Apply dynamic parameters."""
        super().configure(config)
        self.mapper.configure(config)
        self._poses.configure()

    def _on_markers(self, message: bytes) -> None:
        frame = self.mapper.locate(*clouds.stamped_markers(message), self.camera(), self.odometry)
        self._poses.send(frame.stamp_ns, frame.pose)
        self._misfit.add(frame)
        before, self._result = self._result, self.mapper.learn(frame)
        for marker_id, line in map_status.news(before, self._result).items():
            self.console.event(f'marker {marker_id}', line)
        if self._result.learned:
            self._map.note_learned()
        changed = self._result.map_changed
        try:
            changed |= self._map.refine_in_flight(frame.stamp_ns)
        finally:  # A refinement that has failed keeps no change of this frame back.
            if changed:
                self._publish_map()

    def _publish_jump(self, T_new_old: FloatArray | None) -> None:
        """Publish a replaced map, and the correction of poses with the stamp of the newest frame before it."""
        self.odometry.forget()
        self._poses.forget()
        if T_new_old is not None:
            self._poses.late.moved(T_new_old)
            self._topics.publish_correction(T_new_old, self._poses.late.newest_ns)
        self._publish_map()

    def _publish_map(self) -> None:
        self._topics.publish(self.mapper.map, self._result.in_view, self._result.stamp_ns)

    def diagnose(self, stamp_ns: int) -> None:
        """Publish the diagnostics and the display of the map: only once a second, as a thousand markers take long."""
        super().diagnose(stamp_ns)
        self._topics.draw_for_listeners(self.mapper.map, self._result.in_view, self._result.stamp_ns)
        self._map.remember()

    def state(self) -> tuple[bytes, str]:
        """Why the last frame gave no pose, doubts about map and file, quarantined markers, skipped frames."""
        left = self._frames.left_since()
        return map_status.state(self._result, self.headline(), frozen=self.mapper.frozen, left=left)

    def headline(self) -> str:
        """Doubts about map, file and calibration."""
        return '; '.join(filter(None, (self._map.doubts, self._misfit.doubt, self._poses.doubts)))

    def figures(self) -> dict[str, object]:
        """Key-value pairs: size of the map, candidates."""
        own = map_status.figures(self.mapper.map, self.mapper.resets, self._result, self._misfit.sigma)
        return super().figures() | own | self._poses.figures()


def main() -> int:
    """Run the node."""
    return run(MarkerMapperNode)


if __name__ == '__main__':
    sys.exit(main())
