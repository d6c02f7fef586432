"""Structured numpy arrays as point clouds, and back: markers of a frame, the marker map."""

from collections.abc import Iterable, Mapping
from functools import lru_cache
import struct
from typing import Any

from geometry_msgs.msg import PoseArray
import numpy as np
import numpy.typing as npt
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from thermal_fiducial.core.geometry.plausibility import LARGEST_VARIANCE
from thermal_fiducial.core.map_limits import LARGEST_COORDINATE
from thermal_fiducial.core.measurements import (
    columns,
    CORNER_COVARIANCE_FIELDS,
    CORNER_FIELDS,
    LATER_MARKER_FIELDS,
    MAP_DTYPE,
    MARKER_DTYPE,
    Markers,
    places_of,
)
from thermal_fiducial.core.types import FloatArray, LARGEST_ID
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.messages import message_bytes
from thermal_fiducial.ros.messages.convert import data_bytes, NORM_TOLERANCE, pose_of_row

_POINT_TYPES = {
    PointField.INT8: 'i1',
    PointField.UINT8: 'u1',
    PointField.INT16: 'i2',
    PointField.UINT16: 'u2',
    PointField.INT32: 'i4',
    PointField.UINT32: 'u4',
    PointField.FLOAT32: 'f4',
    PointField.FLOAT64: 'f8',
}
_POINT_CODES = {code: datatype for datatype, code in _POINT_TYPES.items()}
#: Largest number of points accepted: more than any map has. A malformed header may claim four billion.
_MOST_ROWS = 20_000
# (1e-4 px)^2, below what any corner detection achieves [px^2].
_SMALLEST_CORNER_VARIANCE = 1e-8
# Longest side of a marker [m].
_LARGEST_MARKER = 100.0
# Two uint32: height and width, or row_step and length of the data.
_TWO = struct.Struct('<II')
# Of a field: offset, datatype, count; of the cloud: is_bigendian, point_step.
_PLACE, _POINT = struct.Struct('<IB3xI'), struct.Struct('<B3xI')
_POSE_FIELDS = ('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw', 'ax', 'ay', 'az', 'aqx', 'aqy', 'aqz', 'aqw')
_VARIANCE_FIELDS = tuple(name for name in CORNER_COVARIANCE_FIELDS if name[-2:] in ('uu', 'vv'))


def cloud(rows: npt.NDArray[Any], head: Header) -> PointCloud2:
    """PointCloud2 with one point per row of a structured array; the fields are those of its dtype."""
    return PointCloud2(
        header=head,
        height=1,
        width=len(rows),
        fields=_fields(rows.dtype),
        is_bigendian=False,
        point_step=rows.dtype.itemsize,
        row_step=rows.dtype.itemsize * len(rows),
        data=data_bytes(rows),
        is_dense=True,
    )


@lru_cache(maxsize=16)
def _fields(dtype: 'np.dtype[Any]') -> list[PointField]:
    """PointFields of a dtype, cached: making 40 messages takes longer than the rest of a cloud."""
    layout: Mapping[str, Any] = dtype.fields or {}
    return [
        PointField(name=name, offset=layout[name][1], datatype=_POINT_CODES[layout[name][0].str[1:]], count=1)
        for name in dtype.names or ()
    ]


