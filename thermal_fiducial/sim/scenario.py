"""Named flights: the rig, the room with its markers, the path, the weather."""

from dataclasses import dataclass, replace

import cv2
from scipy.spatial.transform import Rotation

from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.corner_noise import CornerNoise
from thermal_fiducial.sim.imu import Delivery, ImuModel, SimulatedNoise
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.recorded import RecordedFlight
from thermal_fiducial.sim.scene import Acrylic, Clutter, clutter_plate, Fog, Marker, marker_plate, Plate, Room
from thermal_fiducial.sim.sensor import IDEAL, Sensor
from thermal_fiducial.sim.spline_trajectory import Flight, MotionPath, pose_matrix
from thermal_fiducial.sim.vibration import Shaken, Vibration
from thermal_fiducial.sim.waving import Waving

#: Lenses of a Tau 2 (17 um pixels) by name.
LENSES = {
    '7.5mm': Lens((441.3, 440.9), (321.7, 252.4), 'equidistant', (0.0143, -0.0218, 0.0312, -0.0174)),
    '9mm': Lens(
        (529.8, 529.2), (317.2, 259.1), 'rational_polynomial', (0.31, 0.05, 3e-4, -2e-4, 0.01, 0.64, 0.12, 0.02)
    ),
    '13mm': Lens((765.2, 764.6), (322.9, 251.3), 'plumb_bob', (-0.29, 0.11, 4e-4, -3e-4, 0.0)),
    '19mm': Lens((1117.8, 1117.1), (316.4, 258.2), 'plumb_bob', (-0.18, 0.07, -2e-4, 3e-4, 0.0)),
}


@dataclass(frozen=True)
class Scenario:
    """Everything that determines a simulated flight, except its seed.

    Parameters
    ----------
    name, description : for the command line
    markers : the first one is the fixed one of the map that mapping starts with
    camera_position, camera_orientation : of the camera in the body (IMU) frame [m], quaternion x y z w
    camera_time_offset : t_imu = t_camera + offset [s]
    stamp_jitter : of the camera's stamps, exponential: most slightly early, few late; the offset is the mean [s]
    vibration : of the body, or none
    corner_noise : errors of the corners of a flight without pictures; None: it has pictures
    dictionary : name of an OpenCV dictionary
    seconds : default length
    """

    name: str
    description: str
    markers: tuple[Marker, ...]
    lens: Lens = LENSES['13mm']
    camera_position: tuple[float, float, float] = (0.12, 0.02, -0.04)
    camera_orientation: tuple[float, float, float, float] = (-0.49307, 0.489088, -0.497699, 0.519587)
    camera_time_offset: float = 0.0
    stamp_jitter: float = 0.0
    vibration: Vibration | None = None
    corner_noise: CornerNoise | None = None
    dictionary: str = 'DICT_4X4_50'
    flight: Flight | RecordedFlight | Waving = Flight()  # noqa: RUF009
    acrylic: Acrylic = Acrylic()  # noqa: RUF009
    fog: Fog = Fog()  # noqa: RUF009
    room: Room = Room()  # noqa: RUF009
    clutter: tuple[Clutter, ...] = ()
    sensor: Sensor = Sensor()  # noqa: RUF009
    imu: ImuModel = ImuModel()  # noqa: RUF009
    seconds: float = 30.0

    @property
    def T_body_camera(self) -> FloatArray:
        """(4, 4)."""
        return pose_matrix(Rotation.from_quat(self.camera_orientation), self.camera_position)

    @property
    def aruco_dictionary(self) -> cv2.aruco.Dictionary:
        """The dictionary by its name.

        Raises
        ------
        InputError
            OpenCV has none of that name.
        """
        number = getattr(cv2.aruco, self.dictionary, None)
        if not self.dictionary.startswith('DICT_') or number is None:
            raise InputError(f'OpenCV has no dictionary {self.dictionary}')
        return cv2.aruco.getPredefinedDictionary(number)

    @property
    def plates(self) -> list[Plate]:
        """All flat objects in the room."""
        markers = [marker_plate(marker, self.aruco_dictionary, self.acrylic) for marker in self.markers]
        return markers + [clutter_plate(item) for item in self.clutter]

    def trajectory(self, seconds: float, seed: int) -> MotionPath:
        """The flight, shaken by the vibration."""
        smooth = self.flight.trajectory(seconds, seed)
        return smooth if self.vibration is None else Shaken(smooth, self.vibration, seed)


def _wall() -> tuple[Marker, ...]:
    """Eight markers 2.5 to 4.5 m in front of home, at various angles; the first is visible from home."""
    depth = (3.2, 2.9, 3.5, 4.4, 3.0, 3.8, 2.8, 4.1)
    yaw = (180, 165, 190, 172, 200, 183, 160, 195)
    tilt = (0, 8, -6, 4, -10, 5, 12, -3)
    markers = []
    for index in range(8):
        column, row = (index + 2) % 4, index // 4
        y = (1.5 - column) * 0.52 * depth[index] / 3.2
        z = 1.25 + (row - 0.5) * 0.62 * depth[index] / 3.2
        position = (depth[index], round(y, 3), round(z, 3))
        markers.append(Marker(index + 2, position, yaw[index], tilt[index], 3.0 * index - 8.0))
    return tuple(markers)


