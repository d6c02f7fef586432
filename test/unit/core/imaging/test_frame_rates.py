"""Frame rates of cameras and of the drivers behind them: every new frame passes once, whatever is repeated between."""

import numpy as np
import pytest

from thermal_fiducial.config import Tau2CameraConfig
from thermal_fiducial.core.imaging.frame_cleaner import FrameCleaner, FROZEN, SETTLING

START_NS = 1_700_000_000_000_000_000
RATES_HZ = (7.5, 9.0, 25.0, 30.0, 60.0)
#: (camera, driver): each camera by itself, and the slower ones behind a driver that repeats their frames
STREAMS = [(rate, rate) for rate in RATES_HZ] + [(c, d) for c in RATES_HZ for d in (30.0, 60.0) if c < d]
# A shutter event: this long nothing new comes, at this time.
CLOSED_S = (4.0, 4.5)


def picture(k):
    """The camera's frame number ``k``: a warm square, and noise that no other frame has."""
    counts = np.random.default_rng(k).normal(7000.0, 1.3, (64, 80))
    counts[20:40, 30:50] += 150.0
    return counts.round().astype(np.uint16)


def stream(camera_hz, driver_hz, seconds, closed_s=(0.0, 0.0)):
    """What a driver sends: (stamp [ns], number of the camera's frame), the newest one at each of its ticks."""
    for tick in range(int(seconds * driver_hz)):
        # Between the ticks of two clocks that start together a frame is always a little older than its tick.
        t = tick / driver_hz + 1e-4
        seen = closed_s[0] if closed_s[0] <= t < closed_s[1] else t
        yield START_NS + round(t * 1e9), int(seen * camera_hz)


def reasons(cleaner, frames):
    """By number of the camera's frame: the outcomes of all the times it was sent."""
    found = {}
    for stamp_ns, number in frames:
        found.setdefault(number, []).append(cleaner.process(stamp_ns, picture(number)).reason)
    return found


@pytest.mark.parametrize(('camera_hz', 'driver_hz'), STREAMS)
def test_every_new_frame_passes_once_and_repeats_are_withheld(camera_hz, driver_hz):
    found = reasons(FrameCleaner(Tau2CameraConfig()), stream(camera_hz, driver_hz, 3.0))
    assert len(found) >= int(3.0 * camera_hz) - 1
    for number, outcomes in found.items():
        # A camera slower than 30 Hz is known to be so from its second frame on, which may be held back for that.
        if number > 1:
            assert outcomes == [''] + [FROZEN] * (len(outcomes) - 1)
    assert found[0][0] == ''


@pytest.mark.parametrize('settle_frames', [1, 3])
@pytest.mark.parametrize(('camera_hz', 'driver_hz'), STREAMS)
def test_after_a_shutter_event_as_many_frames_settle_as_are_asked_for(camera_hz, driver_hz, settle_frames):
    cleaner = FrameCleaner(Tau2CameraConfig(settle_frames=settle_frames))
    found = reasons(cleaner, stream(camera_hz, driver_hz, 7.0, CLOSED_S))
    first = min(number for number in found if number >= int(CLOSED_S[1] * camera_hz))
    after = [found[number][0] for number in range(first, max(found) + 1)]
    # A driver as fast as the camera repeats nothing that would show the stop of the slowest ones: nothing to settle.
    assert after == [SETTLING] * settle_frames + [''] * (len(after) - settle_frames)


def test_a_camera_that_changes_its_rate_is_followed():
    cleaner = FrameCleaner(Tau2CameraConfig())
    fast = reasons(cleaner, stream(30.0, 30.0, 2.0))
    assert set(map(tuple, fast.values())) == {('',)}
    slow = {}
    for stamp_ns, number in stream(7.5, 30.0, 4.0):
        slow.setdefault(number, []).append(cleaner.process(stamp_ns + 2_000_000_000, picture(1000 + number)).reason)
    # Half of the nine last intervals must be of the new rate before it counts: 0.7 s.
    assert [outcomes[0] for number, outcomes in slow.items() if number > 6] == [''] * (len(slow) - 7)


@pytest.mark.parametrize(('camera_hz', 'driver_hz'), [(60 / 7, 30.0), (60 / 7, 60.0), (7.5, 30.0)])
def test_a_driver_that_repeats_frames_is_known(camera_hz, driver_hz):
    """Seven periods of 60 Hz are three or four of 30 Hz."""
    cleaner = FrameCleaner(Tau2CameraConfig())
    assert not cleaner.repeating
    reasons(cleaner, stream(camera_hz, driver_hz, 6.0, CLOSED_S))
    assert cleaner.repeating


@pytest.mark.parametrize('rate', [7.5, 30.0])
def test_a_camera_that_is_as_fast_as_its_driver_repeats_nothing(rate):
    cleaner = FrameCleaner(Tau2CameraConfig())
    reasons(cleaner, stream(rate, rate, 6.0, CLOSED_S))
    assert not cleaner.repeating


def test_a_camera_that_stops_repeats_nothing_any_more():
    cleaner = FrameCleaner(Tau2CameraConfig())
    reasons(cleaner, stream(7.5, 30.0, 4.4, CLOSED_S))
    assert not cleaner.repeating
