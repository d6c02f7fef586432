"""Times without a pose from the markers, and their cause: shutter, no image, no marker in view."""

from dataclasses import dataclass
from enum import Enum

import numpy as np

from thermal_fiducial.core.imaging.frame_cleaner import SHUTTER
from thermal_fiducial.core.types import BoolArray, IntArray, SECOND_NS
from thermal_fiducial.files.bags import IMU_TOPIC
from thermal_fiducial.report.metrics import Errors, FRAME_NS, steps
from thermal_fiducial.report.run_folder import Run

#: Gap between poses from markers above which it is an interruption [ns].
GAP_NS = 300_000_000
#: Camera periods without a frame above which frames are missing, not just late: the shutter drops several.
_HOLE_PERIODS = 2.5
#: Longest time without a frame that a shutter event explains [ns]. A Tau 2 needs some 0.5 s for 8 frames behind the
#: shutter, 0.8 s for 16; and what is withheld is counted once a second.
_LONGEST_SHUTTER_NS = 2_000_000_000
#: Largest difference of a stamp and its recording on one clock [ns].
ONE_CLOCK_NS = 500_000_000


class Cause(Enum):
    """Cause of an interruption."""

    SHUTTER = 'shutter (FFC)'
    WITHHELD = 'frames withheld'
    NO_IMAGE = 'no image'
    NO_MARKERS = 'no marker in view'
    UNUSED = 'markers in view, no pose'


@dataclass(frozen=True)
class Interruption:
    """A time without a pose from the markers."""

    start_ns: int
    end_ns: int
    cause: Cause
    #: number of fused poses during it
    fused_poses: int
    #: step of the fused position at its end, when markers are seen again [mm]; None without either
    step_mm: float | None
    #: errors at its end [mm, deg]; None without truth
    error_mm: float | None = None
    error_deg: float | None = None
    #: whether the filter had not started when it began: nothing was coasted
    before_start: bool = False

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return (self.end_ns - self.start_ns) / SECOND_NS

    @property
    def is_shutter(self) -> bool:
        """Whether it is a flat-field correction of the camera, which is normal operation."""
        return self.cause is Cause.SHUTTER

    @property
    def is_drop_out(self) -> bool:
        """Whether it is neither normal operation nor the time before the filter had started."""
        return not (self.is_shutter or self.before_start)


def interruptions(run: Run, fused_errors: Errors | None) -> list[Interruption]:
    """Gaps of the poses from markers above :data:`GAP_NS`, and shorter ones caused by the shutter.

    The time before the first pose and that after the last one count too.
    """
    first, last = run_span(run)
    stamps = np.concatenate([[first], run.fiducial.stamps_ns, [last]])
    ends = np.flatnonzero(np.diff(stamps) > GAP_NS)
    spans = [(int(stamps[i]), int(stamps[i + 1])) for i in ends]
    spans += [hole for hole in _shutter_holes(run) if not any(a < hole[1] and hole[0] < b for a, b in spans)]
    return [_described(run, start, end, fused_errors) for start, end in sorted(spans)]


def run_span(run: Run) -> tuple[int, int]:
    """First and last stamp of a run: of its data, and of the bag if that was recorded by the clock of the stamps."""
    known = [stamps for stamps in (run.fused.stamps_ns, run.fiducial.stamps_ns, run.output.frames_ns) if len(stamps)]
    if not known:
        return 0, 0
    first, last = min(int(stamps[0]) for stamps in known), max(int(stamps[-1]) for stamps in known)
    if 'start_ns' not in run.summary or 'duration_s' not in run.summary:
        return first, last
    start = int(run.summary['start_ns'])
    end = start + round(run.summary['duration_s'] * SECOND_NS)
    of_one_clock = start - ONE_CLOCK_NS < first and last < end + ONE_CLOCK_NS
    return (min(start, first), max(end, last)) if of_one_clock else (first, last)