def _room() -> tuple[Marker, ...]:
    """Six markers on each wall of the default room at changing heights; the first is in front of home."""
    markers: list[Marker] = []
    walls = ((4.9, 180.0, 1), (3.9, -90.0, 0), (-3.9, 0.0, 1), (-3.9, 90.0, 0))
    for wall, (distance, yaw, axis) in enumerate(walls):
        for step in (2, 3, 1, 4, 0, 5):
            along = (-2.5 + step) * (1.05 if axis else 1.25) + (0.0 if axis else 0.5)
            height = (1.3, 1.0, 1.75)[(step + wall) % 3]
            x, y = (distance, along) if axis else (along, distance)
            turn = ((7 * step + 5 * wall) % 5 - 2) * 6.0
            markers.append(Marker(len(markers) + 2, (x, y, height), yaw + turn, 3.0 * (step % 3 - 1), 0.0, 0.40))
    return tuple(markers)


_PEOPLE = (
    Clutter('person', (4.6, -1.9, 0.85), 180.0, 0.55, 1.7, 11.0),
    Clutter('heater', (4.95, 1.9, 0.4), 180.0, 1.0, 0.6, 30.0),
    Clutter('pipe', (4.98, 0.0, 2.6), 180.0, 6.0, 0.06, 18.0),
    Clutter('plate', (2.0, 3.95, 1.5), -90.0, 0.8, 0.8, 9.0),
    Clutter('person', (-1.0, -3.6, 0.85), 90.0, 0.5, 1.75, 12.0),
)

_TURNS = ((9.0, 1.9, 110.0), (12.5, 1.5, -95.0), (16.5, 3.5, 180.0), (21.5, 3.5, 165.0))


