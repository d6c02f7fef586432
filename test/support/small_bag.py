"""A bag that is made in a second: four markers on a wall, warped flat pictures, a robot that sways in front of it.

Good enough to run everything that handles bags; no measure of accuracy, which is the simulator's matter.
"""

import dataclasses
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import cv2
import numpy as np
from rosbags.typesys import get_typestore, Stores
import yaml

from support.flights import Motion
from support.opencv import draw_marker
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.se3 import apply, inverse, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import MARKER_DTYPE
from thermal_fiducial.files import bag_messages
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import CAMERA_INFO_TOPIC, COMPRESSED_TOPIC, IMAGE_TOPIC, IMU_TOPIC
from thermal_fiducial.files.marker_map import save_map

START_NS = 1_700_000_000_000_000_000
CAMERA = Camera(640, 512, np.array([[745.0, 0.0, 319.5], [0.0, 745.0, 255.5], [0.0, 0.0, 1.0]]))
T_BODY_CAMERA = transform([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], [0.1, 0.0, 0.0])
R_MAP_MARKER = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
SIZE = 0.3
#: ID to its centre in the map
CENTRES = {0: (2.5, 0.32, 0.26), 1: (2.5, -0.28, 0.3), 2: (2.5, 0.28, -0.3), 3: (2.5, -0.32, -0.26)}
PARAMETERS = {'marker_size': SIZE, 'camera_position': [0.1, 0.0, 0.0], 'camera_orientation': [-0.5, 0.5, -0.5, 0.5]}
_COLD, _HOT, _NOISE = 7000, 7600, 4.0
_SHEET_BITS, _PIXELS_PER_BIT = 10, 40
# Of the sheet [px]: 0.8 pixels of the images, where a bit is about 16 wide.
_BLUR = 2.0

_TYPES = get_typestore(Stores.ROS2_JAZZY).types


@dataclass(frozen=True)
class Raw:
    """Bytes that are said to be a message."""

    msgtype: str
    data: bytes


def replaced(message, **fields):
    """A copy of a message with other fields."""
    return type(message)(
        **{
            **{
                item.name: getattr(message, item.name)
                for item in dataclasses.fields(message)
                if item.name != '__msgtype__'
            },
            **fields,
        }
    )


@dataclass
class Recording:
    """What is to be written: (bag stamp, topic, message), and the truth."""

    events: list[tuple[int, str, Any]] = field(default_factory=list)

    def of(self, topic):
        """The messages on a topic."""
        return [message for _, name, message in self.events if name == topic]

    def without(self, topic):
        return Recording([event for event in self.events if event[1] != topic])

    def renamed(self, rename):
        return Recording([(stamp, rename(topic), message) for stamp, topic, message in self.events])

    def changed(self, topic, change):
        """The same with ``change`` of each message on a topic."""
        return Recording([(stamp, name, change(m) if name == topic else m) for stamp, name, m in self.events])

    def compressed(self):
        """The same with its images compressed."""
        return Recording([
            (stamp, COMPRESSED_TOPIC, compressed(message)) if topic == IMAGE_TOPIC else (stamp, topic, message)
            for stamp, topic, message in self.events
        ])  # fmt: skip

    def write(self, path, storage='mcap'):
        with BagWriter(path, storage) as bag:
            for stamp, topic, message in sorted(self.events, key=lambda event: event[0]):
                if isinstance(message, Raw):
                    bag.write(topic, stamp, message.data, message.msgtype)
                else:
                    bag.write(topic, stamp, message)
        return path


def without_a_corner(cloud):
    """The bytes of a cloud of markers, a corner of whose last one is no number."""
    data = bytearray(cloud)
    # The rows end the message, but for a byte.
    begin = len(data) - 1 - MARKER_DTYPE.itemsize + MARKER_DTYPE.fields['u0'][1]
    data[begin : begin + 4] = np.array(np.nan, '<f4').tobytes()
    return bytes(data)


def true_pose(t):
    """T_map_body (4, 4) at ``t`` [s]."""
    return _motion().pose(t)


def true_imu(t):
    """Angular velocity and specific force (6,) at ``t`` [s]."""
    return _motion().imu(t)


def _motion():
    # Small and slow, so that the markers stay in view whatever the seed.
    return Motion.random(np.random.default_rng(7), speed=0.12, turn=0.05)


def map_of(ids):
    """The true map of markers ``ids``, all fixed."""
    markers = {i: MapMarker(i, SIZE, True, transform(R_MAP_MARKER, CENTRES[i])) for i in ids}
    return MarkerMap(markers)


