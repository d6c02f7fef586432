"""For display only: markers of the map for RViz, detections drawn into the image."""

from typing import Any

import cv2
from geometry_msgs.msg import Vector3
import numpy as np
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from thermal_fiducial.core.measurements import corners_px, Markers
from thermal_fiducial.core.types import Gray
from thermal_fiducial.ros.messages import convert

# As pilots read them, and as ``watch`` has them: red is a fault. A marker that is out of view is none.
_IN_VIEW = ColorRGBA(r=0.1, g=0.7, b=0.1, a=0.9)
_OUT_OF_VIEW = ColorRGBA(r=0.5, g=0.5, b=0.5, a=0.9)
_DISTRUSTED = ColorRGBA(r=0.9, g=0.1, b=0.1, a=0.9)
_THICKNESS = 0.01
_BGR_EDGE = (0, 0, 255)
_BGR_FIRST_CORNER = (0, 255, 255)


def map_markers(rows: 'np.ndarray[Any, np.dtype[Any]]', head: Header) -> MarkerArray:
    """Plates and IDs of the rows (N,) of a marker map, in place of all earlier ones."""
    array = MarkerArray(markers=[Marker(header=head, action=Marker.DELETEALL)])
    for row in rows:
        array.markers += [_plate(row, head), _label(row, head)]
    return array


def recolour(array: MarkerArray, rows: 'np.ndarray[Any, np.dtype[Any]]', head: Header) -> None:
    """Give a drawing the header and the colours of today; ``rows`` (N,) are those that it was made of."""
    for marker in array.markers:
        marker.header = head
    for plate, row in zip(array.markers[1::2], rows, strict=True):
        plate.color = _colour(row)


def _plate(row: Any, head: Header) -> Marker:
    size = float(row['size'])
    marker = Marker(
        header=head, ns='plates', id=int(row['id']), type=Marker.CUBE, action=Marker.ADD, pose=convert.pose_of_row(row)
    )
    marker.scale = Vector3(x=size, y=size, z=_THICKNESS)
    marker.color = _colour(row)
    return marker


def _colour(row: Any) -> ColorRGBA:
    """Red if distrusted, in view or not; else green in view, grey out of view."""
    return _DISTRUSTED if not row['trusted'] else _IN_VIEW if row['in_view'] else _OUT_OF_VIEW


def _label(row: Any, head: Header) -> Marker:
    size = float(row['size'])
    marker = Marker(header=head, ns='ids', id=int(row['id']), type=Marker.TEXT_VIEW_FACING, action=Marker.ADD)
    marker.pose = convert.pose_of_row(row)
    marker.pose.position.z += 0.75 * size
    marker.scale.z = 0.4 * size
    marker.color = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
    marker.text = str(int(row['id']))
    return marker


def annotated(view: Gray, markers: Markers) -> 'np.ndarray[Any, np.dtype[np.uint8]]':
    """Picture (H, W, 3) BGR of an 8-bit view with the outlines and IDs of the markers."""
    picture = cv2.cvtColor(view, cv2.COLOR_GRAY2BGR)
    for marker_id, corners in zip(markers['id'].tolist(), np.rint(corners_px(markers)).astype(np.int32), strict=True):
        cv2.polylines(picture, [corners], isClosed=True, color=_BGR_EDGE, thickness=2)
        cv2.circle(picture, corners[0].tolist(), 4, _BGR_FIRST_CORNER, thickness=-1)
        place = (corners.max(axis=0) + 4).tolist()
        cv2.putText(picture, str(marker_id), place, cv2.FONT_HERSHEY_SIMPLEX, 0.6, _BGR_EDGE, 2)
    return np.asarray(picture, dtype=np.uint8)
