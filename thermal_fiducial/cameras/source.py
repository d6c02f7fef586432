"""Interface of the camera drivers."""

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
    """A camera or a substitute. All calls come from one thread."""

    #: events of the driver, e.g. ``short frames``, to their counts
    events: Counter[str]
    #: description of the camera
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
        """Received frames, oldest first; none if none arrived within a fraction of a second.

        Raises
        ------
        OSError
            The camera is gone.
        EndOfFramesError
            There will be no more.
        """

    def close(self) -> None:
        """Stop the stream and release the device; valid also if it is gone or was never opened."""


class EndOfFramesError(Exception):
    """The recorded pictures have ended."""


def now_ns() -> int:
    """The system's real-time clock, which is ROS's clock [ns]."""
    return time.time_ns()