def cloud_rows(message: PointCloud2, dtype: 'np.dtype[Any]', optional: Iterable[str] = ()) -> npt.NDArray[Any]:
    """Rows (N,) of ``dtype`` from a cloud, fields looked up by name; missing ``optional`` ones are 0.

    Raises
    ------
    InputError
        A missing field, a float field for an integer one, sizes that contradict the data, or too many rows.
    """
    fields = {field.name: field for field in message.fields}
    names = [name for name in dtype.names or () if name in fields]
    missing = set(dtype.names or ()) - set(names) - set(optional)
    if missing:
        raise InputError(f'cloud without field {", ".join(sorted(missing))}')
    count = int(message.width) * int(message.height)
    if count > _MOST_ROWS:
        raise InputError(f'cloud of {count} points, not {_MOST_ROWS} at most')
    places = tuple((name, fields[name].offset, fields[name].datatype) for name in names)
    source = _source_dtype(places, int(message.point_step), big_endian=bool(message.is_bigendian))
    if message.row_step != message.point_step * message.width or len(message.data) < count * message.point_step:
        raise InputError(f'cloud of {count} points of {message.point_step} bytes has {len(message.data)} bytes')
    if source == dtype:
        # The layout of this package's nodes: no conversion.
        return np.frombuffer(message.data, dtype, count).copy()
    result = np.zeros(count, dtype)
    if count:
        points = np.frombuffer(message.data, source, count)
        with np.errstate(over='ignore', invalid='ignore'):
            for name in names:
                if dtype[name].kind == 'u' and source[name].kind == 'f':
                    raise InputError(f'cloud whose field {name} is no whole number')
                result[name] = points[name]
    return result


@lru_cache(maxsize=16)
def _source_dtype(places: tuple[tuple[str, int, int], ...], step: int, *, big_endian: bool) -> 'np.dtype[Any]':
    """The dtype of points of ``step`` bytes; ``places`` are name, offset and datatype of each field."""
    order = '>' if big_endian else '<'
    try:
        formats = [np.dtype(order + _POINT_TYPES[kind]) for _, _, kind in places]
        names, offsets = [name for name, _, _ in places], [offset for _, offset, _ in places]
        # numpy adds them in 32 bits: on overflow it would read outside the points.
        if any(offset + kind.itemsize > step for offset, kind in zip(offsets, formats, strict=True)):
            raise ValueError
        return np.dtype({'names': names, 'formats': formats, 'offsets': offsets, 'itemsize': step})
    except (KeyError, ValueError, OverflowError):
        raise InputError(f'cloud with fields outside its points of {step} bytes') from None


class CloudBytes:
    """Serialises clouds of one dtype: with many fields ten times faster than through a message."""

    def __init__(self, dtype: 'np.dtype[Any]') -> None:
        self._dtype = dtype
        # Expected bytes from the fields to point_step; ``meant`` masks the padding, which may hold anything.
        layout, meant = struct.pack('<I', len(dtype.names or ())), b'\xff' * 4
        for field in _fields(dtype):
            name = field.name.encode() + b'\x00'
            gap = bytes(-len(name) % 4)
            layout += struct.pack('<I', len(name)) + name + gap + _PLACE.pack(field.offset, field.datatype, 1)
            meant += b'\xff' * (4 + len(name)) + gap + _PLACE.pack(0xFFFFFFFF, 0xFF, 0xFFFFFFFF)
        self._layout = np.frombuffer(layout + _POINT.pack(0, dtype.itemsize), np.uint8)
        self._meant = np.frombuffer(meant + _POINT.pack(0xFF, 0xFFFFFFFF), np.uint8)

    def message(self, rows: npt.NDArray[Any], head: Header) -> bytes:
        """:func:`cloud`, serialised."""
        begin = bytes(serialize_message(head))
        begin += bytes(-len(begin) % 4)
        data, sizes = rows.tobytes(), _TWO.pack(1, len(rows))
        return b''.join((begin, sizes, self._layout.tobytes(), _TWO.pack(len(data), len(data)), data, b'\x01'))

    def rows(self, message: bytes) -> npt.NDArray[Any] | None:
        """Rows (N,) of a serialised cloud; None if its layout differs or its sizes contradict its data."""
        try:
            begin = message_bytes.behind_header(message)
            height, width = _TWO.unpack_from(message, begin)
            layout = np.frombuffer(message, np.uint8, len(self._layout), begin + _TWO.size)
            behind = begin + _TWO.size + len(layout)
            row_step, length = _TWO.unpack_from(message, behind)
        except (struct.error, ValueError):
            return None
        count, step = height * width, self._dtype.itemsize
        fits = count <= _MOST_ROWS and row_step == width * step and count * step <= length
        whole = behind + _TWO.size + length <= len(message)
        if not (fits and whole and np.array_equal(layout & self._meant, self._layout)):
            return None
        return np.frombuffer(message, self._dtype, count, behind + _TWO.size)


