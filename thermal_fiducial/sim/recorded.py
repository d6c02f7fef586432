"""A flight along recorded poses."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from thermal_fiducial.config import ImuNoise
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.trajectory_file import load_tum
from thermal_fiducial.sim.spline_trajectory import SplineTrajectory

# Ten poses a second resolve the motion of a drone or a hand, but little of the poses' noise: a millimetre of noise
# becomes 0.1 m/s^2 in the simulated accelerometer.
_KNOTS_PER_SECOND = 10
# What the accelerometer of a drone measures at most [m/s^2].
_MEASURABLE = ImuNoise().accelerometer_range


@dataclass(frozen=True, eq=False)
class RecordedFlight:
    """A smooth path through recorded poses of the body in ``map``, of which it takes ten a second.

    Parameters
    ----------
    times : (N,) since the first [s]
    positions : (N, 3) [m]
    quaternions : (N, 4) x y z w
    """

    times: FloatArray
    positions: FloatArray
    quaternions: FloatArray

    @classmethod
    def load(cls, path: Path) -> 'RecordedFlight':
        """The flight of a TUM file.

        Raises
        ------
        InputError
            Unreadable, shorter than two seconds, or faster than an IMU can follow, as in millimetres.
        """
        stamps, positions, quaternions = load_tum(path)
        stamps, first = np.unique(stamps, return_index=True)
        times = (stamps - stamps[0]) * 1e-9
        if times[-1] < 2.0:
            raise InputError(f'{path}: poses of {times[-1]:g} s are too short for a flight')
        flight = cls(times, positions[first], quaternions[first])
        dense = np.linspace(0.0, flight.seconds, len(times))
        acceleration = np.linalg.norm(flight.trajectory(flight.seconds, 0)(dense).acceleration, axis=1)
        if (largest := acceleration.max()) > _MEASURABLE:
            when = f'{largest:.0f} m/s^2 after {dense[acceleration.argmax()]:.1f} s'
            raise InputError(f'{path}: {when}, more than an IMU measures: positions must be in metres')
        return flight

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.times[-1])

    def trajectory(self, seconds: float, seed: int) -> SplineTrajectory:
        """The flight, the same for each ``seed``; after its end the body stands still.

        Raises
        ------
        InputError
            Never, for poses from :meth:`load`.
        """
        knots = np.linspace(0.0, self.seconds, round(self.seconds * _KNOTS_PER_SECOND) + 1)
        positions = np.stack([np.interp(knots, self.times, column) for column in self.positions.T], axis=1)
        return SplineTrajectory(knots, positions, Slerp(self.times, Rotation.from_quat(self.quaternions))(knots))