def recording(seconds=3.0, seed=0):
    """Frames at 30 Hz, camera_info with each, IMU at 200 Hz."""
    pictures = _pictures(seed)
    result = Recording()
    for k in range(round(200 * seconds)):
        stamp = START_NS + k * 5_000_000
        result.events.append((stamp + 1_000_000, IMU_TOPIC, imu(stamp, _motion().imu(k * 0.005))))
    for k in range(round(30 * seconds)):
        stamp = START_NS + 2_000_000 + k * 33_333_333
        result.events.append((stamp + 20_000_000, CAMERA_INFO_TOPIC, camera_info(stamp)))
        result.events.append((stamp + 20_000_001, IMAGE_TOPIC, image(stamp, pictures[k])))
    return result


class _Pictures:
    """The frames of a recording, each made when it is first asked for and kept for the next recording."""

    def __init__(self, seed):
        self._rng, self._made = np.random.default_rng(seed), []

    def __getitem__(self, k):
        while len(self._made) <= k:
            seconds = (2_000_000 + len(self._made) * 33_333_333) * 1e-9
            self._made.append(frame(true_pose(seconds), self._rng))
            self._made[-1].flags.writeable = False
        return self._made[k]


_pictures = cache(_Pictures)


def side_files(folder, ids=(0,)):
    """``map.yaml`` with markers ``ids`` and ``params.yaml``, in ``folder``; their paths."""
    save_map(folder / 'map.yaml', map_of(ids))
    (folder / 'params.yaml').write_text(yaml.safe_dump({'/**': {'ros__parameters': PARAMETERS}}))
    return folder / 'map.yaml', folder / 'params.yaml'


def frame(T_map_body, rng):
    """Counts (512, 640): hot stencils on a cold wall, flat pictures warped into place."""
    T_camera_map = inverse(T_map_body @ T_BODY_CAMERA)
    picture = np.full((CAMERA.height, CAMERA.width), _COLD, np.float32)
    for marker_id, centre in CENTRES.items():
        T_camera_marker = T_camera_map @ transform(R_MAP_MARKER, centre)
        uv = CAMERA.project(apply(T_camera_marker, marker_corners(_SHEET_BITS * SIZE / 6)))
        n = _SHEET_BITS * _PIXELS_PER_BIT - 0.5
        corners = np.array([[-0.5, -0.5], [n, -0.5], [n, n], [-0.5, n]], np.float32)
        H = cv2.getPerspectiveTransform(corners, uv.astype(np.float32))
        picture += cv2.warpPerspective(_sheet(marker_id), H, (CAMERA.width, CAMERA.height))
    return np.rint(picture + rng.normal(0.0, _NOISE, picture.shape)).astype(np.uint16)


@cache
def _sheet(marker_id):
    """What a marker adds to the wall; blurred before it is warped, for sharp edges would come out in steps."""
    # The plate is one bit wider all round than the black square of six bits, the sheet one wider than the plate.
    sheet = np.zeros((_SHEET_BITS, _SHEET_BITS), np.float32)
    sheet[1:-1, 1:-1] = 1.0
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    sheet[2:-2, 2:-2] = draw_marker(dictionary, marker_id, 6) / 255.0
    sharp = np.kron(sheet, np.ones((_PIXELS_PER_BIT, _PIXELS_PER_BIT), np.float32))
    return (_HOT - _COLD) * cv2.GaussianBlur(sharp, (0, 0), _BLUR)


def header(stamp_ns, frame_id):
    seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
    stamp = _TYPES['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
    return _TYPES['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id)


def image(stamp_ns, counts):
    height, width = counts.shape
    return _TYPES['sensor_msgs/msg/Image'](
        header=header(stamp_ns, 'thermal_camera_optical'),
        height=height,
        width=width,
        encoding='mono16',
        is_bigendian=0,
        step=2 * width,
        data=counts.astype('<u2').view(np.uint8).ravel(),
    )


def compressed(message):
    """An image as image_transport's plugin ``compressed`` records it with ``format: png``."""
    pixels = np.frombuffer(message.data.tobytes(), '<u2').reshape(message.height, message.width)
    data = cv2.imencode('.png', pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    return _TYPES['sensor_msgs/msg/CompressedImage'](
        header=message.header, format='mono16; png compressed mono16', data=data.ravel()
    )


def camera_info(stamp_ns, camera=CAMERA):
    return bag_messages.camera_info(stamp_ns, camera)


def imu(stamp_ns, values):
    vector, covariance = _TYPES['geometry_msgs/msg/Vector3'], np.zeros(9)
    return _TYPES['sensor_msgs/msg/Imu'](
        header=header(stamp_ns, 'base_link'),
        orientation=_TYPES['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *covariance[1:]]),
        angular_velocity=vector(*(float(value) for value in values[:3])),
        angular_velocity_covariance=covariance,
        linear_acceleration=vector(*(float(value) for value in values[3:])),
        linear_acceleration_covariance=covariance,
    )
