"""Latency, losses and processor time of the nodes, one process each, in real time: ``make latency``.

The same simulated flight on an idle machine and beside two busy loops of ordinary priority, which is what the onboard
computer is like when something else goes wrong. Times depend on the machine; the ratios of the second row to the first
do so less.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import csv
from dataclasses import dataclass
import json
import math
from pathlib import Path
import subprocess
import sys
import tempfile

TABLE = Path(__file__).resolve().parents[1] / 'doc' / 'tables' / 'latency.md'
#: Older frames are of no use to a drone [ms].
_OLD_MS = 100.0


@dataclass(frozen=True)
class Measured:
    """One replay."""

    load: str
    imu_median: float
    imu_p99: float
    frame_median: float
    frame_p99: float
    old_frames: int
    lost_imu: int
    lost_frames: int
    left_frames: int
    cpu: dict[str, float]


def main() -> None:
    """Measure and print; ``--write`` puts the table where the documents take it from."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--write', action='store_true')
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'bag'
        _thermal_fiducial('simulate', bag, '--scenario', 'wall', '--seconds', arguments.seconds)
        rows = [_measured(bag, Path(folder) / 'idle', 'idle')]
        with busy_loops(2):
            rows.append(_measured(bag, Path(folder) / 'busy', 'two busy loops'))
    text = table(rows)
    print(text)
    if arguments.write:
        TABLE.write_text(text + '\n', encoding='utf-8')


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """Processes that do nothing but work."""
    loops = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def _measured(bag: Path, run: Path, load: str) -> Measured:
    _thermal_fiducial(
        'replay', bag, '--out', run, '--params', bag / 'params.yaml', '--map', bag / 'map_true.yaml', '--mode',
        'localization', '--transport', 'processes', '--no-report',
    )  # fmt: skip
    summary = json.loads((run / 'summary.json').read_text())
    with (run / 'latency.csv').open() as file:
        corrected = [float(row['latency_ms']) for row in csv.DictReader(file) if row['kind'].endswith('corrected_pose')]
    given, figures, times = summary['messages_in'], summary['diagnostics'], summary['latency_ms']
    imu, frame = times['imu_to_pose'], times.get('image_to_corrected_pose', {})
    left = sum(int(value) for node in figures.values() for key, value in node.items() if key.startswith('left '))
    return Measured(
        load,
        imu['median'],
        imu['p99'],
        frame.get('median', math.inf),
        frame.get('p99', math.inf),
        sum(value > _OLD_MS for value in corrected),
        given['imu/data'] - int(figures['pose_ekf']['received /imu/data']),
        _lost_frames(given['thermal/image_raw'], figures['tau2_camera'], figures['aruco_detector']),
        left,
        summary['cpu_percent'],
    )


def _lost_frames(given: int, camera: dict[str, str], detector: dict[str, str]) -> int:
    """Frames that did not reach the front end, and those that it sent on and the detector neither used nor left."""
    used = int(detector['published /markers']) + int(detector.get('left /thermal/image', 0))
    return given - int(camera['received /thermal/image_raw']) + int(camera['published /thermal/image']) - used


def table(rows: list[Measured]) -> str:
    """Markdown of the measurements, a row each, and of the last row's ratios to the first."""
    lines = [
        '| load | IMU to pose, median / p99 [ms] | image to corrected pose, median / p99 [ms] | frames older than '
        '100 ms | lost: IMU / images / left for newer ones | CPU of camera, detector, mapper, filter [% of a core] |',
        '|---|---|---|---|---|---|',
    ]
    for row in rows:
        cpu = ', '.join(f'{value:.0f}' for value in row.cpu.values())
        lines.append(
            f'| {row.load} | {row.imu_median:.1f} / {row.imu_p99:.1f} | {row.frame_median:.0f} / {row.frame_p99:.0f} '
            f'| {row.old_frames} | {row.lost_imu} / {row.lost_frames} / {row.left_frames} '
            f'| {cpu}: {sum(row.cpu.values()):.0f} |'
        )
    first, last = rows[0], rows[-1]
    ratios = [
        f'{last.imu_median / first.imu_median:.1f} / {last.imu_p99 / first.imu_p99:.1f}',
        f'{last.frame_median / first.frame_median:.1f} / {last.frame_p99 / first.frame_p99:.1f}',
    ]
    cpu_ratio = sum(last.cpu.values()) / sum(first.cpu.values())
    return '\n'.join([*lines, f'| ratio | {ratios[0]} | {ratios[1]} | | | {cpu_ratio:.2f} |'])


def _thermal_fiducial(*words: object) -> None:
    subprocess.run([sys.executable, '-m', 'thermal_fiducial', *map(str, words)], check=True, stdout=sys.stderr)


if __name__ == '__main__':
    main()
