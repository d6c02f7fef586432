"""The measures of one run, as one nested dictionary: what ``summary.json`` and the tables show."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from thermal_fiducial.core.mapping.map_data import MarkerMap
from thermal_fiducial.core.types import BoolArray, FloatArray, IntArray, SECOND_NS
from thermal_fiducial.report import metrics
from thermal_fiducial.report.availability import at_frames, Available, available
from thermal_fiducial.report.interruptions import imu_silence_ns, Interruption, interruptions, run_span
from thermal_fiducial.report.map_error import doubt_of_dictionary, map_accuracy
from thermal_fiducial.report.marker_table import Tag, tags
from thermal_fiducial.report.run_folder import Run
from thermal_fiducial.report.truth_clock import doubt_of_clock

#: Sampling interval of the NEES [ns]: errors are correlated over time, so denser samples add no evidence.
CONSISTENCY_NS = 100_000_000
# How many times closer to the run attitudes in another order are where the order is the likely cause: those of a usable
# run are within a degree or two, and 180 deg off in the wrong order where the robot is level.
_TIMES_CLOSER = 50.0


@dataclass(frozen=True)
class Evaluation:
    """A run with its errors, which are None without truth."""

    run: Run
    fused_errors: metrics.Errors | None
    fiducial_errors: metrics.Errors | None
    interruptions: list[Interruption]

    @cached_property
    def available(self) -> Available | None:
        """Errors as seen by a controller; None if unknown."""
        return available(self.run)

    @cached_property
    def tags(self) -> list[Tag]:
        """One row per marker."""
        return tags(self.run)

    @cached_property
    def doubt_of_truth(self) -> str:
        """That the ground truth seems to be of other markers, in another clock, or to have w before x y z, in words.

        Empty if not.
        """
        if (maps := self._comparable_maps()) is not None and (doubt := doubt_of_dictionary(*maps)):
            return doubt
        e, truth = self.fused_errors, self.run.truth
        if e is None or truth is None or not len(e):
            return ''
        if doubt := doubt_of_clock(e, truth):
            return doubt
        as_read, reordered = metrics.rms(e.attitude_deg), metrics.attitude_in_other_order(e)
        if as_read <= _TIMES_CLOSER * reordered:
            return ''
        apart = (
            f'The attitude is {as_read:.0f} deg off, and {reordered:.2g} deg with the quaternions of the ground truth'
        )
        return f'{apart} as w x y z: they must be x y z w.'

    @property
    def start_ns(self) -> int:
        """First stamp of the run: zero of the plots' time."""
        first, _ = run_span(self.run)
        detections = self.run.detections.stamps_ns
        return min(first, int(detections[0])) if len(detections) and first else first

    def seconds(self, stamps_ns: IntArray) -> FloatArray:
        """Time of the plots [s]."""
        return np.asarray((stamps_ns - self.start_ns) / SECOND_NS)

    def seconds_at(self, stamp_ns: int) -> float:
        """Time of the plots [s] of one stamp."""
        return (stamp_ns - self.start_ns) / SECOND_NS

    @property
    def covariances(self) -> tuple[metrics.Errors, FloatArray] | None:
        """Errors of the fused poses with recorded covariances, and the covariances (N, 6, 6)."""
        e, output = self.fused_errors, self.run.output
        if e is None or not len(e) or not len(output.stamps_ns):
            return None
        at = np.clip(np.searchsorted(e.stamps_ns, output.stamps_ns), 0, len(e) - 1)
        same = e.stamps_ns[at] == output.stamps_ns
        at = at[same]
        return metrics.Errors(e.stamps_ns[at], e.d[at], e.estimate[at], e.truth[at]), output.covariances[same]

    @property
    def unmapped(self) -> BoolArray:
        """Mask of detections whose marker never entered the map: false positives, or seen too seldom."""
        known = self.run.marker_map
        ids = self.run.detections.ids
        return np.zeros(len(ids), np.bool_) if known is None else ~np.isin(ids, list(known.markers))

    def numbers(self) -> dict[str, Any]:
        """All measures; unknown ones are left out."""
        result: dict[str, Any] = {
            'fused': metrics.output(self.run.fused) | self._silence(),
            'fiducial': {'poses': len(self.run.fiducial), 'path_length_m': metrics.path_length(self.run.fiducial)},
            'markers': self._markers(),
            'interruptions': [_interruption_numbers(entry) for entry in self.interruptions],
        }
        if self.run.latencies:
            result['latency'] = {kind: metrics.latency(ms) for kind, (_, ms) in self.run.latencies.items()}
        for name, e in (('fused', self.fused_errors), ('fiducial', self.fiducial_errors)):
            if e is not None and len(e):
                result[name]['error'] = metrics.accuracy(e)
                result[name]['jitter'] = metrics.jitter(e)
                result[name]['relative_error'] = metrics.relative_pose_error(e)
        if (frames := at_frames(self.run)) is not None:
            result['at_frames'] = frames
        if self.available is not None:
            result['as_available'] = self.available.numbers()
        if (maps := self._comparable_maps()) is not None:
            result['map'] = map_accuracy(*maps)
        if (known := self.covariances) is not None:
            result['fused']['consistency'] = _consistency(*known)
        if len(self.run.output.innovations.nis):
            result['innovations'] = metrics.innovation_consistency(self.run.output.innovations)
        return result

    def _silence(self) -> dict[str, float]:
        """Time without a pose and without an IMU message at the end of the run [ms].

        A filter that is lost gives no pose, nor does one without an IMU.
        """
        fused, (_, last) = self.run.fused.stamps_ns, run_span(self.run)
        imu = {'imu_silent_at_end_ms': imu_silence_ns(self.run) / 1e6}
        return {'silent_at_end_ms': (last - int(fused[-1])) / 1e6} | imu if len(fused) else {}

    def _comparable_maps(self) -> tuple[MarkerMap, MarkerMap] | None:
        """Map of the run and the true one; None without either, or without a common marker (no pose ever went out)."""
        estimate, truth = self.run.marker_map, self.run.true_map
        if estimate is None or truth is None or not estimate.markers.keys() & truth.markers.keys():
            return None
        return estimate, truth

    def _markers(self) -> dict[str, Any]:
        detections, marker_map = self.run.detections, self.run.marker_map
        frames, counts = np.unique(detections.stamps_ns, return_counts=True)
        return {
            'detections': len(detections.ids),
            'frames_with_markers': len(frames),
            'seen_in_a_frame': float(counts.mean()) if len(counts) else 0.0,
            'different': len(np.unique(detections.ids)),
            'corner_sigma_median_px': float(np.median(detections.sigma_px)) if len(detections.ids) else None,
            'in_map': None if marker_map is None else len(marker_map.markers),
            'detections_not_in_map': int(np.sum(self.unmapped)),
        }


