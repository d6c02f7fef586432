"""The verdict on a run: weighted remarks and a headline."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from thermal_fiducial.core.filter.output import TRACKING
from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.core.wording import number_of
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.marker_table import QUARANTINED
from thermal_fiducial.report.metrics import PAUSE_NS
from thermal_fiducial.report.output_bag import Diagnostic, WARNING

#: NEES per degree of freedom up to which covariances are consistent, and above which they are far too small.
CONSISTENT_NEES, INCONSISTENT_NEES = 2.0, 4.0
#: NEES per degree of freedom below which covariances are far too large.
CAUTIOUS_NEES = 0.2
#: Shares of refused poses that are worth a look, and that indicate a fault.
FEW_REFUSED, MANY_REFUSED = 0.01, 0.1
#: Gaps of the poses [ms] above which a controller is disturbed, and above which a drone drifts away.
SHORT_PAUSE_MS, LONG_PAUSE_MS = 1e-6 * PAUSE_NS, 500.0
#: Duration of coasting that is worth a look [s].
LONG_COAST_S = 2.0
#: Step of the pose that causes a jerk of a position controller [mm].
LARGE_STEP_MM = 50.0
#: Diagnostics, one a second, from which on a warning lasts: what one frame, a start or an end causes is over before.
LASTING_WARNING = 3
#: Latency above which a pose is of little use to an autopilot [ms].
LATE_MS = 20.0


class Weight(IntEnum):
    """Weight of a remark."""

    GOOD = 0
    NOTE = 1
    DOUBT = 2
    FAULT = 3


HEADLINES = {
    Weight.GOOD: 'The pose of this run can be flown on.',
    Weight.NOTE: 'The pose of this run can be flown on.',
    Weight.DOUBT: 'The pose of this run can be flown on, with reservations.',
    Weight.FAULT: 'The pose of this run must not be flown on.',
}


@dataclass(frozen=True)
class Remark:
    """One sentence of the verdict."""

    weight: Weight
    text: str


@dataclass(frozen=True)
class RunVerdict:
    """All remarks, the weightiest first."""

    remarks: tuple[Remark, ...]

    @property
    def weight(self) -> Weight:
        """Largest weight of the remarks."""
        return max((remark.weight for remark in self.remarks), default=Weight.GOOD)

    @property
    def headline(self) -> str:
        """The verdict in a sentence."""
        return HEADLINES[self.weight]


def judge(evaluation: Evaluation, numbers: dict[str, Any]) -> RunVerdict:
    """The verdict on a run; ``numbers`` are :meth:`Evaluation.numbers`."""
    made = [
        _output(evaluation, numbers),
        _start(evaluation),
        _error(evaluation, numbers),
        _truth(evaluation),
        _consistency(numbers),
        _refused(numbers),
        _steps(numbers),
        *_interruptions(evaluation),
        _latency(numbers),
        _resets(evaluation),
        _markers(evaluation),
        _warnings(evaluation),
    ]
    remarks = sorted((remark for remark in made if remark), key=lambda remark: -remark.weight)
    return RunVerdict(tuple(remarks))


def _output(evaluation: Evaluation, numbers: dict[str, Any]) -> Remark:
    fused = numbers['fused']
    # Two have no rate.
    if (poses := fused['poses']) < 3:
        return Remark(Weight.FAULT, f'The filter gave {number_of(poses, "pose") if poses else "no pose"}.')
    silence = fused.get('silent_at_end_ms', 0.0)
    pause, rate = fused['longest_pause_ms'], f'{fused["rate_hz"]:.0f} poses a second'
    imu_silence = fused.get('imu_silent_at_end_ms', 0.0)
    # The filter may have been lost before.
    if imu_silence > max(pause, LONG_PAUSE_MS, silence - LONG_PAUSE_MS):
        since = evaluation.run.summary['duration_s'] - imu_silence / 1e3
        cause = f'the IMU was silent from {since:.1f} s on (its driver died, or was stopped before the recording)'
        return Remark(Weight.FAULT, f'{rate}, but none in the last {imu_silence / 1e3:.1f} s: {cause}.')
    if silence > max(pause, LONG_PAUSE_MS):
        return Remark(Weight.FAULT, f'{rate}, but none in the last {silence / 1e3:.1f} s.')
    if pause > LONG_PAUSE_MS:
        return Remark(Weight.FAULT, f'{rate}, but none for {pause:.0f} ms at the longest.')
    if pause > SHORT_PAUSE_MS:
        return Remark(Weight.DOUBT, f'{rate}, with a pause of {pause:.0f} ms.')
    return Remark(Weight.GOOD, f'{rate}, without a pause.')


def _start(evaluation: Evaluation) -> Remark | None:
    fused, markers = evaluation.run.fused.stamps_ns, evaluation.run.fiducial.stamps_ns
    if not (len(fused) and len(markers)) or (waited_ms := 1e-6 * int(fused[0] - markers[0])) <= LONG_PAUSE_MS:
        return None
    return Remark(Weight.NOTE, f'The first pose came {1e-3 * waited_ms:.1f} s after the first one from the markers.')


def _error(evaluation: Evaluation, numbers: dict[str, Any]) -> Remark | None:
    error = numbers['fused'].get('error')
    if evaluation.run.truth is None:
        return Remark(Weight.NOTE, 'No ground truth: how large the errors are is not known.')
    if error is None:
        return None
    share = f'{100 * len(evaluation.fused_errors or ()) / len(evaluation.run.fused):.0f} %'
    of = '' if share == '100 %' else f' of the {share} of the poses that have one'
    # Nothing speaks for errors that the covariance does not claim.
    return Remark(
        Weight.GOOD if _nees(numbers, 0.0) <= CONSISTENT_NEES else Weight.NOTE,
        f'Errors against ground truth{of}: {error["position_rms_mm"]:.1f} mm and {error["attitude_rms_deg"]:.2f} deg '
        f'rms, {error["position_max_mm"]:.0f} mm at the worst, each pose at its own stamp.',
    )


def _truth(evaluation: Evaluation) -> Remark | None:
    return Remark(Weight.DOUBT, evaluation.doubt_of_truth) if evaluation.doubt_of_truth else None


def _consistency(numbers: dict[str, Any]) -> Remark | None:
    nees = _nees(numbers)
    if nees is None:
        return None
    words = f'NEES {nees:.2g} a degree of freedom'
    if nees > INCONSISTENT_NEES:
        return Remark(Weight.FAULT, f'The covariance claims far less error than there is ({words}).')
    if nees > CONSISTENT_NEES:
        return Remark(Weight.DOUBT, f'The covariance claims less error than there is ({words}).')
    if nees < CAUTIOUS_NEES:
        return Remark(Weight.NOTE, f'The covariance claims more error than there is ({words}).')
    return Remark(Weight.GOOD, f'The covariance is consistent with the errors ({words}).')


def _nees(numbers: dict[str, Any], unknown: float | None = None) -> Any:
    return numbers['fused'].get('consistency', {}).get('pose_nees_per_dof', unknown)


def _refused(numbers: dict[str, Any]) -> Remark | None:
    values = numbers.get('innovations')
    if not values or not values['poses']:
        return None
    share = values['refused'] / values['poses']
    weight = Weight.FAULT if share > MANY_REFUSED else Weight.DOUBT if share > FEW_REFUSED else Weight.GOOD
    return Remark(weight, f'{values["refused"]} of {values["poses"]} camera poses were refused by the filter.')


def _steps(numbers: dict[str, Any]) -> Remark | None:
    step = numbers['fused'].get('step_max_mm')
    if step is None or step <= LARGE_STEP_MM:
        return None
    return Remark(Weight.DOUBT, f'The pose jumps by up to {step:.0f} mm at corrections.')


def _interruptions(evaluation: Evaluation) -> list[Remark]:
    shutter = [entry for entry in evaluation.interruptions if entry.is_shutter]
    others = [entry for entry in evaluation.interruptions if entry.is_drop_out]
    late = [entry for entry in evaluation.interruptions if entry.before_start]
    remarks = []
    if shutter:
        longest = max(entry.seconds for entry in shutter)
        remarks.append(Remark(Weight.GOOD, f'{number_of(len(shutter), "shutter event")}, the longest {longest:.1f} s.'))
    if late:
        when = f'in the first {late[0].seconds:.1f} s' if len(evaluation.run.fiducial) else 'in the whole run'
        remarks.append(Remark(Weight.NOTE, f'No pose from the markers {when} ({late[0].cause.value}).'))
    if others:
        longest = max(entry.seconds for entry in others)
        weight = Weight.DOUBT if longest > LONG_COAST_S else Weight.NOTE
        causes = ', '.join(sorted({entry.cause.value for entry in others}))
        remarks.append(Remark(weight, f'{number_of(len(others), "drop-out")} of up to {longest:.1f} s ({causes}).'))
    elif len(evaluation.run.fiducial):
        remarks.append(Remark(Weight.GOOD, 'No drop-out of the markers.'))
    return remarks


def _latency(numbers: dict[str, Any]) -> Remark | None:
    p99 = numbers.get('latency', {}).get('imu_to_pose', {}).get('p99_ms')
    if p99 is None:
        return None
    return Remark(Weight.DOUBT if p99 > LATE_MS else Weight.GOOD, f'99 % of the poses came within {p99:.1f} ms.')


def _resets(evaluation: Evaluation) -> Remark | None:
    values = evaluation.run.output.figures.get('resets')
    resets = 0 if values is None else int(values[1].max())
    return Remark(Weight.DOUBT, f'The filter was reset {number_of(resets, "time")}.') if resets else None


def _markers(evaluation: Evaluation) -> Remark | None:
    quarantined = [str(tag.id) for tag in evaluation.tags if tag.status == QUARANTINED]
    if not quarantined:
        return None
    one = len(quarantined) == 1
    named = f'{"Marker" if one else "Markers"} {", ".join(quarantined)}'
    return Remark(Weight.DOUBT, f'{named} {"contradicts" if one else "contradict"} the map.')


def _warnings(evaluation: Evaluation) -> Remark | None:
    """What the nodes warned of for seconds: a wrong lens or map shows there, and in no figure without ground truth."""
    lasting = [
        (said, seconds)
        for said in evaluation.run.output.diagnostics
        if _is_doubt(said) and (seconds := _seconds_with_poses(said, evaluation)) >= LASTING_WARNING
    ]
    if not lasting:
        return None
    (first, seconds), *others = lasting
    more = f' and {number_of(len(others), "more warning")}' if others else ''
    return Remark(Weight.DOUBT, f'For {seconds} s {first.node} warned: "{first.latest}"{more}.')


def _is_doubt(said: Diagnostic) -> bool:
    """Whether it is a warning, and of nothing that the filter says of missing or refused poses: they have remarks."""
    doubt = f'{TRACKING}; '
    own = said.message.startswith(doubt) and not said.message.startswith(f'{doubt}pose ')
    return said.level == WARNING and (own or said.node.rpartition('/')[2] != 'pose_ekf')


def _seconds_with_poses(said: Diagnostic, evaluation: Evaluation) -> int:
    """How often it was said, once a second, while there were poses from markers: other times have remarks."""
    spans = [(entry.start_ns, entry.end_ns + SECOND_NS) for entry in evaluation.interruptions]
    return sum(not any(start <= time <= end for start, end in spans) for time in said.times_ns)
