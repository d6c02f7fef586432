"""Reads a run folder into arrays."""

from collections.abc import Callable
from dataclasses import dataclass, field
import json
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.config import from_mapping, Tau2CameraConfig
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.measurements import CORNER_FIELDS
from thermal_fiducial.core.types import FloatArray, IntArray, SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.csv_rows import named_rows
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.files.parameter_sections import load_sections
from thermal_fiducial.files.reading import is_text, is_there, naming, one_line, read_text, require_folder
from thermal_fiducial.files.writing import unfinished
from thermal_fiducial.report.output_bag import read_output, RecordedOutput
from thermal_fiducial.report.trajectory import read_truth, read_tum, Trajectory

FUSED, FIDUCIAL, TRUTH, TRUTH_OF_BAG = 'fused.tum', 'fiducial.tum', 'truth.tum', 'ground_truth.tum'
DETECTIONS, LATENCY, PARAMETERS = 'detections.csv', 'latency.csv', 'parameters.yaml'
MARKER_MAP, TRUE_MAP, SUMMARY, OUTPUT = 'marker_map.yaml', 'map_true.yaml', 'summary.json', 'output'
#: Longest cell of a number [characters]; limits of integers (int64), and of stamps to which a duration is added [ns].
_LONGEST_CELL, _LARGEST_WHOLE, _LARGEST_STAMP = 40, 2**63, 2**62


@dataclass(frozen=True)
class Detections:
    """Rows (N,) of detections.csv, and their corners (N, 4, 2) [px]."""

    stamps_ns: IntArray
    ids: IntArray
    corners_px: FloatArray
    sigma_px: FloatArray


@dataclass(frozen=True)
class Run:
    """A run folder.

    Fiducial poses, recorded in the camera's clock, are converted to stamps of the IMU's clock, as in the filter.
    """

    path: Path
    fused: Trajectory
    fiducial: Trajectory
    detections: Detections
    #: kind of latency to stamps (N,) [ns] and values (N,) [ms]; only a run in real time has any
    latencies: dict[str, tuple[IntArray, FloatArray]]
    output: RecordedOutput
    marker_map: MarkerMap | None
    summary: dict[str, Any]
    truth: Trajectory | None
    #: source of the truth
    truth_path: Path | None = None
    #: the true map; None if unknown
    true_map: MarkerMap | None = None
    #: t_imu - t_camera as configured
    offset_ns: int = 0
    #: how the images were read; the defaults where that is unknown
    front_end: Tau2CameraConfig = field(default_factory=Tau2CameraConfig)


def read_run(path: Path, truth: Path | None = None, true_map: Path | None = None) -> Run:
    """Read a run folder.

    Parameters
    ----------
    path : the folder
    truth : a TUM file or a bag; default: the folder's own ``truth.tum``, or ``ground_truth.tum`` in the bag that was
        replayed or beside its single file, where there is one
    true_map : a marker map; default: ``map_true.yaml`` in the truth's bag or beside its file, where there is one

    Raises
    ------
    InputError
        No run folder, or a broken file in it.
    """
    require_folder(path, 'run folder')
    missing = [name for name in (FUSED, FIDUCIAL) if not (path / name).exists()]
    if any(unfinished(path / name).exists() for name in missing):
        raise InputError(f'{path}: its replay was cut short; replay it again')
    if missing:
        raise InputError(f'{path} is no run folder: it has no {missing[0]}')
    summary = read_summary(path / SUMMARY)
    truth = _own_truth(path, summary) if truth is None else truth
    if true_map is None and truth is not None:
        beside = _folder_of(truth) / TRUE_MAP
        true_map = beside if beside.exists() else None
    sections = load_sections(path / PARAMETERS) if (path / PARAMETERS).exists() else None
    with naming(path / PARAMETERS):
        offset_ns = 0 if sections is None else _camera_time_offset_ns(sections)
        front_end = from_mapping(Tau2CameraConfig, (sections or {}).get('/tau2_camera', {}))
    return Run(
        path=path,
        fused=read_tum(path / FUSED),
        fiducial=read_tum(path / FIDUCIAL).delayed(offset_ns),
        detections=_detections(path / DETECTIONS),
        latencies=_latencies(path / LATENCY),
        output=read_output(path / OUTPUT, offset_ns),
        marker_map=load_map(path / MARKER_MAP) if (path / MARKER_MAP).exists() else None,
        summary=summary,
        truth=None if truth is None else read_truth(truth),
        truth_path=truth,
        true_map=None if true_map is None else load_map(true_map),
        offset_ns=offset_ns,
        front_end=front_end,
    )


def _own_truth(path: Path, summary: dict[str, Any]) -> Path | None:
    """The truth of a run folder, or of the replayed bag."""
    bag = bag_of_run(path, summary)
    places = [path / TRUTH, *([] if bag is None else [_folder_of(bag) / TRUTH_OF_BAG])]
    return next((place for place in places if is_there(place)), None)


