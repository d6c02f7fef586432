"""What the pictures may show, frame by frame through the camera's front end and the detector."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from faults.flight import BEGIN, during, END, Event, event, LATE, Recorded, Stream
from thermal_fiducial.sim.lens import Lens
from thermal_fiducial.sim.thermal_camera import render_frames

#: A quarter of the pixels of a Tau 2: a rendered frame costs as much less.
LENS = Lens((382.6, 382.3), (161.2, 125.4), width=320, height=256)
_FULL_SCALE = 16383
#: Deviation of the counts of a pixel that sees nothing.
_NOISE_COUNTS = 4.0
_SHUTTER = 0.5


@lru_cache(1)
def rendered(flight: Recorded) -> list[Event]:
    """The frames of a flight; the last ones are kept."""
    first, *_, last = flight.indices
    frames = render_frames(flight.scenario, flight.plan.seconds, flight.seed, start=first, stop=last + 1)
    return [event(frame.seconds, frame.counts, LATE) for frame in frames]


def with_pictures(change: Callable[[Event], Event | None], end: float = END) -> Callable[[Recorded], Stream]:
    """A fault that changes frames."""
    return lambda flight: Stream.of(flight.imu, during(rendered(flight), change, end=end))


def killed(name: str, back: float) -> Callable[[Recorded], Stream]:
    """A node is away until ``back`` [s]."""
    return lambda flight: Stream.of(flight.imu, rendered(flight), kills={name: (BEGIN, back)})


def _with_counts(change: Callable[[np.ndarray, float], np.ndarray]) -> Callable[[Event], Event]:
    return lambda item: replace(item, value=change(item.value, item.sampled))


def _faded(counts: np.ndarray, t: float) -> np.ndarray:
    """Fog that thickens for a second until nothing is seen, stays for one, and clears as fast."""
    contrast = np.clip(max(BEGIN + 1.0 - t, t - END), 0.0, 1.0)
    noise = np.random.default_rng(round(1e6 * t)).normal(0.0, _NOISE_COUNTS * np.sqrt(1.0 - contrast**2), counts.shape)
    middle = np.median(counts)
    return np.rint(middle + contrast * (counts - middle) + noise).astype(np.uint16)


def _held(flight: Recorded, end: float) -> Stream:
    """The last picture again and again under new stamps."""
    last = next(item for item in reversed(rendered(flight)) if item.sampled < BEGIN)
    return with_pictures(lambda item: replace(item, value=last.value), end)(flight)


fog = with_pictures(_with_counts(_faded), END + 1.0)
saturated = with_pictures(_with_counts(lambda counts, _: np.minimum(counts + 9300, _FULL_SCALE).astype(np.uint16)))
full_scale = with_pictures(_with_counts(lambda counts, _: np.full_like(counts, _FULL_SCALE)))
shutter_flat = with_pictures(_with_counts(lambda counts, _: _flat(counts)), BEGIN + _SHUTTER)
SHUTTER_ENDS = BEGIN + _SHUTTER


def shutter_frozen(flight: Recorded) -> Stream:
    """A shutter during which the camera repeats its last picture."""
    return _held(flight, SHUTTER_ENDS)


def frozen(flight: Recorded) -> Stream:
    """A picture that stands still."""
    return _held(flight, END)


def _flat(counts: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(int(counts[0, 0])).normal(0.0, _NOISE_COUNTS, counts.shape)
    return np.rint(np.median(counts) + noise).astype(np.uint16)