def evaluate(run: Run) -> Evaluation:
    """Measure a run."""
    fused_errors = None if run.truth is None else metrics.errors(run.fused, run.truth)
    fiducial_errors = None if run.truth is None else metrics.errors(run.fiducial, run.truth)
    return Evaluation(run, fused_errors, fiducial_errors, interruptions(run, fused_errors))


def _interruption_numbers(entry: Interruption) -> dict[str, Any]:
    numbers = {
        'cause': entry.cause.value,
        'seconds': entry.seconds,
        'start_ns': entry.start_ns,
        'end_ns': entry.end_ns,
        'fused_poses': entry.fused_poses,
        'step_mm': entry.step_mm,
        'error_mm': entry.error_mm,
        'error_deg': entry.error_deg,
        'before_start': entry.before_start,
    }
    return {name: value for name, value in numbers.items() if value is not None}


def _consistency(e: metrics.Errors, covariances: FloatArray) -> dict[str, float]:
    wanted = np.arange(e.stamps_ns[0], e.stamps_ns[-1], CONSISTENCY_NS) if len(e) else np.zeros(0, np.int64)
    picked = np.unique(np.searchsorted(e.stamps_ns, wanted))
    chosen = metrics.Errors(e.stamps_ns[picked], e.d[picked], e.estimate[picked], e.truth[picked])
    return metrics.consistency(chosen, covariances[picked])
