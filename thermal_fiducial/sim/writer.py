"""A simulated flight as a rosbag2 with everything that a replay of it needs beside it."""

from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
import multiprocessing
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any

import cv2
import numpy as np
from rosbags.typesys import get_typestore, Stores
import yaml

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagWriter, CAMERA_INFO_TOPIC, IMAGE_TOPIC, IMU_TOPIC, TRUTH_TOPIC
from thermal_fiducial.files.trajectory import save_tum
from thermal_fiducial.sim.camera import CHUNK, FlightPlan, SimFrame, ThermalCamera
from thermal_fiducial.sim.scenario import Scenario
from thermal_fiducial.sim.scene import Marker

#: A frame reaches the recorder this long after its stamp, an IMU sample and the truth sooner [ns].
IMAGE_DELAY_NS = 25_000_000
IMU_DELAY_NS = 1_000_000

_TYPES = get_typestore(Stores.ROS2_JAZZY).types
_Time, _Header = _TYPES['builtin_interfaces/msg/Time'], _TYPES['std_msgs/msg/Header']
_Vector3, _Point = _TYPES['geometry_msgs/msg/Vector3'], _TYPES['geometry_msgs/msg/Point']
_Quaternion, _Pose = _TYPES['geometry_msgs/msg/Quaternion'], _TYPES['geometry_msgs/msg/Pose']
_Twist = _TYPES['geometry_msgs/msg/Twist']
_PoseWithCovariance = _TYPES['geometry_msgs/msg/PoseWithCovariance']
_TwistWithCovariance = _TYPES['geometry_msgs/msg/TwistWithCovariance']
_Image, _CameraInfo = _TYPES['sensor_msgs/msg/Image'], _TYPES['sensor_msgs/msg/CameraInfo']
_Region, _Imu = _TYPES['sensor_msgs/msg/RegionOfInterest'], _TYPES['sensor_msgs/msg/Imu']
_Odometry = _TYPES['nav_msgs/msg/Odometry']

CAMERA_FRAME, BODY_FRAME, MAP_FRAME = 'thermal_camera_optical', 'base_link', 'map'


@dataclass(frozen=True)
class _Event:
    """A message on its way into the bag."""

    arrival_ns: int
    topic: str
    message: Any


