"""Topics of the marker map: its rows, its corrections, and its display in RViz."""

from collections.abc import Collection
from dataclasses import dataclass, replace

from geometry_msgs.msg import TransformStamped
import numpy as np
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.se3 import apply, inverse
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.files.point_cloud import load_alignment, load_cloud, thinned
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.node import StageNode
from thermal_fiducial.ros.messages import clouds, convert, display

# Most points of the displayed cloud: 0.7 MB, which fits shared memory unfragmented.
_CLOUD_POINTS = 60_000
_XYZ = np.dtype([(axis, '<f4') for axis in 'xyz'])


@dataclass(frozen=True)
class _MapDrawing:
    """State of the display: drawing, markers in view in it, subscribers that have it by their identifiers in DDS."""

    message: MarkerArray
    in_view: frozenset[int]
    listeners: frozenset[tuple[int, ...]]


class MapTopics:
    """Publishers of the map, and of the point cloud of the site if one is configured."""

    def __init__(self, node: StageNode[MarkerMapperConfig]) -> None:
        config = node.config
        self._node = node
        self._frame_id = config.map_frame
        self._drawn: _MapDrawing | None = None
        self._rows = node.advertise(PointCloud2, 'marker_map', qos.LATCHED)
        self._drawing = node.advertise(MarkerArray, 'marker_map/markers', qos.LATCHED)
        self._correction = node.advertise(TransformStamped, 'map_correction')
        self._cloud = node.advertise(PointCloud2, 'marker_map/cloud', qos.LATCHED)
        if config.cloud_file:
            node.attempt(lambda: self._publish_cloud(config.cloud_file, config.cloud_alignment_file), None)

    def publish(self, marker_map: MarkerMap, in_view: Collection[int], stamp_ns: int) -> None:
        """Publish the map after the frame of ``stamp_ns``, in which the markers ``in_view`` were seen."""
        self._rows.send(clouds.cloud(marker_map.rows(in_view), convert.header(stamp_ns, self._frame_id)))
        self._drawn = None

    def publish_correction(self, T_new_old: FloatArray, stamp_ns: int) -> None:
        """Publish the correction ``T_new_old`` (4, 4) of the map after the frame of ``stamp_ns``."""
        old = f'{self._frame_id}_before'
        self._correction.send(convert.transform_message(T_new_old, stamp_ns, self._frame_id, old))

    def draw(self, marker_map: MarkerMap, in_view: frozenset[int], stamp_ns: int) -> None:
        """Publish all markers for RViz, after a change of the map or of colours and for a new subscriber.

        Each drawing is complete: it is the one that a player of a recorded flight has when it begins after it.
        """
        listeners, drawn = self._listeners(), self._drawn
        if drawn and drawn.in_view == in_view and listeners <= drawn.listeners:
            self._drawn = replace(drawn, listeners=listeners)
            return
        rows, head = marker_map.rows(in_view), convert.header(stamp_ns, self._frame_id)
        if drawn:  # To make a drawing of a hundred markers takes five times as long as to send it.
            display.recolour(drawn.message, rows, head)
        message = drawn.message if drawn else display.map_markers(rows, head)
        self._drawing.send(message)
        self._drawn = _MapDrawing(message, in_view, listeners)

    def _listeners(self) -> frozenset[tuple[int, ...]]:
        """Subscribers of the drawing: as many as before may be others, as when RViz is started again."""
        every = self._node.get_subscriptions_info_by_topic(self._drawing.topic)
        return frozenset(tuple(subscriber.endpoint_gid) for subscriber in every)

    def draw_for_listeners(self, marker_map: MarkerMap, in_view: frozenset[int], stamp_ns: int) -> None:
        """:meth:`draw` if there are subscribers."""
        if self._drawing.listeners:
            self.draw(marker_map, in_view, stamp_ns)
        else:
            self._drawn = None

    def _publish_cloud(self, cloud_file: str, alignment_file: str) -> None:
        """Publish the point cloud of the site in the map frame, once.

        Raises
        ------
        InputError
            An unusable file.
        """
        T_cloud_map = load_alignment(alignment_file) if alignment_file else np.eye(4)
        points = apply(inverse(T_cloud_map), thinned(load_cloud(cloud_file), _CLOUD_POINTS))
        rows = np.ascontiguousarray(points, '<f4').view(_XYZ)[:, 0]
        self._cloud.send(clouds.cloud(rows, convert.header(0, self._frame_id)))
