"""What may enter the filter from the IMU: an axis that repeats itself is a fault, where it has not always done so."""

import numpy as np
import pytest

from thermal_fiducial.core.filter.imu_input import ImuInput, Verdict
from thermal_fiducial.core.measurements import ImuSample

STEP_NS = 5_000_000


@pytest.fixture
def imu():
    return ImuInput(max_gap=0.5, gyroscope_range=10.0, accelerometer_range=100.0)


def verdicts(imu, readings, begin=0):
    """On samples (N, 6) at 200 Hz."""
    samples = (ImuSample((begin + k) * STEP_NS, row[:3], row[3:]) for k, row in enumerate(readings))
    return [imu.judge(sample) for sample in samples]


@pytest.fixture
def noise():
    """Samples of white noise, the same whichever tests have run before."""
    rng = np.random.default_rng(4)
    return lambda count: rng.normal(size=(count, 6))


@pytest.mark.parametrize('axis', range(6))
@pytest.mark.parametrize('value', [0.0, 0.3])
def test_a_dead_axis_is_found_within_50_ms(imu, noise, axis, value):
    dead = noise(100)
    dead[:, axis] = value
    assert set(verdicts(imu, noise(100))) == {Verdict.USE}
    found = verdicts(imu, dead, 100)
    # ten samples last 45 ms
    assert found == [Verdict.USE] * 9 + [Verdict.FROZEN] * 91
    # The end of a gap is believed with its third sample.
    assert verdicts(imu, noise(20), 200) == [Verdict.AHEAD] * 2 + [Verdict.USE] * 18


def test_a_gap_behind_a_sample_that_was_overtaken_is_a_gap(imu, noise):
    """The overtaken one is no part of what comes after the gap: together they were a clock that was set back."""
    readings = noise(40)
    assert verdicts(imu, readings[:18]) == [Verdict.USE] * 18
    assert verdicts(imu, readings[19:20], 19) == [Verdict.USE]
    assert verdicts(imu, readings[18:19], 18) == [Verdict.BACKWARD]
    assert verdicts(imu, readings[20:], 80) == [Verdict.AHEAD] * 2 + [Verdict.USE] * 18


def test_coarse_steps_repeat_themselves(imu, noise):
    """Steps of one and a half times the noise: the same value for up to 70 ms."""
    coarse = np.round(noise(4000) / 1.5)
    longest = max(len(run) for run in ''.join('0' if value == 0.0 else ' ' for value in coarse[:, 0]).split())
    assert longest > 10
    assert verdicts(imu, coarse).count(Verdict.FROZEN) == 0


def test_full_scale_is_not_frozen(imu, noise):
    """What is cut off there is noise in the filter."""
    cut = noise(60)
    cut[:, 2] = -10.0
    assert set(verdicts(imu, cut)) == {Verdict.USE}


def test_an_accelerometer_stays_at_full_scale_for_a_tenth_of_a_second_at_most(imu, noise):
    cut = noise(60)
    cut[:, 4] = -100.0
    # twenty steps
    assert verdicts(imu, cut, 200) == [Verdict.USE] * 20 + [Verdict.FROZEN] * 40
    assert verdicts(imu, noise(20), 260) == [Verdict.AHEAD] * 2 + [Verdict.USE] * 18


def test_two_bad_stamps_in_a_row_end_no_gap(imu, noise):
    """A pose at such a stamp is one of a time that has not come yet."""
    good, ahead = noise(100), noise(2)
    assert set(verdicts(imu, good)) == {Verdict.USE}
    assert verdicts(imu, ahead, 150) == [Verdict.AHEAD] * 2
    assert set(verdicts(imu, noise(20), 102)) == {Verdict.USE}


def test_an_axis_that_has_never_changed_is_at_rest(imu, noise):
    """A simulator without noise, before it takes off and once it hovers again."""
    still = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.80665], (400, 1))
    assert set(verdicts(imu, still)) == {Verdict.USE}
    # As a motion begins: more at once would be a jump.
    assert set(verdicts(imu, still[:50] + 0.03 * noise(50), 400)) == {Verdict.USE}
    assert set(verdicts(imu, still, 450)) == {Verdict.USE}


