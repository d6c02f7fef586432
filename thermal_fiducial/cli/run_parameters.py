"""Camera and marker sizes of a run, as defaults for commands on it."""

from pathlib import Path
from typing import Any

from thermal_fiducial.calibration.sources import recorded_camera
from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.geometry.camera import Camera
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.parameter_sections import load_sections
from thermal_fiducial.files.reading import is_there
from thermal_fiducial.report.run_folder import bag_of_run, bag_options, PARAMETERS, read_summary


def camera_of_run(run: Path) -> Camera:
    """The calibration of a run: the file among its parameters, else the recorded one of its bag.

    Parameters
    ----------
    run : a run folder

    Raises
    ------
    InputError
        There is no such run, or neither; the message names the option for a calibration. Or a malformed file of
        parameters, as for all that is read of a run here.
    """
    if not is_there(run):
        raise InputError(f'{run}: no such run')
    file = _parameter(run, 'tau2_camera', 'calibration_file')
    if file:
        return load_camera(str(file))
    summary = read_summary(run / 'summary.json')
    bag_path = bag_of_run(run, summary)
    if bag_path is None:
        raise InputError(f'{run}: neither a calibration nor the replayed bag is found: give --calibration')
    try:
        with BagReader(bag_path, **bag_options(summary)) as bag:
            return recorded_camera(bag)
    except InputError as error:
        raise InputError(f'{error}: give --calibration') from None


def sizes_of_run(run: Path) -> tuple[float | None, tuple[str, ...]]:
    """Side of the markers [m] and overrides "ID:SIZE" of a run; None and none if they are unknown."""
    size, overrides = (_parameter(run, 'marker_mapper', name) for name in ('marker_size', 'marker_size_overrides'))
    known = isinstance(size, float | int) and isinstance(overrides, list)
    return (float(size), tuple(map(str, overrides))) if known else (None, ())


def size_std_of_run(run: Path) -> float:
    """Relative error of the sides of markers that a run's mapper takes for declared [share]."""
    std = _parameter(run, 'marker_mapper', 'marker_size_std')
    return float(std) if isinstance(std, float | int) else MarkerMapperConfig().marker_size_std


def dictionary_of_run(run: Path) -> str:
    """Dictionary of the detector of a run; empty if it is unknown."""
    name = _parameter(run, 'aruco_detector', 'dictionary')
    return name if isinstance(name, str) else ''


def _parameter(run: Path, node: str, name: str) -> Any:
    """A parameter of a node in the replay; None if it is unknown.

    Raises
    ------
    InputError
        The file of the run's parameters is malformed.
    """
    path = run / PARAMETERS
    return load_sections(path).get(f'/{node}', {}).get(name) if path.is_file() else None
