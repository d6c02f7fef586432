"""Times without a pose from the markers."""

import numpy as np
import pytest
from support.run_folders import run_of, SECONDS, START_NS, trajectory

from thermal_fiducial.report import interruptions as breaks
from thermal_fiducial.report.evaluation import evaluate
from thermal_fiducial.report.metrics import errors
from thermal_fiducial.report.output_bag import RecordedOutput
from thermal_fiducial.report.run_folder import Detections
from thermal_fiducial.report.trajectory import Trajectory
from thermal_fiducial.report.verdict import judge, Weight


def test_an_interruption_with_its_error_and_the_step_at_its_end(tmp_path):
    fused, fiducial = trajectory(200.0), trajectory(30.0)
    seconds = (fiducial.stamps_ns - START_NS) * 1e-9
    fiducial = fiducial.take((seconds < 8.0) | (seconds > 10.0))
    t = (fused.stamps_ns - START_NS) * 1e-9
    wandering = fused.T_map_body.copy()
    wandering[:, 1, 3] += np.where((t > 8.0) & (t < 10.0334), 0.02 * (t - 8.0), 0.0)
    run = run_of(tmp_path, Trajectory(fused.stamps_ns, wandering), fiducial)
    (entry,) = breaks.interruptions(run, errors(run.fused, run.truth))
    assert entry.seconds == pytest.approx(2.03, abs=0.04)
    assert entry.fused_poses == pytest.approx(200 * entry.seconds, abs=1)
    # 2 cm/s for 2 s; the flight itself adds less than a millimetre of curvature in a sample.
    assert entry.error_mm == pytest.approx(40.3, abs=0.5)
    assert entry.step_mm == pytest.approx(40.6, abs=0.7)
    assert breaks.interruptions(run, None)[0].error_mm is None
    assert breaks.interruptions(run_of(tmp_path, fused, trajectory(30.0)), None) == []


def test_the_time_before_the_first_and_after_the_last_pose_counts(tmp_path):
    """A camera that dies in flight and never comes back is a drop-out, as is one that comes late."""
    fused, fiducial = trajectory(200.0), trajectory(30.0)
    t = (fiducial.stamps_ns - START_NS) * 1e-9
    seen = fiducial.take((t > 3.0) & (t < 7.0))
    flown = fused.take(fused.stamps_ns >= seen.stamps_ns[0])
    span = {'start_ns': START_NS, 'duration_s': SECONDS}
    run = run_of(tmp_path, flown, seen, summary=span)
    late, gone = breaks.interruptions(run, errors(run.fused, run.truth))
    # One period of the markers, 1/30 s, on each side.
    assert (late.seconds, gone.seconds) == pytest.approx((3.0, 5.0), abs=0.07)
    assert (late.before_start, late.step_mm, late.fused_poses) == (True, None, 0)
    assert (gone.before_start, gone.step_mm) == (False, None)
    assert gone.fused_poses == pytest.approx(200 * gone.seconds, abs=1)
    evaluation = evaluate(run)
    verdict = judge(evaluation, evaluation.numbers())
    texts = {remark.text: remark.weight for remark in verdict.remarks}
    assert texts['1 drop-out of up to 5.0 s (no marker in view).'] == Weight.DOUBT
    assert texts['No pose from the markers in the first 3.0 s (no marker in view).'] == Weight.NOTE


def test_a_filter_that_is_silent_at_the_end_must_not_be_flown_on(tmp_path):
    every = trajectory(200.0)
    fused = every.take(every.stamps_ns < START_NS + 8_000_000_000)
    run = run_of(tmp_path, fused, trajectory(30.0, 6.0), summary={'start_ns': START_NS, 'duration_s': SECONDS})
    evaluation = evaluate(run)
    numbers = evaluation.numbers()
    # One period of the poses, 5 ms.
    assert numbers['fused']['silent_at_end_ms'] == pytest.approx(4000.0, abs=6.0)
    verdict = judge(evaluation, numbers)
    assert verdict.weight is Weight.FAULT
    assert verdict.remarks[0].text == '200 poses a second, but none in the last 4.0 s.'


