"""Records the nodes' outputs into a run folder as they arrive."""

from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack, suppress
from decimal import Decimal
from functools import partial
from pathlib import Path
import shutil
from typing import Any, Protocol, Self, TextIO

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Pose, PoseWithCovarianceStamped
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from thermal_fiducial.core.geometry.se3 import inverse
from thermal_fiducial.core.measurements import CORNER_FIELDS
from thermal_fiducial.core.types import FloatArray
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bag_writer import BagWriter
from thermal_fiducial.files.trajectory_file import tum_line
from thermal_fiducial.files.writing import claim, is_claimed, unfinished, write_text
from thermal_fiducial.replay.topics import TopicTypes, type_name
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.messages import clouds, convert

_FUSED, _FIDUCIAL, _DETECTIONS = _TABLES = ('fused.tum', 'fiducial.tum', 'detections.csv')


class Sink(Protocol):
    """Receiver of the nodes' outputs."""

    folder: Path

    def add(self, topic: str, time_ns: int, data: bytes) -> None:
        """Take one message, as CDR bytes, that came at ``time_ns`` of the bag's clock."""


def refuse_folder_in_use(folder: Path) -> None:
    """Raise InputError if another replay is writing into a run folder; both would mix their lines."""
    if is_claimed(unfinished(folder / _TABLES[0])):
        raise InputError(f'{folder}: another replay is writing there')


class RunFiles:
    """Files of a run folder that grow with the messages; a context manager that removes them on an exception.

    Tables have temporary names until they are complete, so that a killed replay leaves none that looks complete.

    Parameters
    ----------
    folder : the run folder; files of an earlier run are replaced
    T_body_camera : (4, 4) extrinsics, to turn camera poses into body poses
    topics : topics of ``output`` with their types
    """

    def __init__(self, folder: Path, T_body_camera: FloatArray, topics: TopicTypes) -> None:
        self.folder = folder
        self._T_camera_body = inverse(T_body_camera)
        self.counts: Counter[str] = Counter()
        self.frames_with_markers = 0
        self.warnings: Counter[str] = Counter()
        #: node to its last diagnostic message, if that was not OK
        self.complaints: dict[str, str] = {}
        self._last_figures: dict[str, dict[str, str]] = {}
        shutil.rmtree(folder / 'output', ignore_errors=True)
        for name in _TABLES:
            (folder / name).unlink(missing_ok=True)
        self._bag = BagWriter(folder / 'output')
        self._ending = ExitStack()
        #: name to the open file
        self._tables: dict[str, TextIO] = {}
        self._types = {topic: type_name(kind) for topic, (kind, _) in topics.items()}
        self._readers: dict[str, tuple[type, Callable[[Any], None]]] = {
            'pose': (PoseWithCovarianceStamped, self._on_pose),
            'camera_pose': (PoseWithCovarianceStamped, self._on_camera_pose),
            'markers': (PointCloud2, self._on_markers),
            '/diagnostics': (DiagnosticArray, self._on_diagnostics),
        }

    def __enter__(self) -> Self:
        with ExitStack() as ending:
            ending.push(self._put_in_place)
            ending.enter_context(self._bag)
            for topic, msgtype in self._types.items():
                self._bag.add_topic(topic, msgtype)
            ending.push(self._sort_late_frames)
            for name in _TABLES:
                self._tables[name] = ending.enter_context(unfinished(self.folder / name).open('w', encoding='utf-8'))
            claim(self._tables[_FUSED])
            self._tables[_DETECTIONS].write(','.join(['stamp_ns', 'id', *CORNER_FIELDS, 'sigma_px']) + '\n')
            self._ending = ending.pop_all()
        return self

    def __exit__(self, *exception: Any) -> None:
        self._ending.__exit__(*exception)

    def _sort_late_frames(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            _sort_by_stamp(unfinished(self.folder / _FIDUCIAL))

    def _put_in_place(self, kind: type[BaseException] | None, *_: object) -> None:
        """Give the tables their final names; after an exception remove them, as half a run looks like a whole one."""
        for path in (self.folder / name for name in _TABLES):
            if kind is None:
                unfinished(path).replace(path)
            else:
                unfinished(path).unlink(missing_ok=True)
        if kind is not None:
            (self.folder / 'latency.csv').unlink(missing_ok=True)

    def add(self, topic: str, time_ns: int, data: bytes) -> None:
        """Take one published message, as CDR bytes, that came at ``time_ns`` of the bag's clock."""
        self.counts[topic] += 1
        self._bag.write(topic, time_ns, data, self._types[topic])
        if topic in self._readers:
            kind, read = self._readers[topic]
            # A bag that begins behind the detector may have some that the nodes refuse, and say so.
            with suppress(InputError):
                read(deserialize_message(data, kind))

    @property
    def figures(self) -> dict[str, dict[str, str]]:
        """Node to the figures of its last diagnostics."""
        return dict(sorted(self._last_figures.items()))

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        _write_pose(self._tables[_FUSED], message, message.pose.pose)

    def _on_camera_pose(self, message: PoseWithCovarianceStamped) -> None:
        T_map_body = convert.transform_of(message.pose.pose) @ self._T_camera_body
        _write_pose(self._tables[_FIDUCIAL], message, convert.pose(T_map_body))

    def _on_markers(self, message: PointCloud2) -> None:
        stamp = convert.stamp_ns(message.header.stamp)
        rows = clouds.markers(message)
        self.frames_with_markers += len(rows) > 0
        for row in rows:
            values = [f'{row[name]:.5f}' for name in (*CORNER_FIELDS, 'sigma_px')]
            self._tables[_DETECTIONS].write(f'{stamp},{row["id"]},{",".join(values)}\n')

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._last_figures[status.name] = {value.key: value.value for value in status.values}
            self.complaints.pop(status.name, None)
            if status.level != DiagnosticStatus.OK:
                self.complaints[status.name] = status.message
                self.warnings[f'{status.name}: {status.message}'] += 1


class Recorder(CountingNode):
    """Subscribes to the nodes' outputs and passes them on as (topic, bytes)."""

    def __init__(self, take: Callable[[str, bytes], None], topics: TopicTypes, **kwargs: Any) -> None:
        super().__init__('recorder', **kwargs)
        for topic, (kind, profile) in topics.items():
            self.subscribe(kind, topic, partial(take, topic), profile, raw=True)


def _sort_by_stamp(path: Path) -> None:
    """Sort the lines of late frames in, since a trajectory's stamps must increase."""
    lines = path.read_text(encoding='utf-8').splitlines(keepends=True)
    write_text(path, ''.join(sorted(lines, key=lambda line: Decimal(line.split(maxsplit=1)[0]))))


def _write_pose(file: TextIO, message: PoseWithCovarianceStamped, pose: Pose) -> None:
    p, q = pose.position, pose.orientation
    file.write(tum_line(convert.stamp_ns(message.header.stamp), (p.x, p.y, p.z), (q.x, q.y, q.z, q.w)) + '\n')