def _folder_of(bag: Path) -> Path:
    """The folder with what belongs to a bag: of a single file, the one that it lies in."""
    return bag if bag.is_dir() else bag.parent


def bag_of_run(path: Path, summary: dict[str, Any]) -> Path | None:
    """The bag that a run was replayed from; None if it is not found."""
    known, name = summary.get('bag_path'), summary.get('bag')
    places = [Path(known)] if isinstance(known, str) else []
    # A run folder may have been moved, with the bag in it or beside it; the run may have the name of the bag.
    places += [path / name, path.parent / name] if isinstance(name, str) and name else []
    return next((place for place in places if is_there(place) and not is_there(place / SUMMARY)), None)


def bag_options(summary: dict[str, Any]) -> dict[str, Any]:
    """Arguments with which :class:`BagReader` names the topics of a replayed bag as the replay did."""
    return {'remap': summary.get('remaps', {}), 'second_camera': summary.get('second_camera', '')}


def _camera_time_offset_ns(sections: dict[str, dict[str, Any]]) -> int:
    """t_imu - t_camera that the filter was given."""
    try:
        return round(float(sections['/pose_ekf']['camera_time_offset']) * SECOND_NS)
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError('no camera_time_offset of pose_ekf in it') from None


def read_summary(path: Path) -> dict[str, Any]:
    """Content of ``summary.json``; empty if there is none.

    Raises
    ------
    InputError
        The file is not a summary.
    """
    if not path.exists():
        return {}
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f'{path}: cut short or damaged, replay it again: {one_line(error)}') from None
    if not isinstance(content, dict):
        raise InputError(f'{path}: not a JSON object')
    for name, is_kind in _SUMMARY_KINDS.items():
        if name in content and not is_kind(content[name]):
            raise InputError(f'{path}: {name} is of another kind')
    return content


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and abs(value) < _LARGEST_WHOLE


def _is_duration(value: Any) -> bool:
    """Seconds that also fit as nanoseconds, and so does their sum with a stamp."""
    return _is_number(value) and abs(value) * SECOND_NS < _LARGEST_STAMP


def _is_stamp(value: Any) -> bool:
    return isinstance(value, int) and abs(value) < _LARGEST_STAMP


def _is_name(value: Any) -> bool:
    """A path, or the name of a bag, which may have any letters: a no-break space is not printable."""
    return isinstance(value, str) and is_text(value) and '\0' not in value


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable()


def _is_table_of(is_kind: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, dict) and all(map(_is_text, value)) and all(map(is_kind, value.values()))


#: Keys of a summary that the report reads, and their validation; others are ignored.
_SUMMARY_KINDS: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(('bag', 'bag_path'), _is_name),
    **dict.fromkeys(('mode', 'transport', 'second_camera'), _is_text),
    'start_ns': _is_stamp,
    'duration_s': _is_duration,
    'last_ns': _is_table_of(_is_stamp),
    'cpu_percent': _is_table_of(_is_number),
    'diagnostics': _is_table_of(_is_table_of(_is_text)),
    'remaps': _is_table_of(_is_text),
}


def _rows(path: Path, kinds: dict[str, type]) -> list[list[Any]]:
    """Columns ``kinds`` (name to type) of a CSV file; empty if there is no file."""
    if not path.exists():
        return [[] for _ in kinds]
    rows: list[list[Any]] = []
    for number, cells in named_rows(path, tuple(kinds)):
        try:
            rows.append([_value(cell, kind) for cell, kind in zip(cells, kinds.values(), strict=True)])
        except ValueError:
            raise InputError(f'{path}, line {number}: no {", ".join(kinds)}') from None
    return [list(column) for column in zip(*rows, strict=True)] or [[] for _ in kinds]


def _value(word: str, kind: type) -> float:
    if len(word) > _LONGEST_CELL:
        raise ValueError
    value: float = kind(word)
    if kind is int and abs(value) >= _LARGEST_WHOLE:
        raise ValueError
    return value


def _detections(path: Path) -> Detections:
    kinds = {'stamp_ns': int, 'id': int, 'sigma_px': float} | dict.fromkeys(CORNER_FIELDS, float)
    stamps, ids, sigmas, *corners = _rows(path, kinds)
    corners_px = np.array(corners, np.float64).T.reshape(-1, 4, 2)
    return Detections(np.array(stamps, np.int64), np.array(ids, np.int64), corners_px, np.array(sigmas, np.float64))


def _latencies(path: Path) -> dict[str, tuple[IntArray, FloatArray]]:
    kinds, stamps, values = _rows(path, {'kind': str, 'stamp_ns': int, 'latency_ms': float})
    kind_of, stamp, value = np.array(kinds), np.array(stamps, np.int64), np.array(values, np.float64)
    return {kind: (stamp[kind_of == kind], value[kind_of == kind]) for kind in dict.fromkeys(kinds)}
