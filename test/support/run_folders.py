"""A made-up run folder whose errors are known."""

import csv
import json
from pathlib import Path

import numpy as np
from rosbags.typesys import get_typestore, Stores

from thermal_fiducial.core.filter.belief import PoseUpdate
from thermal_fiducial.core.geometry.se3 import quaternion_from_rotation, so3_exp, transform
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.bags import TRUTH_TOPIC
from thermal_fiducial.files.innovations import innovations_text
from thermal_fiducial.files.marker_map import save_map
from thermal_fiducial.files.trajectory_file import save_tum
from thermal_fiducial.report.output_bag import RecordedOutput
from thermal_fiducial.report.run_folder import Detections, Run
from thermal_fiducial.report.trajectory import Trajectory

START_NS = 1_700_000_000_000_000_000
FUSED_SIGMA = np.array([2e-3, 2e-3, 2e-3, 3e-4, 3e-4, 3e-4])
FIDUCIAL_SIGMA = 5.0 * FUSED_SIGMA
FUSED_DELAY_NS, CAMERA_DELAY_NS = 1_000_000, 25_000_000
#: Length of trajectories.
SECONDS = 12.0
NOTHING = Detections(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 4, 2)), np.zeros(0))


def true_pose(t):
    """T_map_body (N, 4, 4) at times (N,) [s]: a figure of eight that looks at the wall."""
    p = np.stack([0.8 * np.sin(0.5 * t), 1.2 * np.sin(0.25 * t), 1.2 + 0.3 * np.cos(0.4 * t)], axis=-1)
    phi = np.stack([0.06 * np.sin(1.1 * t), 0.05 * np.cos(0.9 * t), 0.4 * np.sin(0.3 * t)], axis=-1)
    return transform(so3_exp(phi), p)


def trajectory(rate_hz, seconds=SECONDS):
    """The true poses at a rate."""
    stamps = START_NS + np.arange(0, round(seconds * 1e9), round(1e9 / rate_hz))
    return Trajectory(stamps, true_pose((stamps - START_NS) * 1e-9))


def run_of(tmp_path, fused, fiducial, **more):
    """A run of two trajectories, as if read from the folder."""
    empty = {'latencies': {}, 'output': RecordedOutput(), 'marker_map': None, 'summary': {}, 'truth': trajectory(100.0)}
    return Run(tmp_path, fused, fiducial, **({'detections': NOTHING} | empty | more))


def disturbed(T, sigma, rng):
    """Poses whose errors, in the convention of the covariances, have standard deviations ``sigma`` (6,)."""
    d = rng.normal(size=(len(T), 6)) * sigma
    return transform(so3_exp(-d[:, 3:]) @ T[:, :3, :3], T[:, :3, 3] - d[:, :3])


def write_poses(path, stamps, T):
    save_tum(path, stamps.tolist(), T[:, :3, 3], quaternion_from_rotation(T[:, :3, :3]))


def make_run(
    folder: Path, seconds=20.0, seed=0, gap=(8.0, 10.0), shutter=(14.2, 14.7), with_output=True, with_truth=True,
    said_by_ns=0,
):  # fmt: skip
    """Write a run folder; markers are out of view in ``gap``, the camera's shutter is closed in ``shutter`` [s].

    ``said_by_ns``: how far the clock of the diagnostics' stamps is ahead of that of the bag.
    """
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    stamps = START_NS + np.arange(0, int(seconds * 1e9), 5_000_000)
    frames = START_NS + np.arange(0, int(seconds * 1e9), 33_333_333)
    frames = outside(frames, shutter)
    looked_at, frames = frames, outside(frames, gap)
    fused = disturbed(true_pose((stamps - START_NS) * 1e-9), FUSED_SIGMA, rng)
    write_poses(folder / 'fused.tum', stamps, fused)
    fiducial = disturbed(true_pose((frames - START_NS) * 1e-9), FIDUCIAL_SIGMA, rng)
    write_poses(folder / 'fiducial.tum', frames, fiducial)
    if with_truth:
        known = START_NS + np.arange(0, int(seconds * 1e9) + 1, 10_000_000)
        write_poses(folder / 'truth.tum', known, true_pose((known - START_NS) * 1e-9))
    write_detections(folder / 'detections.csv', frames, rng)
    rows = [
        f'imu_to_pose,{stamp},{value:.3f}' for stamp, value in zip(stamps, rng.uniform(1, 3, len(stamps)), strict=True)
    ]
    rows += [
        f'image_to_camera_pose,{stamp},{value:.3f}'
        for stamp, value in zip(frames, rng.uniform(8, 12, len(frames)), strict=True)
    ]
    (folder / 'latency.csv').write_text('\n'.join(['kind,stamp_ns,latency_ms', *rows]) + '\n')
    save_map(folder / 'marker_map.yaml', wall())
    (folder / 'summary.json').write_text(
        json.dumps({'bag': 'made_up', 'transport': 'processes', 'mode': 'mapping', 'duration_s': seconds})
    )
    if with_output:
        write_output(folder / 'output', stamps, fused, looked_at, frames, shutter, said_by_ns)
    return folder


def outside(stamps, span):
    """The stamps that do not lie in ``span`` [s]."""
    t = (stamps - START_NS) * 1e-9
    return stamps[~((t > span[0]) & (t < span[1]))]


