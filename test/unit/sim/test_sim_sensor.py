from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.tiny import TINY

from thermal_fiducial.errors import InputError
from thermal_fiducial.sim.render import Quality
from thermal_fiducial.sim.sensor import FULL_SCALE, IDEAL, Sensor
from thermal_fiducial.sim.thermal_camera import render_frames

FLAT = np.zeros((128, 160), np.float32)
FFC = replace(TINY.sensor, ffc_first=1.0, ffc_period=5.0, ffc_duration=0.3)


def test_ideal_sensor_is_linear():
    ramp = np.tile(np.linspace(-5, 40, 160, dtype=np.float32), (128, 1))
    counts = IDEAL.counts(ramp, 3.0, 0, 0)
    # Half a count of rounding.
    np.testing.assert_allclose(counts, ramp * 30.0 + 3600.0, atol=0.501)
    assert counts.dtype == np.uint16


def test_saturates_at_14_bits():
    hot = IDEAL.counts(FLAT + 1000.0, 0.0, 0, 0)
    cold = IDEAL.counts(FLAT - 1000.0, 0.0, 0, 0)
    assert hot.min() == FULL_SCALE == 16383
    assert cold.max() == 0


def test_temporal_noise_is_the_netd():
    sensor = replace(IDEAL, netd=0.08)
    frames = np.array([sensor.counts(FLAT, 1.0, n, 0).astype(float) for n in range(20)])
    # 20 x 20480 samples: 0.1 % of statistics; rounding to counts adds a variance of 1/12 to 2.4^2.
    assert frames.std(axis=0, ddof=1).mean() / 30.0 == pytest.approx(0.08, rel=0.03)


def test_fixed_pattern_grows_until_the_shutter():
    sensor = replace(IDEAL, pixel_pattern=0.02, pixel_growth=0.3, ffc_first=60.0, ffc_period=60.0)
    fresh, grown, after = (sensor.counts(FLAT, t, 0, 1).astype(float).std() / 30.0 for t in (60.5, 119.5, 120.5))
    # Growth over 59.5 s: 0.3 (59.5/180)^0.8 = 0.124 K; half a count is 0.017 K.
    assert grown == pytest.approx(np.hypot(0.124, 0.02), abs=0.01)
    assert fresh < 0.04
    assert after < 0.04


def test_columns_share_their_offset():
    counts = replace(IDEAL, column_pattern=0.5).counts(FLAT, 1.0, 0, 1).astype(float)
    assert counts.std(axis=0).max() < 0.6
    assert counts.std(axis=1).min() > 10.0


def test_bad_pixels_always_say_the_same():
    sensor = replace(IDEAL, bad_pixel_share=0.002)
    first, second = sensor.counts(FLAT, 1.0, 0, 1), sensor.counts(FLAT + 3.0, 2.0, 1, 1)
    bad = first == second
    # 41 of 20480; a stuck one may happen to say what a good one does.
    assert 38 <= bad.sum() <= 41


def test_offset_drifts():
    sensor = replace(IDEAL, drift_counts=100.0, drift_period=40.0)
    assert sensor.counts(FLAT, 10.0, 0, 0).mean() - sensor.counts(FLAT, 30.0, 0, 0).mean() == pytest.approx(200, abs=1)


def frames_of(behaviour, noise=True):
    # How finely a frame is sampled has nothing to do with the shutter.
    scenario = replace(TINY, sensor=replace(FFC, ffc_behaviour=behaviour))
    return list(render_frames(scenario, noise=noise, quality=Quality(sub_frames=1, warm_up=0)))


def test_frozen_shutter_repeats_counts_under_new_stamps():
    frames = frames_of('frozen')
    frozen = [frame for frame in frames if frame.shutter]
    assert len(frozen) == 9
    assert len(frames) == 75
    before = frames[[frame.shutter for frame in frames].index(True) - 1]
    # The freeze goes over the end of a chunk of frames.
    assert all(np.array_equal(frame.counts, before.counts) for frame in frozen)
    assert np.all(np.diff([frame.stamp_ns for frame in frames]) > 33_000_000)
    live = [frame.counts for frame in frames if not frame.shutter]
    assert not any(np.array_equal(a, b) for a, b in pairwise(live))


def test_dropped_shutter_leaves_a_gap():
    stamps = np.diff([frame.stamp_ns for frame in frames_of('dropped')])
    assert stamps.max() == pytest.approx(1e9 / 3, abs=10)
    assert len(stamps) == 75 - 9 - 1


def test_shutter_view_is_flat():
    frames = frames_of('shutter')
    spread = [np.percentile(frame.counts, 99) - np.percentile(frame.counts, 1) for frame in frames]
    closed = [frame.shutter for frame in frames]
    assert max(np.array(spread)[closed]) < 0.3 * min(np.array(spread)[~np.array(closed)])


def test_without_noise_there_is_no_shutter():
    assert not any(frame.shutter for frame in frames_of('frozen', noise=False))


def test_without_noise_it_saturates_where_it_did():
    scenario = replace(TINY, sensor=replace(TINY.sensor, full_scale=255, offset_counts=20.0))
    # The warm surface, 15 K at 30 counts each, is beyond the scale.
    assert next(render_frames(scenario, noise=False, start=40)).counts.max() == 255


def test_refuses_an_unknown_behaviour():
    with pytest.raises(InputError, match='not one of frozen'):
        frames_of('blinking')


def test_never_means_never():
    assert not any(Sensor(ffc_period=0.0).in_ffc(t) for t in np.arange(0, 100, 0.1))