def write_flight(
    out: Path,
    flight: FlightPlan,
    storage: str = 'mcap',
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Simulate ``flight`` into the new folder ``out``: it is there whole, or not at all.

    Parameters
    ----------
    out : a rosbag2 with ``ground_truth.tum``, ``ground_truth_corners.csv``, ``map_true.yaml``, ``map_one.yaml`` (one
        fixed marker, the start of a map) and ``params.yaml`` (the rig) in it
    storage : mcap or sqlite3
    workers : processes that render; the bytes don't depend on it
    progress : called with the number of frames that are done, chunk by chunk

    Raises
    ------
    InputError
        ``out`` exists or cannot be written, or the scenario is impossible.
    """
    if out.exists():
        raise InputError(f'{out} exists already')
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f'.{out.name}-', dir=out.parent))
    except OSError as error:
        raise InputError(f'{out}: {error.strerror}') from None
    try:
        _write_bag(folder / out.name, flight, storage, workers, progress or (lambda _: None))
        _write_side_files(folder / out.name, flight)
        (folder / out.name).rename(out)
    finally:
        shutil.rmtree(folder)


def _write_bag(folder: Path, flight: FlightPlan, storage: str, workers: int, progress: Callable[[int], None]) -> None:
    corners = ['stamp_ns,id,u0,v0,u1,v1,u2,v2,u3,v3\n']
    body = _body_events(flight)
    with BagWriter(folder, storage) as bag:
        pending = next(body, None)
        for frames in _chunks(flight, workers):
            for frame in frames:
                arrival = frame.stamp_ns + IMAGE_DELAY_NS
                while pending is not None and pending.arrival_ns <= arrival:
                    bag.write(pending.topic, pending.arrival_ns, pending.message)
                    pending = next(body, None)
                bag.write(CAMERA_INFO_TOPIC, arrival, _camera_info(flight.scenario, frame.stamp_ns))
                bag.write(IMAGE_TOPIC, arrival, _image(frame))
                corners += [_corner_line(frame, marker_id) for marker_id in frame.corners_px]
            progress(CHUNK)
        while pending is not None:
            bag.write(pending.topic, pending.arrival_ns, pending.message)
            pending = next(body, None)
    (folder / 'ground_truth_corners.csv').write_text(''.join(corners), encoding='ascii')


def _corner_line(frame: SimFrame, marker_id: int) -> str:
    numbers = ','.join(f'{value:.4f}' for value in frame.corners_px[marker_id].ravel())
    return f'{frame.stamp_ns},{marker_id},{numbers}\n'


# --- rendering in chunks ------------------------------------------------------------------------------

_worker_flight: list[FlightPlan] = []


def _start_worker(flight: FlightPlan) -> None:
    cv2.setNumThreads(1)
    _worker_flight[:] = [flight]


def _render_chunk(start: int) -> list[SimFrame]:
    flight = _worker_flight[0]
    return list(_camera(flight).frames(start, min(start + CHUNK, flight.frame_count)))


_cameras: dict[int, ThermalCamera] = {}


def _camera(flight: FlightPlan) -> ThermalCamera:
    """The process' one camera: its tables of rays take a second to make."""
    if id(flight) not in _cameras:
        _cameras.clear()
        _cameras[id(flight)] = ThermalCamera(flight)
    return _cameras[id(flight)]


def _chunks(flight: FlightPlan, workers: int) -> Iterator[list[SimFrame]]:
    starts = range(0, flight.frame_count, CHUNK)
    if workers <= 1:
        camera = ThermalCamera(flight)
        for start in starts:
            yield list(camera.frames(start, min(start + CHUNK, flight.frame_count)))
        return
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
    context = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(workers, context, _start_worker, (flight,)) as pool:
        yield from pool.map(_render_chunk, starts)


# --- messages -----------------------------------------------------------------------------------------


def _header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return _Header(stamp=_Time(sec=seconds, nanosec=nanoseconds), frame_id=frame_id)


def _image(frame: SimFrame) -> Any:
    height, width = frame.counts.shape
    return _Image(
        header=_header(frame.stamp_ns, CAMERA_FRAME),
        height=height,
        width=width,
        encoding='mono16',
        is_bigendian=0,
        step=2 * width,
        data=np.ascontiguousarray(frame.counts, dtype='<u2').view(np.uint8).ravel(),
    )


def _camera_info(scenario: Scenario, stamp_ns: int) -> Any:
    lens = scenario.lens
    return _CameraInfo(
        header=_header(stamp_ns, CAMERA_FRAME),
        height=lens.height,
        width=lens.width,
        distortion_model=lens.model,
        d=np.array(lens.distortion),
        k=lens.matrix.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([lens.matrix, np.zeros((3, 1))]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=_Region(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _body_events(flight: FlightPlan) -> Iterator[_Event]:
    """IMU samples and true odometry."""
    scenario = flight.scenario
    times, stamps = flight.imu_stamps()
    trajectory = scenario.trajectory(flight.seconds, flight.seed)
    record, motion = scenario.imu.sample(trajectory, times, stamps, flight.seed), trajectory(times)
    noise, rate = scenario.imu.noise, scenario.imu.rate
    rate_covariance = np.eye(3).ravel() * noise.gyroscope_noise_density**2 * rate
    force_covariance = np.eye(3).ravel() * noise.accelerometer_noise_density**2 * rate
    unknown = np.array([-1.0] + [0.0] * 8)
    no_rotation = _Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    quaternions = motion.rotation.as_quat()
    velocities = motion.rotation.inv().apply(motion.velocity)
    for n, stamp in enumerate(stamps):
        imu = _Imu(
            header=_header(stamp, BODY_FRAME),
            orientation=no_rotation,
            orientation_covariance=unknown,
            angular_velocity=_vector(record.angular_velocity[n]),
            angular_velocity_covariance=rate_covariance,
            linear_acceleration=_vector(record.linear_acceleration[n]),
            linear_acceleration_covariance=force_covariance,
        )
        yield _Event(int(stamp) + IMU_DELAY_NS, IMU_TOPIC, imu)
        pose = _Pose(position=_point(motion.position[n]), orientation=_quaternion(quaternions[n]))
        twist = _Twist(linear=_vector(velocities[n]), angular=_vector(motion.angular_velocity_body[n]))
        odometry = _Odometry(
            header=_header(stamp, MAP_FRAME),
            child_frame_id=BODY_FRAME,
            pose=_PoseWithCovariance(pose=pose, covariance=np.zeros(36)),
            twist=_TwistWithCovariance(twist=twist, covariance=np.zeros(36)),
        )
        yield _Event(int(stamp) + IMU_DELAY_NS, TRUTH_TOPIC, odometry)


def _vector(v: np.ndarray) -> Any:
    return _Vector3(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _point(v: np.ndarray) -> Any:
    return _Point(x=float(v[0]), y=float(v[1]), z=float(v[2]))


def _quaternion(q: np.ndarray) -> Any:
    return _Quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3]))


# --- what a replay needs beside the bag ---------------------------------------------------------------


def _write_side_files(folder: Path, flight: FlightPlan) -> None:
    scenario = flight.scenario
    times, stamps = flight.imu_stamps()
    motion = scenario.trajectory(flight.seconds, flight.seed)(times)
    save_tum(folder / 'ground_truth.tum', stamps.tolist(), motion.position, motion.rotation.as_quat())
    _dump(folder / 'map_true.yaml', _marker_map(scenario, scenario.markers))
    _dump(folder / 'map_one.yaml', _marker_map(scenario, scenario.markers[:1]))
    _dump(folder / 'params.yaml', {'/**': {'ros__parameters': _parameters(scenario)}})


def _dump(path: Path, content: dict[str, Any]) -> None:
    path.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120), encoding='utf-8')


def _marker_map(scenario: Scenario, markers: tuple[Marker, ...]) -> dict[str, Any]:
    entries = [
        {
            'id': marker.id,
            'size': marker.size,
            'fixed': True,
            'position': [float(value) for value in marker.position],
            'orientation': [round(float(value), 12) for value in marker.rotation.as_quat()],
        }
        for marker in markers
    ]
    head = {'format': 'thermal_fiducial/marker_map', 'version': 1, 'frame_id': MAP_FRAME}
    return {**head, 'dictionary': scenario.dictionary, 'markers': entries}


def _parameters(scenario: Scenario) -> dict[str, Any]:
    """The rig under the names that the nodes use."""
    sizes = [marker.size for marker in scenario.markers]
    common = max(set(sizes), key=sizes.count)
    overrides = [f'{marker.id}:{marker.size}' for marker in scenario.markers if marker.size != common]
    noise = scenario.imu.noise
    return {
        'dictionary': scenario.dictionary,
        'marker_size': common,
        **({'marker_size_overrides': overrides} if overrides else {}),
        'camera_position': [float(value) for value in scenario.camera_position],
        'camera_orientation': [float(value) for value in scenario.camera_orientation],
        'camera_time_offset': float(scenario.camera_time_offset),
        'imu': {item.name: getattr(noise, item.name) for item in fields(noise)},
    }
