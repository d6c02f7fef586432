"""What a run folder holds, read into arrays."""

from collections import Counter
from collections.abc import Iterable
import csv
from dataclasses import dataclass, field, replace
import json
from pathlib import Path
import re
from typing import Any

import numpy as np
import yaml

from thermal_fiducial.core.filter.innovations import INNOVATIONS, Innovations, innovations_of
from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.measurements import CORNER_FIELDS
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bags import BagReader
from thermal_fiducial.files.marker_map import load_map
from thermal_fiducial.report.trajectory import read_truth, read_tum, Trajectory

FUSED, FIDUCIAL, TRUTH = 'fused.tum', 'fiducial.tum', 'truth.tum'
DETECTIONS, LATENCY, PARAMETERS = 'detections.csv', 'latency.csv', 'parameters.yaml'
MARKER_MAP, SUMMARY, OUTPUT = 'marker_map.yaml', 'summary.json', 'output'
#: Covariances are read from no more than so many messages, evenly over the run.
MOST_COVARIANCES = 6000
# "coasting for 0.6 s" and "coasting for 0.8 s" are one thing to say.
_NUMBER = re.compile(r'\d+(\.\d+)?')
_LEVELS = ('ok', 'warning', 'error', 'stale')


@dataclass(frozen=True)
class Detections:
    """Rows (N,) of detections.csv, and their corners (N, 4, 2) [px]."""

    stamps_ns: IntArray
    ids: IntArray
    corners_px: FloatArray
    sigma_px: FloatArray


@dataclass(frozen=True)
class Diagnostic:
    """How often a node said something."""

    node: str
    level: str
    message: str
    count: int


@dataclass(frozen=True)
class RecordedOutput:
    """What the recorded messages of the nodes tell beyond the text files.

    Parameters
    ----------
    stamps_ns, covariances : (N,), (N, 6, 6) of some of the ``pose`` messages
    diagnostics : what the nodes said, most frequent first
    innovations : how well each camera pose fitted what the filter expected, at the IMU's stamps
    """

    stamps_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    covariances: FloatArray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    diagnostics: tuple[Diagnostic, ...] = ()
    innovations: Innovations = field(default_factory=Innovations)


@dataclass(frozen=True)
class Run:
    """A run folder.

    The fiducial poses are stamped by the camera's clock; here they have the IMU's stamps, as the filter takes them.
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


def read_run(path: Path, truth: Path | None = None) -> Run:
    """Read a run folder.

    Parameters
    ----------
    path : the folder
    truth : a TUM file or a bag; default: the folder's own ``truth.tum``, where it has one

    Raises
    ------
    InputError
        No run folder, or a broken file in it.
    """
    if not path.is_dir():
        raise InputError(f'{path}: no such run folder')
    missing = [name for name in (FUSED, FIDUCIAL) if not (path / name).is_file()]
    if missing:
        raise InputError(f'{path} is no run folder: it has no {missing[0]}')
    own_truth = path / TRUTH
    if truth is None and own_truth.is_file():
        truth = own_truth
    offset_ns = _camera_time_offset_ns(path / PARAMETERS)
    return Run(
        path=path,
        fused=read_tum(path / FUSED),
        fiducial=read_tum(path / FIDUCIAL).delayed(offset_ns),
        detections=_detections(path / DETECTIONS),
        latencies=_latencies(path / LATENCY),
        output=_output(path / OUTPUT, offset_ns),
        marker_map=load_map(path / MARKER_MAP) if (path / MARKER_MAP).is_file() else None,
        summary=_summary(path / SUMMARY),
        truth=None if truth is None else read_truth(truth),
    )


def _camera_time_offset_ns(path: Path) -> int:
    """t_imu - t_camera that the filter was told."""
    if not path.is_file():
        return 0
    try:
        nodes = yaml.safe_load(path.read_text(encoding='utf-8'))
        return round(float(nodes['/pose_ekf']['ros__parameters']['camera_time_offset']) * 1e9)
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError):
        raise InputError(f'{path}: no camera_time_offset of pose_ekf in it') from None


def _summary(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding='utf-8'))
    except (OSError, ValueError) as error:
        raise InputError(f'{path}: {error}') from None
    if not isinstance(content, dict):
        raise InputError(f'{path}: not a JSON object')
    return content


def _rows(path: Path, kinds: dict[str, type]) -> list[list[Any]]:
    """Columns ``kinds`` (name to type) of a CSV file, empty where there is no file."""
    if not path.is_file():
        return [[] for _ in kinds]
    rows = []
    with path.open(encoding='utf-8', newline='') as file:
        for number, row in enumerate(csv.DictReader(file), 2):
            try:
                rows.append([kind(row[name]) for name, kind in kinds.items()])
            except (KeyError, TypeError, ValueError):
                raise InputError(f'{path}, line {number}: no {", ".join(kinds)}') from None
    return [list(column) for column in zip(*rows, strict=True)] or [[] for _ in kinds]


def _detections(path: Path) -> Detections:
    kinds = {'stamp_ns': int, 'id': int, 'sigma_px': float} | dict.fromkeys(CORNER_FIELDS, float)
    stamps, ids, sigmas, *corners = _rows(path, kinds)
    corners_px = np.array(corners, np.float64).T.reshape(-1, 4, 2)
    return Detections(np.array(stamps, np.int64), np.array(ids, np.int64), corners_px, np.array(sigmas, np.float64))


def _latencies(path: Path) -> dict[str, tuple[IntArray, FloatArray]]:
    kinds, stamps, values = _rows(path, {'kind': str, 'stamp_ns': int, 'latency_ms': float})
    kind_of, stamp, value = np.array(kinds), np.array(stamps, np.int64), np.array(values, np.float64)
    return {kind: (stamp[kind_of == kind], value[kind_of == kind]) for kind in dict.fromkeys(kinds)}


def _output(path: Path, offset_ns: int) -> RecordedOutput:
    if not path.is_dir():
        return RecordedOutput()
    with BagReader(path) as bag:
        statuses = [status for item in bag.messages(['diagnostics']) for status in item.message.status]
        return RecordedOutput(*_covariances(bag), _diagnostics(statuses), _innovations(statuses, offset_ns))


def _covariances(bag: BagReader) -> tuple[IntArray, FloatArray]:
    every = 1 + bag.message_count(['pose']) // MOST_COVARIANCES
    messages = [item.message for index, item in enumerate(bag.messages(['pose'])) if index % every == 0]
    stamps = [message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec for message in messages]
    covariances = [message.pose.covariance for message in messages]
    return np.array(stamps, np.int64), np.array(covariances, np.float64).reshape(-1, 6, 6)


def _diagnostics(statuses: Iterable[Any]) -> tuple[Diagnostic, ...]:
    said: Counter[tuple[str, str, str]] = Counter()
    for status in statuses:
        level = status.level[0] if isinstance(status.level, (bytes, np.ndarray)) else status.level
        said[status.name, _LEVELS[min(int(level), 3)], _NUMBER.sub('…', status.message)] += 1
    return tuple(Diagnostic(*key, count) for key, count in said.most_common())


def _innovations(statuses: Iterable[Any], offset_ns: int) -> Innovations:
    told = innovations_of(
        ' '.join(item.value for status in statuses for item in status.values if item.key == INNOVATIONS)
    )
    return replace(told, stamps_ns=told.stamps_ns + offset_ns)