#: The layout of this package's detector.
MARKER_CLOUDS = CloudBytes(MARKER_DTYPE)


def stamped_markers(message: bytes) -> tuple[int, Markers]:
    """Stamp [ns] and rows of a cloud: see :func:`markers`.

    Raises
    ------
    InputError
        As :func:`markers`, or bytes that are not a PointCloud2.
    """
    stamp, rows = message_bytes.stamp_ns(message, 'markers', longest=len(message)), MARKER_CLOUDS.rows(message)
    return stamp, markers(message_bytes.read(message, PointCloud2, 'markers')) if rows is None else _checked(rows)


def markers(message: PointCloud2) -> Markers:
    """Rows of :data:`MARKER_DTYPE`; without corner covariances in the cloud they are those of ``sigma_px``.

    Raises
    ------
    InputError
        A missing field, inconsistent sizes, or invalid corners, covariances or poses.
    """
    rows = cloud_rows(message, MARKER_DTYPE, optional=LATER_MARKER_FIELDS)
    if not {field.name for field in message.fields}.issuperset(CORNER_COVARIANCE_FIELDS):
        with np.errstate(over='ignore'):
            variance = rows['sigma_px'] ** 2
        for corner in range(4):
            rows[f'c{corner}uu'] = rows[f'c{corner}vv'] = variance
    return _checked(rows)


def _checked(rows: Markers) -> Markers:
    """The markers, after validation of corners, variances, errors and poses."""
    variances = columns(rows, _VARIANCE_FIELDS)
    if not np.abs(columns(rows, CORNER_FIELDS)).max(initial=0.0) < LARGEST_COORDINATE:
        raise InputError('markers with corners that are not finite or far outside any image')
    if not ((variances > _SMALLEST_CORNER_VARIANCE).all() and (variances < LARGEST_VARIANCE).all()):
        raise InputError('markers with corners whose variance is not positive or beyond all bounds')
    if not (np.abs(rows['detector_px']) < LARGEST_COORDINATE).all():
        raise InputError('markers with errors of the detector that are not finite or beyond all bounds')
    # A marker without a pose has NaN there.
    if (np.abs(columns(rows, _POSE_FIELDS)) > LARGEST_COORDINATE).any():
        raise InputError('markers with poses beyond all bounds')
    if rows['id'].max(initial=0) > LARGEST_ID:
        raise InputError(f'marker {rows["id"].max()}, beyond any dictionary')
    return rows


def marker_poses(rows: Markers, head: Header) -> PoseArray:
    """Poses of the markers in the camera frame, for display."""
    return PoseArray(header=head, poses=[pose_of_row(row) for row in rows])


def map_poses(message: PointCloud2) -> tuple[dict[int, tuple[FloatArray, float]], frozenset[int]]:
    """ID to T_map_marker (4, 4) and side [m] of the markers of a ``marker_map`` cloud; IDs that are in quarantine.

    Raises
    ------
    InputError
        A missing field, inconsistent sizes, or a marker with an invalid pose or side.
    """
    rows = cloud_rows(message, MAP_DTYPE)
    positions, quaternions = columns(rows, ('x', 'y', 'z')), columns(rows, ('qx', 'qy', 'qz', 'qw'))
    possible = (np.abs(positions) < LARGEST_COORDINATE).all(axis=-1)
    possible &= np.abs(np.linalg.norm(quaternions, axis=-1) - 1.0) < NORM_TOLERANCE
    possible &= (rows['size'] > 0.0) & (rows['size'] < _LARGEST_MARKER)
    if not possible.all():
        raise InputError(f'marker_map with marker {rows["id"][~possible][0]} of an impossible pose or size')
    return places_of(rows)