@pytest.mark.parametrize('axis', [2, 3])
@pytest.mark.parametrize('size', [-100.0, 30.0])
def test_one_sample_far_from_those_around_it_is_corrupt(imu, noise, axis, size):
    """One at full scale turned a hover by 10 deg, and reset the filter."""
    readings = 0.1 * noise(200)
    readings[150, axis] = size / 10.0 if axis == 2 else size
    found = verdicts(imu, readings)
    assert [k for k, verdict in enumerate(found) if verdict is not Verdict.USE] == [150]
    assert found[150] is Verdict.CORRUPT


def test_where_motion_begins_one_sample_is_lost(imu, noise):
    """The second one that is far from those before is believed; what is usual grows within some more."""
    readings = 0.1 * noise(400)
    readings[200:, 3] += 20.0
    assert [k for k, verdict in enumerate(verdicts(imu, readings)) if verdict is not Verdict.USE] == [200]
    shaken = verdicts(imu, 3.0 * noise(400), 400)
    # Every second one at first: with 30 of 400 as far as that, ten times the mean is 2.7 times the new one.
    assert shaken.count(Verdict.CORRUPT) < 15
    assert set(shaken[60:]) == {Verdict.USE}


def test_behind_a_gap_nothing_is_far(imu, noise):
    readings = 0.1 * noise(300)
    readings[200:, 3] += 20.0
    assert set(verdicts(imu, readings[:200])) == {Verdict.USE}
    # 100 ms; the end of a gap is believed with its third sample
    assert verdicts(imu, readings[200:], 220) == [Verdict.AHEAD] * 2 + [Verdict.USE] * 98


def test_a_sample_that_is_zero_has_not_been_read(imu, noise):
    readings = noise(50)
    readings[30] = 0.0
    found = verdicts(imu, readings)
    assert found[30] is Verdict.EMPTY
    assert set(found[:30] + found[31:]) == {Verdict.USE}


def excesses(imu, stamps_ms):
    """By how much [ms] each step of samples at these stamps is longer than usual."""
    rng, found = np.random.default_rng(4), []
    for stamp in stamps_ms:
        imu.judge(ImuSample(round(stamp * 1e6), rng.normal(size=3), rng.normal(size=3)))
        found.append(imu.excess_ns * 1e-6)
    return found


def test_a_step_longer_than_recent_ones_is_noticed(imu):
    found = excesses(imu, [*range(0, 500, 5), 510, 515])
    assert found[:100] == [0.0] * 100
    # the longest of recent steps decays with 2 s: nothing between samples 5 ms apart
    assert found[100:] == pytest.approx([10.0, 0.0], abs=0.05)


def test_where_steps_are_uneven_long_ones_are_usual(imu):
    assert max(excesses(imu, np.cumsum([5, 5, 5, 15] * 50))[4:]) == 0.0


def test_the_end_of_a_gap_is_measured_from_its_first_sample(imu):
    # Three samples prove that it is the end of a gap; the gap ends with the first of them.
    found = excesses(imu, [*range(0, 500, 5), 535, 540, 545, 550])
    assert found[-4:] == pytest.approx([0.0, 0.0, 35.0, 0.0], abs=0.05)


def test_a_long_gap_does_not_make_short_ones_usual(imu):
    """A step of the clock by 20 ms in the seconds behind it has to be noticed."""
    found = excesses(imu, [*range(0, 500, 5), *range(895, 1500, 5), 1520, 1525, 1545])
    # The gap itself is noticed with its third sample; the second step of 20 ms is as long as the first.
    assert max(found[100:103]) == pytest.approx(395.0, abs=0.05)
    assert found[-3:] == pytest.approx([20.0, 0.0, 0.0], abs=0.05)


def stamped(imu, noise, stamps_ns):
    """Verdicts on samples of noise with these stamps."""
    readings = noise(len(stamps_ns))
    return [imu.judge(ImuSample(ns, row[:3], row[3:])) for ns, row in zip(stamps_ns, readings, strict=True)]


