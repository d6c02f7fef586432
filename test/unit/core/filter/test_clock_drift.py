"""A camera whose clock runs fast, as one crystal against another does."""

from dataclasses import replace

import numpy as np
import pytest
from support import flights

from thermal_fiducial.core.filter.ekf import PoseEkf

#: Two crystals may differ by this much.
_DRIFT = 50e-6
#: Brisk until this instant, then nearly still, until the end [s].
_CALM_S, _END_S = 10.0, 80.0
_STILL, _CHANGE_S = 0.01, 0.8


class Interrupted(flights.Motion):
    """A motion whose own time nearly stops."""

    def _sum(self, table, t, order):
        x = (_CALM_S - np.asarray(t)) / _CHANGE_S
        share = 0.5 * (1.0 + np.tanh(0.5 * x))
        own = np.asarray(t) - (1.0 - _STILL) * _CHANGE_S * np.logaddexp(0.0, -x)
        rate = (_STILL + (1.0 - _STILL) * share)[..., None]
        change = (-(1.0 - _STILL) * share * (1.0 - share) / _CHANGE_S)[..., None]
        if order == 0:
            return super()._sum(table, own, 0)
        first = super()._sum(table, own, 1)
        # By the chain rule.
        return first * rate if order == 1 else super()._sum(table, own, 2) * rate**2 + first * change


@pytest.mark.slow
def test_a_clock_that_drifts_while_nothing_shows_it_is_allowed_for():
    """Seventy seconds of hover, in which the offset moves by 3.5 ms."""
    drawn = flights.Motion.random(np.random.default_rng(101), speed=1.5, turn=0.75)
    motion = Interrupted(drawn.position, drawn.rotation)
    flight = flights.Flight(seed=1, seconds=_END_S, motion=motion, imu_rate=100.0, pose_rate=10.0)
    ahead_ns = [round(_DRIFT * (pose.stamp_ns - flights.START_NS)) for pose in flight.poses]
    drifted = [replace(pose, stamp_ns=pose.stamp_ns + ns) for pose, ns in zip(flight.poses, ahead_ns, strict=True)]
    ekf = PoseEkf(flights.config())
    flights.run(ekf, flights.timeline(flight.samples(), drifted, 0.03))
    figures = ekf.diagnostics()
    error = figures['time offset'] + 1e-9 * ahead_ns[-1]
    # 1.3 times it; 4.7 times with a walk of 5e-5.
    assert abs(error) < 3.0 * figures['time offset std']
    # A walk that allows for any drift would forget what the brisk flight has shown.
    assert figures['time offset std'] < 0.005