@pytest.mark.parametrize('clock_ns', [0, 5_000_000_000_000])
@pytest.mark.parametrize(
    ('imu_ends_s', 'cause'),
    # The last pose is that of 8 s.
    [
        (8.0, ': the IMU was silent from 8.0 s on (its driver died, or was stopped before the recording)'),
        (8.4, ': the IMU was silent from 8.4 s on (its driver died, or was stopped before the recording)'),
        (10.0, ''),
        (SECONDS, ''),
    ],
)
def test_an_imu_that_is_silent_at_the_end_is_named_and_no_lost_filter(tmp_path, clock_ns, imu_ends_s, cause):
    """Also where the bag was recorded by another clock than that of the stamps."""
    every = trajectory(200.0)
    start_ns = START_NS + clock_ns
    summary = {'start_ns': start_ns, 'duration_s': SECONDS, 'last_ns': {'imu/data': start_ns + round(1e9 * imu_ends_s)}}
    run = run_of(tmp_path, every.take(every.stamps_ns < START_NS + 8_000_000_000), trajectory(30.0), summary=summary)
    evaluation = evaluate(run)
    verdict = judge(evaluation, evaluation.numbers())
    assert verdict.weight is Weight.FAULT
    seconds = SECONDS - (imu_ends_s if cause else 8.0)
    assert verdict.remarks[0].text == f'200 poses a second, but none in the last {seconds:.1f} s{cause}.'


def test_a_filter_that_waits_at_the_start_is_named(tmp_path):
    """An IMU that began 8 s after the camera: "200 poses a second, without a pause", and nothing else."""
    every = trajectory(200.0)
    late = every.take(every.stamps_ns >= START_NS + 8_000_000_000)
    evaluation = evaluate(run_of(tmp_path, late, trajectory(30.0)))
    said = [remark.text for remark in judge(evaluation, evaluation.numbers()).remarks]
    assert 'The first pose came 8.0 s after the first one from the markers.' in said


def test_an_imu_that_ends_with_the_recording_is_no_fault(tmp_path):
    summary = {'start_ns': START_NS, 'duration_s': SECONDS, 'last_ns': {'imu/data': START_NS + 11_600_000_000}}
    evaluation = evaluate(run_of(tmp_path, trajectory(200.0), trajectory(30.0), summary=summary))
    numbers = evaluation.numbers()
    assert numbers['fused']['imu_silent_at_end_ms'] == pytest.approx(400.0)
    assert judge(evaluation, numbers).weight is Weight.GOOD


def test_a_bag_of_another_clock_says_nothing_of_the_end(tmp_path):
    run = run_of(tmp_path, trajectory(200.0), trajectory(30.0), summary={'start_ns': 5, 'duration_s': 2 * SECONDS})
    assert breaks.interruptions(run, None) == []


CASES = {
    'shutter (FFC)': ({'settling after FFC': 3, 'frozen': 9}, False, False),
    'frames withheld': ({'frozen': 9}, False, False),
    'no image': ({}, False, False),
    'no marker in view': ({}, True, False),
    'markers in view, no pose': ({}, True, True),
}


@pytest.mark.parametrize('cause', CASES)
def test_why_there_was_no_pose(tmp_path, cause):
    withheld, frames_come, seen = CASES[cause]
    every = trajectory(30.0)
    t = (every.stamps_ns - START_NS) * 1e-9
    inside = (t > 5.0) & (t < 5.5)
    output = RecordedOutput(
        frames_ns=every.stamps_ns if frames_come else every.stamps_ns[~inside],
        withheld=((START_NS + 5_000_000_000, {}), (START_NS + 6_000_000_000, withheld)),
    )
    stamps = every.stamps_ns[inside if seen else ~inside]
    detections = Detections(
        stamps, np.zeros(len(stamps), np.int64), np.zeros((len(stamps), 4, 2)), np.ones(len(stamps))
    )
    run = run_of(tmp_path, trajectory(200.0), every.take(~inside), output=output, detections=detections)
    (entry,) = breaks.interruptions(run, None)
    assert entry.cause.value == cause
    assert entry.is_shutter == (cause == 'shutter (FFC)')


@pytest.mark.parametrize(
    ('withheld', 'cause'),
    # A shutter event drops some 15 frames, a camera that stands still all of them: 30 a second for 5 s.
    [
        ({'settling after FFC': 3, 'frozen': 12}, 'no image'),
        ({'settling after FFC': 3, 'frozen': 150}, 'frames withheld'),
    ],
)
@pytest.mark.parametrize('back_s', [10.0, SECONDS])
def test_a_camera_that_is_gone_for_seconds_after_a_shutter_event_is_not_in_its_shutter(
    tmp_path, withheld, cause, back_s
):
    """What is withheld is counted once a second: an event just before the hole is in its count."""
    every = trajectory(30.0)
    t = (every.stamps_ns - START_NS) * 1e-9
    left = every.take((t < 5.0) | (t > back_s))
    samples = ((4.0, {}), (6.0, withheld), (10.5, withheld))
    output = RecordedOutput(
        frames_ns=left.stamps_ns, withheld=tuple((START_NS + round(1e9 * at), counts) for at, counts in samples)
    )
    (entry,) = breaks.interruptions(run_of(tmp_path, trajectory(200.0), left, output=output), None)
    assert entry.cause.value == cause
    assert not entry.is_shutter
