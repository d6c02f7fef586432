"""What a rig is: camera, IMU, clocks, markers, and what its calibration has wrong."""

# ruff: noqa: RUF009, as these defaults are fields

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from rigs.draws import between, by, drawn, normal, one_of, sometimes
from rigs.lens import Lens

#: Length of a flight [s]: each style of motion has its turns in it.
SECONDS = 15.0
#: The camera's axes in a body whose camera looks ahead: z forward, x right, y down.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: How large a rig's errors are, in parameters whose defaults claim more: 3 mrad, sides of 0.3 %, one error of 0.2 % for
#: both focal lengths (rigs have one for each, whose mean counts), a readout time, bias instability, a tilt of the map.
AS_DRAWN = {
    'extrinsics_orientation_std': 0.002,
    'marker_size_std': 0.0,
    'focal_length_std': 0.0014,
    'readout_time_std': 0.0,
    'map_tilt_std': 0.0,
    'initial_gyroscope_bias_std': 0.005,
    'initial_accelerometer_bias_std': 0.05,
    'imu.gyroscope_instability': 0.0,
    'imu.accelerometer_instability': 0.0,
    'imu.gyroscope_scale_std': 0.003,
    'imu.accelerometer_scale_std': 0.003,
}
STYLES = ('hover', 'inspect', 'brisk', 'pan', 'approach', 'transit', 'look away', 'landing', 'take-off')


@dataclass(frozen=True, eq=False)
class Sensor:
    """A bolometer array."""

    #: frames a second: exported cores are held to 9; PAL, NTSC and digital output of a Tau 2
    rate: float = one_of(9.0, 25.0, 30.0, 60.0, shares=[0.1, 0.2, 0.55, 0.15])
    #: time constant of the pixels [s]: FLIR states 8 to 12 ms for vanadium oxide
    lag: float = between(0.008, 0.012)
    #: of optics and pixel, one sigma [px]: f/1 to f/1.4 with pixels of 17 um, and a focus that is a little off
    blur: float = between(0.5, 0.9)
    #: NETD [K]: below 0.05 in data sheets at f/1, more behind slower lenses
    noise: float = between(0.03, 0.08)
    #: growth of the fixed pattern of pixels, and of columns [K a root of s]: to 0.05 and 0.27 K in three minutes
    pattern: np.ndarray = by(lambda _: np.array([0.004, 0.02]))
    #: [K]: a Tau 2 in high gain
    count: float = one_of(0.025, 0.04)
    #: when the shutter closes, and for how long [s]: less than a second in a Tau 2
    closes: float = between(3.0, SECONDS - 2.0)
    closed: float = sometimes(0.3, 0.8)
    #: number of pixels that are off by some 60 counts: those that a factory's replacement has left
    stuck: int = by(lambda rng: rng.integers(0, 25))


@dataclass(frozen=True, eq=False)
class Imu:
    """An IMU of an autopilot; vectors (6,) are of rates [rad/s], then specific forces [m/s^2]."""

    #: samples a second
    rate: float = one_of(100.0, 200.0, 400.0, shares=[0.2, 0.6, 0.2])
    #: white noise, a root of Hz: the defaults of the package, up to four times as much
    density: np.ndarray = by(lambda rng: np.exp(rng.uniform(0.0, np.log(4.0))) * np.repeat([1.7e-4, 2.0e-3], 3))
    #: random walk of the biases, a second and root of Hz: at rest, a tenth and less of the defaults
    walk: np.ndarray = by(lambda _: np.repeat([2.0e-5, 3.0e-4], 3))
    bias: np.ndarray = normal(*[0.005] * 3, *[0.05] * 3)
    #: errors of scale and between axes (2, 3, 3): the package assumes 0.005
    scale: np.ndarray = by(lambda rng: rng.normal(0.0, 0.003, (2, 3, 3)))
    #: vibration of three forces [m/s^2], and what it turns by [rad/s a m/s^2]: none, a damped mount, one on the frame
    shaking: float = one_of(0.0, 0.3, 1.5)
    turning: float = between(0.01, 0.04)
    #: turns of vibration from sample to sample: what aliases below 8 Hz is motion to any filter
    turns: np.ndarray = by(lambda rng: rng.uniform(0.08, 0.5, 6))
    #: of the stamps, always late [s]
    jitter: float = one_of(0.0, 0.0003)
    #: share of the samples that never arrive
    loss: float = one_of(0.0, 0.01)


@dataclass(frozen=True)
class Link:
    """How frames reach the computer: anything from a grabber with its own clock to USB on a busy computer."""

    #: t_imu - t_camera [s]
    offset: float = normal(0.02)
    #: from a frame until it arrives: at least, and one sigma of what comes on top [s]
    delay: float = between(0.015, 0.06)
    scatter: float = one_of(0.0, 0.004, 0.015)
    #: of the stamps [s]
    jitter: float = one_of(0.0, 0.0005, 0.002)
    #: share of the frames that never arrive
    loss: float = one_of(0.0, 0.03, 0.15)