@pytest.mark.parametrize('begin_ns', [0, 10**18])
@pytest.mark.parametrize('later_ms', [100, 400])
@pytest.mark.parametrize('first', ['swapped', 'gap'])
def test_a_gap_soon_after_another_stray_is_a_gap(imu, noise, first, later_ms, begin_ns):
    """Two swapped samples, or a gap of 40 ms, and then a gap of 150 ms: also in simulated time, which begins at 0."""
    before = [begin_ns + STEP_NS * k for k in range(100)]
    if first == 'swapped':
        before += [begin_ns + STEP_NS * k for k in (101, 100)]
        lost = [Verdict.USE, Verdict.BACKWARD]
    else:
        before += [before[-1] + 40_000_000 + STEP_NS * k for k in range(2)]
        lost = [Verdict.AHEAD] * 2
    between = [max(before) + STEP_NS * (k + 1) for k in range(later_ms // 5)]
    after = [between[-1] + 150_000_000 + STEP_NS * k for k in range(20)]
    found = stamped(imu, noise, before + between + after)
    assert found[:102] == [Verdict.USE] * 100 + lost
    assert set(found[102 : 102 + len(between)]) == {Verdict.USE}
    assert found[102 + len(between) :] == [Verdict.AHEAD] * 2 + [Verdict.USE] * 18


@pytest.mark.parametrize('jump_ns', [60_000_000, 3_600_000_000_000])
def test_samples_that_come_twice_end_a_gap_and_a_jump_of_the_clock(imu, noise, jump_ns):
    before = [STEP_NS * k for k in range(100)]
    after = [before[-1] + jump_ns + STEP_NS * k for k in range(20)]
    once = stamped(imu, noise, before + after)
    twice = stamped(ImuInput(0.5, 10.0, 100.0), noise, [ns for ns in before + after for _ in range(2)])
    assert twice[::2] == once
    assert set(twice[1::2]) == {Verdict.REPEATED}


def test_samples_in_swapped_pairs_end_a_gap(imu, noise):
    before = [STEP_NS * k for k in range(100)]
    pairs = [(k + 1, k) for k in range(0, 40, 2)]
    after = [before[-1] + 60_000_000 + STEP_NS * k for pair in pairs for k in pair]
    found = stamped(imu, noise, before + after)[100:]
    # The newer one of each pair is used once three samples continue from one another; the older ones are late, but for
    # the very first, with which the run begins anew.
    assert found[::2] == [Verdict.AHEAD] * 2 + [Verdict.USE] * 18
    assert found[1::2] == [Verdict.AHEAD] + [Verdict.BACKWARD] * 19


@pytest.mark.parametrize('shift_ns', [0, 2_000_000])
@pytest.mark.parametrize('steps', [4, 8])
def test_a_clock_that_is_set_back_by_a_few_samples_is_a_jump_once_it_has_caught_up(imu, noise, steps, shift_ns):
    """The robot has moved on meanwhile."""
    before = [STEP_NS * k for k in range(100)]
    after = [before[-1] + STEP_NS * (k - steps) + shift_ns for k in range(1, 20)]
    found = stamped(imu, noise, before + after)[100:]
    caught_up = next(place for place, ns in enumerate(after) if ns > before[-1])
    assert set(found[:caught_up]) <= {Verdict.BACKWARD, Verdict.REPEATED}
    assert found[caught_up:] == [Verdict.RESTART] + [Verdict.USE] * (18 - caught_up)


@pytest.mark.parametrize('ahead', [1, 2, 3])
def test_samples_that_were_overtaken_are_no_jump_of_the_clock(imu, noise, ahead):
    """Of six samples the last ones come first."""
    order = [*range(106 - ahead, 106), *range(100, 106 - ahead)]
    found = stamped(imu, noise, [STEP_NS * k for k in [*range(100), *order, *range(106, 120)]])[100:]
    assert found == [Verdict.USE] * ahead + [Verdict.BACKWARD] * (6 - ahead) + [Verdict.USE] * 14


def test_samples_that_come_once_more_are_no_jump_of_the_clock(imu, noise):
    readings = noise(100)
    verdicts(imu, readings)
    assert set(verdicts(imu, readings[-6:], 94)) == {Verdict.REPEATED}
    assert set(verdicts(imu, noise(20), 100)) == {Verdict.USE}
