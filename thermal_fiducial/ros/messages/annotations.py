"""Markers of a frame as foxglove_msgs/ImageAnnotations, which Foxglove draws over the image."""

from typing import Any

from std_msgs.msg import Header

from thermal_fiducial.core.measurements import corners_px, Markers

_LINE_PX, _FONT_PX, _CORNER_PX = 2.0, 18.0, 8.0
#: In Foxglove (0, 0) is the corner of the first pixel, here its centre.
_CENTRE_PX = 0.5
_EDGE, _FIRST_CORNER, _GROUND = (0.13, 0.83, 0.93, 1.0), (1.0, 0.85, 0.0, 1.0), (0.0, 0.0, 0.0, 0.5)


def image_annotations(messages: Any, markers: Markers, head: Header) -> Any:
    """Outlines, first corners and IDs of the markers; empty if there are none, which clears those of earlier frames.

    Parameters
    ----------
    messages : module ``foxglove_msgs.msg``
    """
    result = messages.ImageAnnotations()
    if hasattr(result, 'timestamp'):  # since the end of 2025
        result.timestamp = head.stamp
    for row, corners in zip(markers, (corners_px(markers) + _CENTRE_PX).tolist(), strict=True):
        points = [messages.Point2(x=x, y=y) for x, y in corners]
        outline = messages.PointsAnnotation(timestamp=head.stamp, points=points, thickness=_LINE_PX)
        outline.type, outline.outline_color = messages.PointsAnnotation.LINE_LOOP, _colour(messages, _EDGE)
        first = messages.CircleAnnotation(timestamp=head.stamp, position=points[0], diameter=_CORNER_PX)
        first.fill_color = first.outline_color = _colour(messages, _FIRST_CORNER)
        label = messages.TextAnnotation(timestamp=head.stamp, text=str(int(row['id'])), font_size=_FONT_PX)
        label.position = messages.Point2(x=max(x for x, _ in corners), y=max(y for _, y in corners))
        label.text_color, label.background_color = _colour(messages, _EDGE), _colour(messages, _GROUND)
        result.points.append(outline)
        result.circles.append(first)
        result.texts.append(label)
    return result


def _colour(messages: Any, rgba: tuple[float, float, float, float]) -> Any:
    r, g, b, a = rgba
    return messages.Color(r=r, g=g, b=b, a=a)