def _board() -> tuple[Marker, ...]:
    """Six times six tags of 88 mm in front of home, facing it, a third of their side apart."""
    places = ((key, (key % 6 - 2.5) * 0.1144, (key // 6 - 2.5) * 0.1144) for key in range(36))
    return tuple(Marker(key, (1.1, -right, 1.0 + up), 180.0, size=0.088) for key, right, up in places)


def _carpet() -> tuple[Marker, ...]:
    """Nine times nine tags of 193 mm on the floor, a side apart; the first is in the middle."""
    cells = [(key, 0.386 * (key % 9 - 4), 0.386 * (key // 9 - 4)) for key in range(81)]
    cells.insert(0, cells.pop(40))
    return tuple(Marker(key, (x, y, 0.0), 0.0, -90.0, size=0.193) for key, x, y in cells)


#: A global-shutter camera of visible light: its calibration, and its true lens, which differs a little.
_WIDE = Lens((460.0, 459.0), (370.0, 245.0), 'plumb_bob', (-0.28, 0.07, 2e-4, 0.0, 0.0), 752, 480)
_WIDE_TRUE = Lens((460.2, 459.2), (370.1, 244.9), 'plumb_bob', (-0.2805, 0.0708, 2.3e-4, -3e-5, 0.0), 752, 480)
_DOWNWARD = Lens((364.0, 364.0), (288.0, 290.0), width=576, height=576)
#: Published densities of a tactical-grade MEMS IMU, and its other errors as measured against a reference.
_MEMS = ImuModel(
    SimulatedNoise(1.7e-4, 2.0e-3, 2.0e-5, 3.0e-3),
    gyroscope_bias_sigma=0.04,
    accelerometer_bias_sigma=0.1,
    gyroscope_axes=0.008,
    accelerometer_axes=0.005,
    g_sensitivity=2e-4,
    gyroscope_instability=3e-4,
    accelerometer_instability=0.02,
)

_SCENARIOS = (
    Scenario(
        'fog',
        'demo flight: eight markers in front of a wall, fog, people and heaters',
        _wall(),
        fog=Fog(0.25),
        clutter=_PEOPLE,
    ),
    Scenario('wall', 'eight 0.3 m markers at 2.5 to 4.5 m, clear air', _wall(), seconds=20.0),
    Scenario(
        'room',
        'markers on all four walls, the robot turns all round',
        _room(),
        lens=LENSES['9mm'],
        flight=Flight(amplitude=(1.2, 1.2, 0.3), period=(13.0, 11.0, 6.0), turns=((8.0, 12.0, 360.0),)),
        clutter=_PEOPLE,
    ),
    Scenario(
        'fast',
        '7.5 mm equidistant lens, 1 to 2 m/s, turns up to 140 deg/s',
        _room(),
        lens=LENSES['7.5mm'],
        flight=Flight(amplitude=(1.8, 1.7, 0.4), period=(8.5, 7.5, 4.0), turns=_TURNS),
        clutter=_PEOPLE,
    ),
    Scenario(
        'dropout',
        'markers in one half of the view only: twice none is seen for more than two seconds',
        _wall(),
        flight=Flight(turns=((9.0, 1.5, 75.0), (12.8, 1.5, -75.0), (18.5, 1.5, -80.0), (22.3, 1.5, 80.0))),
    ),
    Scenario(
        'rough',
        'a flight with real sensors: rolling shutter, vibration, jitter of all stamps, a late camera',
        _room(),
        lens=LENSES['9mm'],
        flight=Flight(amplitude=(1.6, 1.6, 0.4), period=(9.0, 8.0, 4.5), turns=_TURNS),
        clutter=_PEOPLE,
        camera_time_offset=-0.018,
        stamp_jitter=0.002,
        vibration=Vibration(),
        sensor=Sensor(readout=0.016),
        imu=ImuModel(gyroscope_rattle=0.015, accelerometer_rattle=0.35, stamp_jitter=2e-4),
    ),
    Scenario(
        'april',
        'corners of a board of 36 tags before a hand-held rig: misaligned axes of the IMU, a slightly wrong lens',
        _board(),
        lens=_WIDE,
        corner_noise=CornerNoise(true_lens=_WIDE_TRUE),
        vibration=Vibration((9.0, 13.0, 19.0, 27.0, 38.0), 0.15, 0.008),
        dictionary='DICT_APRILTAG_36h11',
        flight=Waving((0.0, 0.0, 1.0), (1.1, 0.0, 1.0)),
        sensor=Sensor(lag=0.0, frame_rate=20.0),
        imu=_MEMS,
        seconds=40.0,
    ),
    Scenario(
        'carpet',
        'a drone over 81 tags: 8-bit pictures whose edges bleed, IMU samples in bursts, with gaps and a stamp that '
        'goes back',
        _carpet(),
        lens=_DOWNWARD,
        camera_position=(-0.02, 0.1, 0.0),
        camera_orientation=(0.70710678, -0.70710678, 0.0, 0.0),
        dictionary='DICT_APRILTAG_36h11',
        flight=Waving((0.0, 0.0, 1.3), speed=0.25, turn=0.12, frequencies=(0.1, 0.5)),
        acrylic=Acrylic(contrast=8.0, gradient=0.0, steady=0.0),
        room=Room(excess=(0.0,) * 6),
        sensor=replace(
            IDEAL,
            lag=0.0,
            psf_sigma_px=0.8,
            netd=0.03,
            counts_per_kelvin=48.0,
            offset_counts=20.0,
            frame_rate=20.0,
            full_scale=255,
        ),
        imu=ImuModel(
            SimulatedNoise(1e-3, 1e-2, 5e-5, 5e-4),
            rate=80.0,
            delivery=Delivery(gaps=((4.0, 0.3), (8.0, 0.8)), steps_back=(6.0,)),
        ),
        seconds=20.0,
    ),
    Scenario(
        'cheap_imu',
        'corners of the wall, a gentle flight, the IMU of a toy: ten times the noise, axes wrong by a per cent',
        _wall(),
        corner_noise=CornerNoise(0.05, 0.05),
        sensor=Sensor(lag=0.0),
        imu=ImuModel(
            SimulatedNoise(2e-3, 2e-2, 2e-4, 2e-3),
            gyroscope_bias_sigma=0.02,
            accelerometer_bias_sigma=0.2,
            gyroscope_axes=0.01,
            accelerometer_axes=0.01,
            g_sensitivity=5e-4,
        ),
        seconds=20.0,
    ),
    Scenario('low_contrast', 'the wall at 2 K', _wall(), acrylic=Acrylic(contrast=2.0, steady=0.1), seconds=20.0),
)

SCENARIOS = {scenario.name: scenario for scenario in _SCENARIOS}


def named(name: str) -> Scenario:
    """The scenario of that name.

    Raises
    ------
    InputError
        There is none.
    """
    if name not in SCENARIOS:
        raise InputError(f'scenario {name!r} is not one of {", ".join(SCENARIOS)}')
    return SCENARIOS[name]


def with_contrast(scenario: Scenario, contrast: float) -> Scenario:
    """The scenario with plates ``contrast`` [K] warmer than cold sheets."""
    return replace(scenario, acrylic=replace(scenario.acrylic, contrast=contrast))


def with_lens(scenario: Scenario, name: str) -> Scenario:
    """The scenario through another lens.

    Raises
    ------
    InputError
        There is no lens of that name.
    """
    if name not in LENSES:
        raise InputError(f'lens {name!r} is not one of {", ".join(LENSES)}')
    return replace(scenario, lens=LENSES[name])
