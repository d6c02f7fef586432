"""Pose-level flights: a smooth random motion with exact derivatives, its IMU samples and its noisy camera poses.

About 1 m/s rms in front of one marker 2 m away, in the numbers of ordinary hardware: 200 Hz IMU, 30 Hz poses.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from thermal_fiducial.config import ImuNoise, PoseEkfConfig
from thermal_fiducial.core.filter.ekf import PoseEkf
from thermal_fiducial.core.filter.imu_noise import bias_walks
from thermal_fiducial.core.geometry.se3 import (
    rotation_angle,
    skew,
    so3_exp,
    so3_left_jacobian_inverse,
    so3_log,
    transform,
)
from thermal_fiducial.core.measurements import CameraPose, ImuSample

GRAVITY = 9.80665
START_NS = 1_700_000_000_000_000_000
CAMERA_POSITION = (0.13, 0.02, -0.04)
CAMERA_ORIENTATION = (-0.5, 0.5, -0.5, 0.5)
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
T_BODY_CAMERA = transform(R_BODY_CAMERA, CAMERA_POSITION)
#: Its biases walk as those of a good IMU at rest.
IMU = ImuNoise(gyroscope_instability=0.0, accelerometer_instability=0.0)


@dataclass(frozen=True)
class Motion:
    """Sums of sines for position [m] and rotation vector [rad], each row an amplitude, frequency [rad/s] and phase."""

    position: np.ndarray  # (3, K, 3)
    rotation: np.ndarray  # (3, K, 3)

    @classmethod
    def random(cls, rng, speed=1.0, turn=0.5):
        """``speed`` [m/s] rms in all, ``turn`` [rad/s] rms about each axis of the rotation vector."""
        frequency = rng.uniform(0.5, 2.5, (2, 3, 4))
        phase = rng.uniform(0.0, 2 * np.pi, (2, 3, 4))
        rates = np.array([speed / np.sqrt(3.0), turn])[:, None, None] * np.sqrt(2.0 / 4.0)
        return cls(*np.stack([rates / frequency, frequency, phase], axis=-1))

    @classmethod
    def still(cls):
        return cls(np.zeros((3, 1, 3)), np.zeros((3, 1, 3)))

    @staticmethod
    def _sum(table, t, order):
        amplitude, frequency, phase = np.moveaxis(table, -1, 0)
        angle = frequency * np.asarray(t)[..., None, None] + phase + order * np.pi / 2
        return (amplitude * frequency**order * np.sin(angle)).sum(axis=-1)

    def pose(self, t):
        return transform(so3_exp(self._sum(self.rotation, t, 0)), self._sum(self.position, t, 0))

    def velocity(self, t):
        return self._sum(self.position, t, 1)

    def imu(self, t):
        """(..., 6) true rate and specific force in the body."""
        phi, phi_dot = self._sum(self.rotation, t, 0), self._sum(self.rotation, t, 1)
        rate = np.linalg.solve(so3_left_jacobian_inverse(-phi), phi_dot[..., None])
        lift = self._sum(self.position, t, 2) + np.array([0.0, 0.0, GRAVITY])
        force = np.swapaxes(so3_exp(phi), -1, -2) @ lift[..., None]
        return np.concatenate((rate, force), axis=-2)[..., 0]


@dataclass(frozen=True)
class Flight:
    """A flight's truth and data. Stamps are of the IMU's clock; ``offset``: t_imu = t_camera + offset."""

    seed: int = 0
    seconds: float = 20.0
    motion: Motion | None = None
    imu_rate: float = 200.0
    pose_rate: float = 30.0
    imu_noise: ImuNoise = IMU
    bias_std: tuple[float, float] = (0.005, 0.05)
    #: rotation error of the camera about its x, y and z [rad]; of the marker in the camera x, y, z [m]
    rotation_std: tuple[float, ...] = (0.018, 0.018, 0.003)
    translation_std: tuple[float, ...] = (0.0006, 0.0006, 0.011)
    marker_distance: float = 2.0
    offset: float = 0.0
    noiseless: bool = False

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        motion = self.motion or Motion.random(rng)
        t = np.arange(round(self.seconds * self.imu_rate)) / self.imu_rate
        quiet = 0.0 if self.noiseless else 1.0
        walks = np.repeat(bias_walks(self.imu_noise), 3)
        white = np.repeat((self.imu_noise.gyroscope_noise_density, self.imu_noise.accelerometer_noise_density), 3)
        steps = rng.normal(size=(len(t), 6)) * walks / np.sqrt(self.imu_rate)
        bias = quiet * (np.repeat(self.bias_std, 3) * rng.normal(size=6) + np.cumsum(steps, axis=0))
        noise = quiet * rng.normal(size=(len(t), 6)) * white * np.sqrt(self.imu_rate)
        for name, value in {'motion': motion, 't': t, 'bias': bias, 'imu': motion.imu(t) + bias + noise}.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, '_rng', rng)
        object.__setattr__(self, 'poses', self._poses(quiet))

    def _poses(self, quiet):
        t = np.arange(0.2, self.seconds - 0.1, 1.0 / self.pose_rate)
        t = np.round(t * 1e9) / 1e9
        T_map_camera = self.motion.pose(t) @ T_BODY_CAMERA
        marker = np.array([0.0, 0.0, self.marker_distance])
        stds = np.array((*self.rotation_std, *self.translation_std))
        poses = []
        for time, T in zip(t, T_map_camera, strict=True):
            R = T[:3, :3]
            e = quiet * stds * self._rng.normal(size=6)
            R_noisy = R @ so3_exp(e[:3])
            # As a solver does: the covariance at the answer, whose position is marker_in_map - R (marker + d).
            J = np.zeros((6, 6))
            J[3:, :3] = R_noisy
            J[:3, :3] = R_noisy @ skew(marker)
            J[:3, 3:] = -R_noisy
            noisy = transform(R_noisy, T[:3, 3] + R @ marker - R_noisy @ (marker + e[3:]))
            stamp = START_NS + round((time - self.offset) * 1e9)
            poses.append(CameraPose(stamp, noisy, J @ np.diag(stds**2) @ J.T))
        return poses

    def samples(self) -> list[ImuSample]:
        return [ImuSample(START_NS + round(s * 1e9), m[:3], m[3:]) for s, m in zip(self.t, self.imu, strict=True)]


def config(**changes) -> PoseEkfConfig:
    """The shipped parameters with the camera of these flights, whose place on the robot is exactly known."""
    camera = {'camera_position': CAMERA_POSITION, 'camera_orientation': CAMERA_ORIENTATION}
    exact = {'extrinsics_position_std': 0.0, 'extrinsics_orientation_std': 0.0}
    return PoseEkfConfig(**(camera | exact | changes))


def matched(**changes) -> PoseEkfConfig:
    """Parameters that say exactly what the flights are: no floors, a vertical map, known offset."""
    exact = {
        'estimate_time_offset': False,
        'time_offset_std': 0.0,
        'stamp_jitter': 0.0,
        'mount_vibration': 0.0,
        'map_tilt_std': 0.0,
        'systematic_pose_std': 0.01,
        'initial_gyroscope_bias_std': 0.005,
        'initial_accelerometer_bias_std': 0.05,
        'imu': MATCHED_IMU,
    }
    return config(**(exact | changes))


def perfect(noise: ImuNoise) -> ImuNoise:
    """An IMU of these densities and nothing else: no scale errors, no delay, no vibration, nothing that motion adds."""
    scale, nonlinearity = (
        ('gyroscope_scale_std', 'accelerometer_scale_std'),
        ('gyroscope_nonlinearity', 'accelerometer_nonlinearity'),
    )
    without = (*scale, 'accelerometer_delay_std', *nonlinearity)
    return replace(noise, vibration=0.0, **dict.fromkeys(without, 0.0))


MATCHED_IMU = perfect(IMU)


def timeline(samples: Iterable[ImuSample], poses: Iterable[CameraPose], delay=0.0):
    """Samples and poses as they arrive, poses ``delay`` (a number or one each) [s] after their stamps."""
    poses = list(poses)
    delays = np.broadcast_to(delay, len(poses))
    arrivals = [(sample.stamp_ns, 0, sample) for sample in samples]
    arrivals += [(pose.stamp_ns + round(late * 1e9), 1, pose) for pose, late in zip(poses, delays, strict=True)]
    return in_order(arrivals)


def in_order(arrivals):
    """The items of (time of arrival [ns], rank at equal times, item), the earliest first."""
    return [item for _, _, item in sorted(arrivals, key=lambda entry: entry[:2])]


def run_watched(ekf: PoseEkf, arrivals):
    """Odometry of every IMU sample that has one, and whether it was lost then (N,)."""
    states, lost = [], []
    for item in arrivals:
        if not isinstance(item, ImuSample):
            ekf.add_pose(item)
        elif state := ekf.add_imu(item):
            states.append(state)
            lost.append(ekf.lost)
    return states, np.array(lost)


def run(ekf: PoseEkf, arrivals):
    """Odometry of every IMU sample that has one, and what became of each pose when it came."""
    states, updates = [], []
    for item in arrivals:
        if isinstance(item, ImuSample):
            state = ekf.add_imu(item)
            if state:
                states.append(state)
        else:
            updates.append(ekf.add_pose(item))
    return states, updates


def errors(flight: Flight, states, begin=0.0):
    """Position (N,) [m] and attitude (N,) [rad] errors of the states after ``begin`` seconds."""
    t = np.array([(state.stamp_ns - START_NS) * 1e-9 for state in states])
    keep = t >= begin
    truth = flight.motion.pose(t[keep])
    estimate = np.array([state.T_map_body for state in states])[keep]
    position = np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1)
    return position, rotation_angle(np.swapaxes(truth[:, :3, :3], -1, -2) @ estimate[:, :3, :3])


def state_error(flight: Flight, state, t: float, index: int):
    """(15,) error of a navigation state: what X must be multiplied by, from the right, to be the truth."""
    truth = flight.motion.pose(t)
    rotation = so3_log(state.R_map_body.T @ truth[:3, :3])
    velocity = state.R_map_body.T @ (flight.motion.velocity(t) - state.velocity)
    position = state.R_map_body.T @ (truth[:3, 3] - state.position)
    inverse_jacobian = so3_left_jacobian_inverse(rotation)
    vectors = (rotation, inverse_jacobian @ velocity, inverse_jacobian @ position)
    return np.concatenate((*vectors, flight.bias[index] - state.bias))


def moved(pose: CameraPose, **changes) -> CameraPose:
    return replace(pose, **changes)


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
