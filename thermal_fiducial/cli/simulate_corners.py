"""A bag of ``markers`` from a simulated flight without pictures."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.files.recording_to_bag import write_recording
from thermal_fiducial.files.recordings import Corners, Recording
from thermal_fiducial.files.rig_files import Rig
from thermal_fiducial.files.work_folders import made_whole
from thermal_fiducial.sim.corner_flight import corner_frames
from thermal_fiducial.sim.corner_noise import CornerNoise
from thermal_fiducial.sim.thermal_camera import FlightPlan
from thermal_fiducial.sim.writer import IMAGE_DELAY_NS, write_side_files


def simulated_recording(flight: FlightPlan, noise: CornerNoise) -> Recording:
    """Recording of the flight: IMU samples as they arrive, corners, ground truth at the stamps of the IMU."""
    scenario = flight.scenario
    times, stamps = flight.imu_stamps()
    path = scenario.trajectory(flight.seconds, flight.seed)
    record = scenario.imu.sample(path, times, stamps, flight.seed)
    samples = [
        ImuSample(int(stamp), rate, force)
        for stamp, rate, force in zip(
            record.stamps_ns, record.angular_velocity, record.linear_acceleration, strict=True
        )
    ]
    frames = [
        Corners(frame.stamp_ns, frame.ids, frame.corners_px, np.full(len(frame.ids), noise.claimed_px))
        for frame in corner_frames(flight, noise)
    ]
    lens = scenario.lens
    camera = Camera(lens.width, lens.height, lens.matrix, lens.model, np.array(lens.distortion))
    size = scenario.markers[0].size
    rig = Rig(camera, scenario.T_body_camera, {}, scenario.camera_time_offset, size, scenario.dictionary)
    return Recording(rig, samples, corners=frames, truth=(flight.truth_stamps(), path(times).T_map_body))


def write_corner_flight(
    out: Path, flight: FlightPlan, noise: CornerNoise, storage: str, progress: Callable[[int], None]
) -> None:
    """Write the new folder ``out``, which exists only once it is complete.

    It is a bag with ground truth, maps and parameters, as for a flight with pictures.

    Raises
    ------
    InputError
        ``out`` exists or cannot be written.
    """
    late = IMAGE_DELAY_NS / SECOND_NS
    with made_whole(out) as folder:
        write_recording(folder, simulated_recording(flight, noise), noise.claimed_px, late, storage, progress)
        write_side_files(folder, flight)
