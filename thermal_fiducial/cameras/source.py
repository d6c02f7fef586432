"""What every camera driver offers."""

from collections import Counter
from dataclasses import dataclass
import time
from typing import Protocol

from thermal_fiducial.core.types import Counts


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """One frame as the camera sent it.

    Parameters
    ----------
    stamp_ns : when it was captured, by the system's real-time clock
    counts : (H, W) uint16 [counts]
    """

    stamp_ns: int
    counts: Counts


class FrameSource(Protocol):
    """A camera, or what stands for one. All calls come from one thread."""

    #: events of the driver in words, e.g. ``short frames``, to how often they happened
    events: Counter[str]
    #: what it is, in words
    name: str

    def open(self) -> None:
        """Connect and start the stream.

        Raises
        ------
        OSError
            It is not there (any more).
        InputError
            It is there and cannot be used as it was asked for.
        """

    def read(self) -> list[CapturedFrame]:
        """Frames that have come, oldest first; none if there were none for a fraction of a second.

        Raises
        ------
        OSError
            The camera is gone.
        EndOfFramesError
            There will be no more.
        """

    def close(self) -> None:
        """Stop the stream and let go of the device; also of one that is gone, or was never opened."""


class EndOfFramesError(Exception):
    """Recorded pictures have all been shown."""


def now_ns() -> int:
    """The system's real-time clock, which ROS takes for its own [ns]."""
    return time.time_ns()