def imu_silence_ns(run: Run) -> int:
    """Time from the last IMU message to the end of the recording, by its clock; 0 if unknown."""
    last = run.summary.get('last_ns', {}).get(IMU_TOPIC)
    if last is None or 'start_ns' not in run.summary or 'duration_s' not in run.summary:
        return 0
    end: int = run.summary['start_ns'] + round(run.summary['duration_s'] * SECOND_NS)
    return max(0, end - int(last))


def frame_holes(frames_ns: IntArray) -> list[tuple[int, int]]:
    """Stamps of the frames before and after each gap of the camera."""
    if len(frames_ns) < 3:
        return []
    between = np.diff(frames_ns)
    at = np.flatnonzero(between > _HOLE_PERIODS * np.median(between))
    return [(int(frames_ns[i]), int(frames_ns[i + 1])) for i in at]


def _shutter_holes(run: Run) -> list[tuple[int, int]]:
    return [hole for hole in frame_holes(run.output.frames_ns) if _names_shutter(run, *hole)]


def _names_shutter(run: Run, start_ns: int, end_ns: int) -> bool:
    if end_ns - start_ns > _LONGEST_SHUTTER_NS:
        return False
    return any(SHUTTER in reason for reason in run.output.withheld_between(start_ns, end_ns))


def _are_withheld(run: Run, start_ns: int, end_ns: int) -> bool:
    """Whether frames that came and were withheld account for a hole, rather than those of a shutter event before it."""
    count = sum(run.output.withheld_between(start_ns, end_ns).values())
    if end_ns - start_ns <= _LONGEST_SHUTTER_NS:
        return count > 0
    period = float(np.median(np.diff(run.output.frames_ns))) if len(run.output.frames_ns) > 1 else FRAME_NS
    return count * period > (end_ns - start_ns) / 2


def _cause(run: Run, start_ns: int, end_ns: int) -> Cause:
    frames = run.output.frames_ns
    if len(frames):
        inside = frames[(frames > start_ns) & (frames < end_ns)]
        edges = np.concatenate([[start_ns], inside, [end_ns]])
        longest = int(np.argmax(np.diff(edges)))
        hole = int(edges[longest]), int(edges[longest + 1])
        if hole[1] - hole[0] > (end_ns - start_ns) / 2:
            if _names_shutter(run, *hole):
                return Cause.SHUTTER
            return Cause.WITHHELD if _are_withheld(run, *hole) else Cause.NO_IMAGE
    stamps = run.detections.stamps_ns + run.offset_ns
    return Cause.UNUSED if np.any(_strictly_between(stamps, start_ns, end_ns)) else Cause.NO_MARKERS


def _strictly_between(stamps_ns: IntArray, start_ns: int, end_ns: int) -> BoolArray:
    return np.asarray((stamps_ns > start_ns) & (stamps_ns < end_ns))


def _described(run: Run, start_ns: int, end_ns: int, e: Errors | None) -> Interruption:
    fused = run.fused
    inside = (fused.stamps_ns > start_ns) & (fused.stamps_ns <= end_ns)
    error_mm = error_deg = None
    if e is not None and np.any(at := (e.stamps_ns > start_ns) & (e.stamps_ns <= end_ns)):
        error_mm, error_deg = 1e3 * float(e.position_m[at][-1]), float(e.attitude_deg[at][-1])
    return Interruption(
        start_ns=start_ns,
        end_ns=end_ns,
        cause=_cause(run, start_ns, end_ns),
        fused_poses=int(inside.sum()),
        before_start=not np.any(fused.stamps_ns <= start_ns),
        step_mm=_step_mm(run, inside, end_ns),
        error_mm=error_mm,
        error_deg=error_deg,
    )


def _step_mm(run: Run, inside: BoolArray, end_ns: int) -> float | None:
    fused = run.fused
    if not inside.any() or not np.any(run.fiducial.stamps_ns >= end_ns):
        return None
    # The frame that ends the interruption corrects the filter after its processing, tens of milliseconds later.
    after = (fused.stamps_ns > end_ns) & (fused.stamps_ns <= end_ns + 3 * FRAME_NS)
    last = fused.stamps_ns == fused.stamps_ns[inside][-1]
    return 1e3 * float(steps(fused.take(after | last)).max(initial=0.0))
