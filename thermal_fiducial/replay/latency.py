"""Latencies of the nodes: from an IMU message to its pose, from a frame to the first pose that it corrected."""

import csv
from pathlib import Path

import numpy as np

IMU_TO_POSE = 'imu_to_pose'
IMAGE_TO_CAMERA_POSE = 'image_to_camera_pose'
IMAGE_TO_CORRECTED_POSE = 'image_to_corrected_pose'


class LatencyMeter:
    """Pairs sent messages with the results received, all times of one monotonic clock [ns]."""

    def __init__(self) -> None:
        self._sent: dict[str, dict[int, int]] = {'image': {}, 'imu': {}}
        self._uncorrected: list[int] = []
        self._running = False
        self._rows: list[tuple[str, int, float]] = []

    def sent(self, kind: str, stamp_ns: int, now_ns: int) -> None:
        """Record that an ``image`` or ``imu`` message was published."""
        self._sent[kind][stamp_ns] = now_ns

    def camera_pose(self, stamp_ns: int, now_ns: int) -> None:
        """Record a camera pose: a correction if the filter runs, else part of its initialisation."""
        self._pair(IMAGE_TO_CAMERA_POSE, 'image', stamp_ns, now_ns)
        if self._running:
            self._uncorrected.append(stamp_ns)

    def pose(self, stamp_ns: int, now_ns: int) -> None:
        """Record a pose; the first after a camera pose carries its correction."""
        self._running = True
        self._pair(IMU_TO_POSE, 'imu', stamp_ns, now_ns)
        for frame_ns in self._uncorrected:
            self._pair(IMAGE_TO_CORRECTED_POSE, 'image', frame_ns, now_ns)
        self._uncorrected.clear()

    def _pair(self, name: str, kind: str, stamp_ns: int, now_ns: int) -> None:
        sent_ns = self._sent[kind].get(stamp_ns)
        if sent_ns is not None:
            self._rows.append((name, stamp_ns, (now_ns - sent_ns) * 1e-6))

    def summary(self) -> dict[str, dict[str, float]]:
        """Median and upper percentiles of each latency [ms]."""
        result = {}
        for name in (IMU_TO_POSE, IMAGE_TO_CAMERA_POSE, IMAGE_TO_CORRECTED_POSE):
            values = [value for kind, _, value in self._rows if kind == name]
            if values:
                median, p95, p99 = np.percentile(values, [50, 95, 99]).tolist()
                result[name] = {'median': median, 'p95': p95, 'p99': p99, 'max': max(values), 'count': len(values)}
        return result

    def write(self, path: Path) -> None:
        """Write every latency: ``kind,stamp_ns,latency_ms``."""
        with path.open('w', encoding='utf-8', newline='') as file:
            writer = csv.writer(file, lineterminator='\n')
            writer.writerow(['kind', 'stamp_ns', 'latency_ms'])
            writer.writerows((kind, stamp, f'{value:.3f}') for kind, stamp, value in self._rows)