@dataclass(frozen=True)
class Task:
    """What the rig is used for."""

    style: str = one_of(*STYLES)
    #: raw counts, or the gain control that makes 8 bits of them
    display: str = one_of('raw', 'linear', 'plateau', shares=[0.5, 0.25, 0.25])
    dictionary: str = one_of(
        'DICT_4X4_50', 'DICT_5X5_100', 'DICT_APRILTAG_36h11', 'STENCIL_4X4_100', shares=[0.45, 0.25, 0.15, 0.15]
    )
    #: side of the black square [m]
    size: float = one_of(0.15, 0.2, 0.3, 0.5)
    #: white over black [K]: paper on a wall to plates before heated boards; one of five is colder than its plate
    contrast: float = by(lambda rng: np.exp(rng.uniform(np.log(0.6), np.log(12.0))) * rng.choice([1, -1], p=[0.8, 0.2]))
    #: greatest share of the heat that smoke takes away
    smoke: float = sometimes(0.3, 0.85)


class Rig:
    """All of a seed but for room and path.

    Attributes
    ----------
    lens, T_body_camera : true ones
    calibrated, T_calibrated : the same as calibration has them
    near : distance of the nearest markers [m]
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed
        rng = self.rng('rig')
        self.sensor = drawn(Sensor, rng)
        self.imu = drawn(Imu, rng)
        self.link = drawn(Link, rng)
        self.task = drawn(Task, rng)
        self.lens = _lens(rng)
        self.near = _distance(rng, self.lens, self.task.size)
        # Mounted ahead within 6 degrees, and up to 15 cm beside the IMU.
        self.T_body_camera = pose(AHEAD @ _turned(rng, 0.1), rng.uniform(-0.15, 0.15, 3))
        # As good calibrations: 0.2 % of focal length, 2 mrad and 2 mm of the camera's pose.
        focal = self.lens.focal * (1.0 + rng.normal(0.0, 0.002, 2))
        self.calibrated = replace(self.lens, focal=focal, centre=self.lens.centre + rng.normal(0.0, 0.3, 2))
        self.T_calibrated = self.T_body_camera @ pose(_turned(rng, 0.002), rng.normal(0.0, 0.002, 3))

    def rng(self, what: str) -> np.random.Generator:
        """Randomness of its own for each part: a new draw in one leaves all others alone."""
        return np.random.default_rng([self.seed, *what.encode()])

    def __str__(self) -> str:
        task, lens = self.task, self.lens
        side_px = lens.focal[0] * task.size / self.near
        shutter = ', shutter' if self.sensor.closed else ''
        smoke = f', smoke {task.smoke:.1f}' if task.smoke else ''
        return (
            f'{self.seed:3d} {lens.width}x{lens.height}, {self.sensor.rate:.0f} Hz, {task.display}, {task.style}, '
            f'{task.dictionary} of {task.size:.2f} m and {side_px:.0f} px, {task.contrast:.1f} K{shutter}{smoke}'
        )


def pose(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """T (4, 4)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def _turned(rng: np.random.Generator, sigma: float) -> np.ndarray:
    """A small rotation (3, 3), of ``sigma`` about each axis [rad]."""
    return Rotation.from_rotvec(rng.normal(0.0, sigma, 3)).as_matrix()


def _lens(rng: np.random.Generator) -> Lens:
    """One that does not fold in the image."""
    while True:
        # A Tau 2 in its two sizes, and other common cores.
        sizes = [(640, 512), (336, 256), (320, 240), (384, 288), (160, 120)]
        width, height = sizes[rng.choice(5, p=[0.35, 0.25, 0.2, 0.15, 0.05])]
        # Lenses of a Tau 2 from 19 to 7 mm.
        angle = np.radians(rng.uniform(35.0, 90.0))
        focal = width / 2.0 / np.tan(angle / 2.0) * (1.0 + rng.normal(0.0, [0.0, 0.001]))
        centre = np.array([width, height]) / 2.0 - 0.5 + rng.normal(0.0, 4.0, 2)
        # Published calibrations of thermal cameras; barrels of wide lenses are stronger.
        k1, k2 = rng.uniform(-0.3, 0.05) * min(1.0, angle / 1.2), rng.uniform(0.0, 0.08)
        lens = Lens(width, height, focal, centre, np.array([k1, k2, *rng.normal(0.0, 3e-4, 2)]))
        if not lens.folds:
            return lens


def _distance(rng: np.random.Generator, lens: Lens, size: float) -> float:
    """From where a marker is 18 to 100 px wide, in small images less, but within a room [m]."""
    side_px = np.exp(rng.uniform(np.log(18.0), np.log(100.0))) * min(1.0, lens.width / 320.0)
    return float(np.clip(lens.focal[0] * size / max(side_px, 12.0), 0.6, 8.0))
