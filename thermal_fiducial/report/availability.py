"""Errors as seen by a controller: of the newest available pose at each instant, fused and from the markers alone.

Poses from markers arrive at the camera's rate and late, fused ones at the IMU's rate with little delay. A comparison
at the stamps of frames only would flatter the markers. Here each pose is held from its arrival to that of the next one,
for both kinds.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from thermal_fiducial.core.geometry.se3 import so3_log
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray
from thermal_fiducial.report import metrics
from thermal_fiducial.report.interruptions import GAP_NS, ONE_CLOCK_NS
from thermal_fiducial.report.output_bag import Arrivals
from thermal_fiducial.report.run_folder import Run
from thermal_fiducial.report.trajectory import Trajectory

#: Interval of the instants [ns], incommensurate with the rates of the poses; largest number of instants.
STEP_NS = 1_730_000
MOST_INSTANTS = 200_000


@dataclass(frozen=True)
class Available:
    """Errors of the newest available pose at instants (N,) [ns]: (N, 2) position [m] and attitude [rad]."""

    instants_ns: IntArray
    fused: FloatArray
    markers: FloatArray
    #: (N,) whether the newest pose from markers is younger than the shortest interruption
    in_view: BoolArray
    #: median age of the newest pose [ms]
    fused_age_ms: float
    markers_age_ms: float

    def numbers(self) -> dict[str, Any]:
        """Errors while markers are in view, and at all instants."""
        return {
            'age_ms': {'fused': self.fused_age_ms, 'markers': self.markers_age_ms},
            'in_view': self._spread(self.in_view),
            'always': self._spread(np.ones(len(self.in_view), np.bool_)),
        }

    def _spread(self, chosen: BoolArray) -> dict[str, dict[str, float]]:
        return {
            name: _figures(errors[chosen])
            for name, errors in (('fused', self.fused), ('markers', self.markers))
            if chosen.any()
        }


def _figures(errors: FloatArray) -> dict[str, float]:
    """Figures of errors (N, 2) [m, rad], in mm and deg."""
    return metrics.spread(1e3 * errors[:, 0], np.rad2deg(errors[:, 1]), ('rms', 'p95', 'max'))


def available(run: Run) -> Available | None:
    """Errors as seen by a controller; None without truth or arrival times."""
    fused, markers = run.output.fused_arrivals, run.output.camera_arrivals
    if run.truth is None or not (len(fused.stamps_ns) and len(markers.stamps_ns)):
        return None
    shift_ns = _clock_shift_ns(fused)
    fused_times, markers_times = _times_of(run.fused, fused, shift_ns), _times_of(run.fiducial, markers, shift_ns)
    if not (len(fused_times) and len(markers_times)):
        return None
    first, last = max(fused_times[0], markers_times[0]), min(fused_times[-1], run.truth.stamps_ns[-1])
    instants = np.arange(first, last, max(STEP_NS, (last - first) // MOST_INSTANTS), dtype=np.int64)
    T_true, exists = metrics.interpolate(run.truth, instants)
    instants, T_true = instants[exists], T_true[exists]
    if not len(instants):
        return None
    fused_errors, fused_age = _held(run.fused, fused_times, instants, T_true)
    markers_errors, markers_age = _held(run.fiducial, markers_times, instants, T_true)
    return Available(
        instants_ns=instants,
        fused=fused_errors,
        markers=markers_errors,
        in_view=np.asarray(markers_age < GAP_NS),
        fused_age_ms=1e-6 * float(np.median(fused_age)),
        markers_age_ms=1e-6 * float(np.median(markers_age)),
    )


def at_frames(run: Run) -> dict[str, dict[str, float]] | None:
    """Errors of both kinds of poses at the stamps of frames with a pose; None without truth."""
    if run.truth is None or not (len(run.fused) and len(run.fiducial)):
        return None
    stamps = run.fiducial.stamps_ns
    T_true, exists = metrics.interpolate(run.truth, stamps)
    T_fused, known = metrics.interpolate(run.fused, stamps)
    both = exists & known
    if not both.any():
        return None
    return {
        'fused': _figures(_errors(T_fused[both], T_true[both])),
        'markers': _figures(_errors(run.fiducial.T_map_body[both], T_true[both])),
    }


def _clock_shift_ns(fused: Arrivals) -> int:
    """Offset to subtract from arrival times if their clock differs from that of the stamps; else 0."""
    least = int(np.min(fused.times_ns - fused.stamps_ns))
    return least if not 0 <= least < ONE_CLOCK_NS else 0


def _times_of(trajectory: Trajectory, arrivals: Arrivals, shift_ns: int) -> IntArray:
    """Arrival time of each pose, made non-decreasing; empty if unknown."""
    at = np.searchsorted(arrivals.stamps_ns, trajectory.stamps_ns)
    at = np.clip(at, 0, len(arrivals.stamps_ns) - 1)
    if not len(at) or np.mean(arrivals.stamps_ns[at] == trajectory.stamps_ns) < 0.99:
        return np.zeros(0, np.int64)
    return np.maximum.accumulate(arrivals.times_ns[at] - shift_ns)


def _held(
    trajectory: Trajectory, times_ns: IntArray, instants_ns: IntArray, T_true: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Errors (N, 2) of the newest pose at each instant, and its age (N,) [ns]."""
    newest = np.maximum(np.searchsorted(times_ns, instants_ns, side='right') - 1, 0)
    age = instants_ns - trajectory.stamps_ns[newest]
    return _errors(trajectory.T_map_body[newest], T_true), age


def _errors(T: FloatArray, T_true: FloatArray) -> FloatArray:
    position = np.linalg.norm(T[:, :3, 3] - T_true[:, :3, 3], axis=1)
    attitude = np.linalg.norm(so3_log(np.swapaxes(T[:, :3, :3], 1, 2) @ T_true[:, :3, :3]), axis=1)
    return np.stack([position, attitude], axis=1)
