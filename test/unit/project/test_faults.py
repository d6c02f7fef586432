"""What ``make faults`` measures: a short flight with a fault, and how outputs are judged."""

from dataclasses import replace
from types import SimpleNamespace

from faults import camera_faults, imu_faults
from faults.flight import during, event, FIRST, Recorded, Stream
from faults.kinds import FAULTS
from faults.run import Flown, fly, Output
from faults.score import pooled, score
from faults.table import table
import numpy as np
import pytest

BEGIN, END, LAST = FIRST + 1.0, FIRST + 1.3, FIRST + 2.0
#: Samples of the IMU [s].
STEP = 0.005


@pytest.mark.ros
@pytest.mark.usefixtures('log_level_restored')
def test_a_frozen_imu_is_declared_and_no_wrong_pose_goes_out():
    flight = Recorded(0, last=LAST)
    last = next(item for item in reversed(flight.imu) if item.sampled < BEGIN)
    imu = during(flight.imu, lambda item: replace(item, value=last.value), BEGIN, END)
    result = score(fly(flight, Stream.of(imu, flight.frames)), END, BEGIN, LAST)
    # Found within 50 ms, and silent until the sensor has gone on for as long as poses need to agree with it.
    assert result.declared <= 0.05
    assert 0.0 < result.recovered < 0.5
    assert result.worst < 0.1
    assert not result.is_defect
    assert result.sent > 0


# --- the judgement ------------------------------------------------------------------------------------


def output(distances, silent=()):
    """Poses [m] aside at the IMU's rate, from ``BEGIN``, but for the samples ``silent``; one sigma is 1 cm."""
    times = BEGIN + STEP * np.arange(len(distances))
    kept = np.setdiff1d(np.arange(len(distances)), silent)
    errors = [np.array([distances[k], 0.0, 0.0, 0.0, 0.0, 0.0]) for k in kept]
    return Output(times[kept].tolist(), errors, [float(1e4 * error @ error) for error in errors])


def judged(distances, silent=()):
    return score(Flown(pose=output(distances, silent)), BEGIN, BEGIN, BEGIN + STEP * len(distances))


def test_good_poses_have_nothing_to_declare():
    result = judged(np.full(200, 0.02))
    assert (result.off_for, result.beyond_for, result.is_defect) == (0.0, 0.0, False)
    assert np.isnan(result.declared)
    assert np.isnan(result.recovered)


@pytest.mark.parametrize('distance', [0.15, 0.05])
def test_poses_that_are_off_or_claim_too_little_for_long_are_a_defect(distance):
    wrong = np.where((np.arange(200) >= 50) & (np.arange(200) < 120), distance, 0.0)
    result = judged(wrong)
    # Seventy samples, from the first to the last.
    assert max(result.off_for, result.beyond_for) == pytest.approx(69 * STEP)
    assert (result.off_for > 0.0) == (distance > 0.1)
    assert result.is_defect


def test_a_silence_in_between_is_a_declaration():
    wrong = np.where((np.arange(200) >= 50) & (np.arange(200) < 120), 0.15, 0.0)
    result = judged(wrong, range(80, 90))
    assert result.off_for == pytest.approx(29 * STEP)
    assert not result.is_defect
    assert result.declared == pytest.approx(79 * STEP)
    assert result.recovered == pytest.approx(119 * STEP)


def test_what_never_comes_back_never_recovers():
    assert judged(np.full(200, 0.0), range(100, 200)).recovered == np.inf
    assert judged(np.where(np.arange(200) > 150, 1.0, 0.0)).recovered == np.inf


def test_of_several_flights_the_worst_counts():
    good, bad = judged(np.full(200, 0.02)), judged(np.full(200, 0.2))
    both = pooled([good, bad])
    assert both.is_defect
    assert both.worst == pytest.approx(0.2)
    assert both.beyond == pytest.approx(0.5)
    rows = table([(FAULTS[0], good), (FAULTS[1], bad)], 8).splitlines()
    assert ['**' in row for row in rows[2:]] == [False, True]


def test_every_fault_has_a_name_of_its_own():
    assert len({(fault.group, fault.name) for fault in FAULTS}) == len(FAULTS)


def test_faults_change_what_arrives():
    events = [event(8.0 + 0.01 * k, np.zeros(6)) for k in range(20)]
    flight = SimpleNamespace(imu=events[:10], frames=events[10:])
    plain = Stream.of(flight.imu, flight.frames)
    for change in (imu_faults.stopped, imu_faults.doubled, camera_faults.clock_step(0.2), camera_faults.reordered):
        assert change(flight).events != plain.events
