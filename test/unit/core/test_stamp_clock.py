"""Stamps with milliseconds or microseconds in their nanoseconds are refused as no clock; those of clocks never are."""

import numpy as np
import pytest

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.filter.imu_input import ImuInput, Verdict
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner
from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.stamp_clock import NO_CLOCK, StampClock
from thermal_fiducial.core.types import SECOND_NS

START_S = 1_700_000_000


def stamps(rate_hz, seconds, unit_ns=1):
    """Stamps [ns] of a clock, of which each second's rest is counted in units of ``unit_ns`` [ns]."""
    nanoseconds = [k * SECOND_NS // rate_hz for k in range(round(rate_hz * seconds))]
    return [(START_S + ns // SECOND_NS) * SECOND_NS + ns % SECOND_NS // unit_ns for ns in nanoseconds]


def standing(stamps_ns):
    """Number of stamps that are refused."""
    clock = StampClock()
    return sum(clock.shows_none(stamp_ns) for stamp_ns in stamps_ns)


@pytest.mark.parametrize('unit_ns', [1_000, 1_000_000])
@pytest.mark.parametrize('rate_hz', [9, 30, 200, 1000])
def test_stamps_that_stay_at_the_full_second_are_no_clock(rate_hz, unit_ns):
    """The 20th shows it: of a camera with 9 Hz after 2.2 s."""
    sent = stamps(rate_hz, 4, unit_ns)
    assert standing(sent) == len(sent) - 19


@pytest.mark.parametrize('rate_hz', [1, 2, 9, 30, 200, 8000])
def test_clocks_are_clocks_also_where_they_trigger_a_camera_each_second(rate_hz):
    assert standing(stamps(rate_hz, 60 if rate_hz < 100 else 3)) == 0


def test_samples_in_bursts_with_the_stamps_of_their_arrival_are_taken():
    """Sixteen within 0.8 ms, ten times a second, at the full second too."""
    bursts = [START_S * SECOND_NS + k * SECOND_NS // 10 + n * 50_000 for k in range(100) for n in range(16)]
    assert standing(bursts) == 0


def test_a_stamp_that_nobody_sets_is_repeated_and_no_clock():
    assert standing([0] * 100 + [START_S * SECOND_NS] * 100) == 0


@pytest.mark.parametrize(('unit_ns', 'refused'), [(1_000, 181), (1, 0)])
def test_the_filter_takes_no_imu_without_a_clock(unit_ns, refused):
    """Its poses were up to 0.5 m off, within their claim."""
    imu, rng = ImuInput(1.0, 35.0, 160.0), np.random.default_rng(0)
    samples = [ImuSample(ns, rng.normal(size=3), rng.normal(size=3)) for ns in stamps(200, 1, unit_ns)]
    assert [imu.judge(sample) for sample in samples].count(Verdict.NO_CLOCK) == refused


@pytest.mark.parametrize(('unit_ns', 'refused'), [(1_000, 41), (1, 0)])
def test_the_front_end_takes_no_frames_without_a_clock(unit_ns, refused):
    cleaner, rng = FrameCleaner(Tau2CameraConfig()), np.random.default_rng(0)
    frames = [cleaner.process(ns, rng.integers(0, 8000, (64, 80), np.uint16)) for ns in stamps(30, 2, unit_ns)]
    assert [frame.reason for frame in frames].count(NO_CLOCK) == refused
