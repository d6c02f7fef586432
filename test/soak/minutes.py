"""What is measured in each minute of flight, and what is made of it."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
import psutil
from rclpy.serialization import deserialize_message

from soak.laps import Laps
from thermal_fiducial.ros.messages import convert

MINUTE_NS = 60_000_000_000
#: What a node may grow by after the second minute, when all that is made on first use is there [MB].
GROWTH_MB = 5.0
#: What the error may rise by from the second minute to the last [mm], beside three standard errors.
TREND_MM = 1.0
#: Of the IMU's messages, how many may have no pose: the filter's start, and single ones lost on a busy machine.
LOST_SHARE = 0.02


@dataclass(frozen=True)
class Minute:
    """One minute: MB and per cent of a core by node, poses, root mean square and worst error of their positions.

    Memory is the least of the minute's last half, which is longer than a lap: what is kept, without what a refinement
    of the map has for a moment (14 MB). ``shared_mb`` is what of it is pages of DDS's shared memory. They belong to the
    segments of all nodes, and count for every node that has read a message from them.
    """

    memory_mb: dict[str, float]
    shared_mb: dict[str, float]
    cpu_percent: dict[str, float]
    poses: int
    rms_mm: float
    worst_mm: float


class Errors:
    """Takes what the nodes publish, and keeps how far off the poses were."""

    def __init__(self, laps: Laps, folder: Path) -> None:
        self.folder, self._laps = folder, laps
        self._errors_m: list[float] = []

    def add(self, topic: str, time_ns: int, data: bytes) -> None:
        """Take one message; ``time_ns`` does not matter."""
        if topic == 'pose':
            message = deserialize_message(data, PoseWithCovarianceStamped)
            position = convert.transform_of(message.pose.pose)[:3, 3]
            truth = self._laps.truth(convert.stamp_ns(message.header.stamp))
            self._errors_m.append(float(np.linalg.norm(position - truth[:3, 3])))

    def take(self) -> np.ndarray:
        """Errors since the last call [m]."""
        taken, self._errors_m = np.array(self._errors_m), []
        return taken


class Meter:
    """A row a minute of flight; to be called each second.

    Parameters
    ----------
    errors : of the poses
    processes : by the name of the node; asked anew each minute
    say : takes each row as it comes
    """

    def __init__(self, errors: Errors, processes, say) -> None:
        self._errors, self._processes, self._say = errors, processes, say
        self.minutes: list[Minute] = []
        self._cpu: dict[str, float] = {}
        self._found: dict[str, psutil.Process] = {}
        #: MB by node, all and of it shared
        self._least: dict[str, tuple[float, float]] = {}
        self._at_ns = 0

    def __call__(self, elapsed_ns: int) -> None:
        """Note what is to be noted at this time of the flight."""
        over = elapsed_ns // MINUTE_NS > self._at_ns // MINUTE_NS
        if over or elapsed_ns % MINUTE_NS >= MINUTE_NS // 2:
            self._weigh()
        if self._cpu and not over:
            return
        seconds, self._at_ns = (elapsed_ns - self._at_ns) * 1e-9, elapsed_ns
        self._found = self._processes()
        times = {name: sum(process.cpu_times()[:2]) for name, process in self._found.items()}
        before, self._cpu = self._cpu, times
        least, self._least = self._least, {}
        if before:
            memory, shared = ({name: held[k] for name, held in least.items()} for k in range(2))
            cpu = {name: 100.0 * (times[name] - before[name]) / seconds for name in times}
            errors = 1e3 * self._errors.take()
            rms, worst = (np.sqrt(np.mean(errors**2)), errors.max()) if len(errors) else (0.0, 0.0)
            self.minutes.append(Minute(memory, shared, cpu, len(errors), float(rms), float(worst)))
            self._say(row(len(self.minutes), self.minutes[-1]))

    def _weigh(self) -> None:
        """Note what the processes hold now, where it is less than before."""
        for name, process in self._found.items():
            held = process.memory_info().rss / 2**20, shared_mb(process.pid)
            self._least[name] = min(held, self._least.get(name, held))


def shared_mb(pid: int) -> float:
    """Pages of shared memory that a process has touched."""
    lines = Path(f'/proc/{pid}/status').read_text().splitlines()
    (kilobytes,) = [line.split()[1] for line in lines if line.startswith('RssShmem:')]
    return int(kilobytes) / 1024


def node_processes(names: Iterable[str]) -> dict[str, psutil.Process]:
    """The nodes among this process's children."""
    found = {}
    for child in psutil.Process().children():
        # A process that has ended has no command line any more.
        with suppress(psutil.NoSuchProcess):
            words = child.cmdline()
            found |= {name: child for name in names if f'thermal_fiducial.nodes.{name}' in words}
    return found


HEAD = '| minute | memory [MB] | CPU [% of a core] | poses | error rms / worst [mm] |\n|---|---|---|---|---|'


def row(number: int, minute: Minute) -> str:
    """One of the table."""
    memory = ', '.join(f'{value:.1f}' for value in minute.memory_mb.values())
    cpu = ', '.join(f'{value:.0f}' for value in minute.cpu_percent.values())
    return (
        f'| {number} | {memory} | {cpu}: {sum(minute.cpu_percent.values()):.0f} | {minute.poses} '
        f'| {minute.rms_mm:.1f} / {minute.worst_mm:.1f} |'
    )


def growth_mb(minutes: list[Minute]) -> dict[str, tuple[float, float]]:
    """What each node has grown by since the second minute, or since the first of two: all, and of it shared memory."""
    settled, last = minutes[min(1, len(minutes) - 2)], minutes[-1]
    return {
        name: (last.memory_mb[name] - value, last.shared_mb[name] - settled.shared_mb[name])
        for name, value in settled.memory_mb.items()
    }


def trend_mm(minutes: list[Minute]) -> tuple[float, float]:
    """What a line through the errors of all minutes but the first, which maps, rises by; its standard error."""
    errors = np.array([minute.rms_mm for minute in minutes[1:]])
    if len(errors) < 3:
        return (float(errors[-1] - errors[0]), 0.0) if len(errors) else (0.0, 0.0)
    times = np.arange(len(errors)) - 0.5 * (len(errors) - 1)
    slope = times @ errors / (times @ times)
    residuals = errors - np.mean(errors) - slope * times
    deviation = np.sqrt(residuals @ residuals / (len(errors) - 2) / (times @ times))
    return float(slope * (len(errors) - 1)), float(deviation * (len(errors) - 1))


def faults(minutes: list[Minute], imu_count: int, warnings: list[str]) -> list[str]:
    """What is wrong with a soak, in words."""
    found = [f'said: {line}' for line in warnings]
    if len(minutes) < 2:
        return [*found, 'not two minutes were flown']
    for name, (grown, shared) in growth_mb(minutes).items():
        if grown > GROWTH_MB:
            found.append(f'{name} grew by {grown:.1f} MB, {shared:.1f} of it shared memory')
    trend, deviation = trend_mm(minutes)
    if trend > TREND_MM + 3.0 * deviation:
        found.append(f'the error grew by {trend:.1f} mm')
    poses = sum(minute.poses for minute in minutes)
    if poses < (1.0 - LOST_SHARE) * imu_count:
        found.append(f'{poses} poses of {imu_count} samples of the IMU')
    return found
