"""Data of the recorded messages that are not in the text files of a run folder."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.core.wording import without_numbers
from thermal_fiducial.files.bags import BagReader, CAMERA_POSE_TOPIC, MARKERS_TOPIC
from thermal_fiducial.files.images import header_stamp_ns, stamp_to_ns
from thermal_fiducial.files.innovations import INNOVATIONS, Innovations, innovations_of

#: Most messages from which covariances are read, evenly over the run.
MOST_COVARIANCES = 6000
_POSE, _DIAGNOSTICS = 'pose', 'diagnostics'
_WITHHELD = 'withheld: '
WARNING = 'warning'
_LEVELS = ('ok', WARNING, 'error', 'stale')


@dataclass(frozen=True)
class Diagnostic:
    """A diagnostic message of a node, which may have come several times."""

    node: str
    level: str
    #: with N for each number
    message: str
    #: as it was said last, with its numbers
    latest: str
    #: when it came, by the clock of the bag [ns]
    times_ns: tuple[int, ...]

    @property
    def count(self) -> int:
        """How often it was said."""
        return len(self.times_ns)


@dataclass(frozen=True)
class Arrivals:
    """Stamps (N,) of messages and their arrival times (N,) [ns], in the order of the stamps."""

    stamps_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    times_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True)
class RecordedOutput:
    """What the recorded messages of the nodes say beyond the text files.

    Parameters
    ----------
    stamps_ns, covariances : (N,), (N, 6, 6) of some of the ``pose`` messages
    diagnostics : messages of the nodes, most frequent first
    innovations : of the camera poses, at the IMU's stamps
    frames_ns : (F,) IMU's stamps of the processed frames, without dropped ones
    withheld : time of a diagnostic [ns] and number of frames dropped until then, by reason
    figures : key of the filter's diagnostics to times (D,) [ns] and values (D,), once a second
    fused_arrivals, camera_arrivals : of ``pose`` and ``camera_pose``, at the IMU's stamps
    """

    stamps_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    covariances: FloatArray = field(default_factory=lambda: np.zeros((0, 6, 6)))
    diagnostics: tuple[Diagnostic, ...] = ()
    innovations: Innovations = field(default_factory=Innovations)
    frames_ns: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    withheld: tuple[tuple[int, dict[str, int]], ...] = ()
    figures: dict[str, tuple[IntArray, FloatArray]] = field(default_factory=dict)
    fused_arrivals: Arrivals = field(default_factory=Arrivals)
    camera_arrivals: Arrivals = field(default_factory=Arrivals)

    def withheld_between(self, start_ns: int, end_ns: int) -> dict[str, int]:
        """Frames dropped between two times by reason; counted once a second, so up to a second more."""
        before: dict[str, int] = {}
        after: dict[str, int] = {}
        for time_ns, counts in self.withheld:
            if time_ns <= start_ns:
                before = counts
            else:
                after = counts
            if time_ns >= end_ns:
                break
        return {reason: n - before.get(reason, 0) for reason, n in after.items() if n > before.get(reason, 0)}


def read_output(path: Path, offset_ns: int) -> RecordedOutput:
    """Read the ``output`` of a run folder; empty if there is none.

    Parameters
    ----------
    path : the bag
    offset_ns : t_imu - t_camera

    Raises
    ------
    InputError
        An unreadable bag.
    """
    if not path.is_dir():
        return RecordedOutput()
    with BagReader(path) as bag:
        # By when they came, in the clock of the bag: nodes in processes of their own stamp them with the wall clock.
        arrays = [(item.stamp_ns, item.message) for item in bag.messages([_DIAGNOSTICS])]
        statuses = [status for _, array in arrays for status in array.status]
        stamps, covariances = _covariances(bag)
        return RecordedOutput(
            stamps_ns=stamps,
            covariances=covariances,
            diagnostics=_diagnostics(arrays),
            innovations=_innovations(statuses, offset_ns),
            frames_ns=_arrivals(bag, MARKERS_TOPIC, offset_ns).stamps_ns,
            withheld=_withheld(arrays),
            figures=_figures(arrays),
            fused_arrivals=_arrivals(bag, _POSE, 0),
            camera_arrivals=_arrivals(bag, CAMERA_POSE_TOPIC, offset_ns),
        )


def _covariances(bag: BagReader) -> tuple[IntArray, FloatArray]:
    every = 1 + bag.message_count([_POSE]) // MOST_COVARIANCES
    messages = [item.message for index, item in enumerate(bag.messages([_POSE])) if index % every == 0]
    stamps = [stamp_to_ns(message.header.stamp) for message in messages]
    covariances = [message.pose.covariance for message in messages]
    return np.array(stamps, np.int64), np.array(covariances, np.float64).reshape(-1, 6, 6)


def _arrivals(bag: BagReader, topic: str, offset_ns: int) -> Arrivals:
    rows = [(header_stamp_ns(item.cdr) + offset_ns, item.stamp_ns) for item in bag.messages([topic])]
    stamps, times = np.array(sorted(rows), np.int64).reshape(-1, 2).T
    return Arrivals(stamps, times)


def _diagnostics(arrays: Sequence[tuple[int, Any]]) -> tuple[Diagnostic, ...]:
    times: defaultdict[tuple[str, str, str], list[int]] = defaultdict(list)
    latest: dict[tuple[str, str, str], str] = {}
    for time_ns, array in arrays:
        for status in array.status:
            level = status.level[0] if isinstance(status.level, (bytes, np.ndarray)) else status.level
            key = status.name, _LEVELS[min(int(level), 3)], without_numbers(status.message)
            times[key].append(time_ns)
            latest[key] = status.message
    said = [Diagnostic(*key, latest[key], tuple(when)) for key, when in times.items()]
    return tuple(sorted(said, key=lambda one: -one.count))


def _innovations(statuses: Iterable[Any], offset_ns: int) -> Innovations:
    said = innovations_of(
        ' '.join(item.value for status in statuses for item in status.values if item.key == INNOVATIONS)
    )
    return replace(said, stamps_ns=said.stamps_ns + offset_ns)


def _withheld(arrays: Sequence[tuple[int, Any]]) -> tuple[tuple[int, dict[str, int]], ...]:
    found = []
    for time_ns, array in arrays:
        for status in array.status:
            if status.name.rpartition('/')[2] == 'tau2_camera':
                counts = {
                    item.key.removeprefix(_WITHHELD): int(item.value)
                    for item in status.values
                    if item.key.startswith(_WITHHELD) and item.value.isdigit()
                }
                found.append((time_ns, counts))
    return tuple(found)


def _figures(arrays: Sequence[tuple[int, Any]]) -> dict[str, tuple[IntArray, FloatArray]]:
    found: defaultdict[str, list[tuple[int, float]]] = defaultdict(list)
    for time_ns, array in arrays:
        for status in array.status:
            if status.name.rpartition('/')[2] == 'pose_ekf':
                for item in status.values:
                    if (value := _number(item.value)) is not None:
                        found[item.key].append((time_ns, value))
    return {
        key: (np.array([time for time, _ in rows], np.int64), np.array([value for _, value in rows]))
        for key, rows in found.items()
    }


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if np.isfinite(value) else None