def wall():
    R = np.array([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # faces -x, upright
    places = [(3.0, 1.5 - i % 4, 0.9 + 0.7 * (i // 4)) for i in range(8)]
    return MarkerMap(
        {
            i + 2: MapMarker(i + 2, 0.3, i == 0, transform(R, p), observations=0 if i == 7 else 9)
            for i, p in enumerate(places)
        }
    )


def write_detections(path, frames, rng):
    names = [f'{axis}{corner}' for corner in range(4) for axis in 'uv']
    with path.open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(['stamp_ns', 'id', *names, 'sigma_px'])
        for k, stamp in enumerate(frames):
            for marker in range(2, 9):
                if (k // 60 + marker) % 3:
                    writer.writerow([stamp, marker, *np.round(rng.uniform(0, 500, 8), 3), 0.03])


def write_output(path, stamps, fused, looked_at, frames, shutter, said_by_ns=0):
    """What nodes published.

    ``pose`` a millisecond late with the right covariance; ``markers`` and ``camera_pose`` 25 ms late; diagnostics with
    the innovations of 30 poses in each, one refused, and the frames that the shutter withheld.
    """
    types = get_typestore(Stores.ROS2_JAZZY).types
    header, time = types['std_msgs/msg/Header'], types['builtin_interfaces/msg/Time']
    covariance = np.diag(FUSED_SIGMA**2).ravel()
    innovations = made_up_innovations()
    q = quaternion_from_rotation(fused[:, :3, :3])
    with BagWriter(path) as bag:
        for k, stamp in enumerate(stamps.tolist()):
            head = header(stamp=time(*divmod(stamp, 1_000_000_000)), frame_id='map')
            point = types['geometry_msgs/msg/Point'](*fused[k, :3, 3])
            pose = types['geometry_msgs/msg/Pose'](point, types['geometry_msgs/msg/Quaternion'](*q[k]))
            with_covariance = types['geometry_msgs/msg/PoseWithCovariance'](pose, covariance)
            message = types['geometry_msgs/msg/PoseWithCovarianceStamped'](head, with_covariance)
            bag.write('pose', stamp + FUSED_DELAY_NS, message)
            if k == 0:
                write_frames(bag, types, looked_at, frames, message)
            if k % 200 == 0:
                status = types['diagnostic_msgs/msg/DiagnosticStatus']
                pairs = types['diagnostic_msgs/msg/KeyValue']
                values = [pairs(key='lost', value='False'), pairs(key='innovations', value=next(innovations))]
                words = f'running for {k / 200:.1f} s'
                withheld = 12 if stamp - START_NS > shutter[1] * 1e9 else 0
                shut = [pairs(key='withheld: settling after FFC', value=str(withheld))]
                items = [
                    status(level=0, name='pose_ekf', message=words, hardware_id='', values=values),
                    status(level=1, name='tau2_camera', message='FFC', hardware_id='', values=shut),
                ]
                said = header(stamp=time(*divmod(stamp + said_by_ns, 1_000_000_000)), frame_id='')
                bag.write('/diagnostics', stamp, types['diagnostic_msgs/msg/DiagnosticArray'](said, items))


def write_frames(bag, types, looked_at, frames, pose):
    """``markers`` of each frame, empty clouds, and ``camera_pose`` of those that gave one."""
    time, header = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    for stamp in looked_at.tolist():
        head = header(stamp=time(*divmod(stamp, 1_000_000_000)), frame_id='thermal_camera_optical')
        nothing = np.zeros(0, np.uint8)
        bag.write('markers', stamp + CAMERA_DELAY_NS, types['sensor_msgs/msg/PointCloud2'](
            head, 1, 0, [], False, 16, 0, nothing, True))  # fmt: skip
        if stamp in frames:
            bag.write('camera_pose', stamp + CAMERA_DELAY_NS, type(pose)(head, pose.pose))


def made_up_innovations():
    """What the filter publishes each second."""
    rng = np.random.default_rng(1)
    for second in range(1_000_000):
        stamps = (START_NS + second * 1_000_000_000 + np.arange(30) * 33_333_333).tolist()
        nis = [*rng.chisquare(6, 29), 99.0]
        yield innovations_text(
            PoseUpdate(stamp, value < 50.0, '', value) for stamp, value in zip(stamps, nis, strict=True)
        )


def write_truth_bag(path, seconds=20.0):
    """A bag with nothing but ground truth."""
    types = get_typestore(Stores.ROS2_JAZZY).types
    time, header = types['builtin_interfaces/msg/Time'], types['std_msgs/msg/Header']
    vector, zeros = types['geometry_msgs/msg/Vector3'], np.zeros(36)
    with BagWriter(path) as bag:
        for stamp in range(START_NS, START_NS + int(seconds * 1e9) + 1, 10_000_000):
            T = true_pose(np.array([(stamp - START_NS) * 1e-9]))[0]
            q = quaternion_from_rotation(T[:3, :3])
            pose = types['geometry_msgs/msg/Pose'](
                types['geometry_msgs/msg/Point'](*T[:3, 3]), types['geometry_msgs/msg/Quaternion'](*q)
            )
            twist = types['geometry_msgs/msg/Twist'](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
            message = types['nav_msgs/msg/Odometry'](
                header(stamp=time(*divmod(stamp, 1_000_000_000)), frame_id='map'),
                'base_link',
                types['geometry_msgs/msg/PoseWithCovariance'](pose, zeros),
                types['geometry_msgs/msg/TwistWithCovariance'](twist, zeros),
            )
            bag.write(TRUTH_TOPIC, stamp, message)
    return path
