"""The file with the clock offset of a running filter, for its restart after a crash."""

from pathlib import Path

from thermal_fiducial.files.restart_file import recent_values, save_for_restart

_KIND = 'clock_offset'
#: Range of the parameter camera_time_offset [s].
_LARGEST_OFFSET = 1.0


def save_clock_offset(path: Path, offset: float) -> None:
    """Save the ``offset`` [s] as :func:`save_for_restart`."""
    save_for_restart(path, _KIND, {'camera_time_offset': offset})


def recent_clock_offset(path: Path) -> float | None:
    """The clock offset [s] of a filter that crashed within the last seconds; None if there is none."""
    try:
        offset = float(recent_values(path, _KIND)['camera_time_offset'])
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    return offset if abs(offset) <= _LARGEST_OFFSET else None
