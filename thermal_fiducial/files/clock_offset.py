"""The file with the clock offset of a running filter, for its restart after a crash."""

import json
import os
from pathlib import Path
import time

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_text

_FORMAT = {'format': 'thermal_fiducial/clock_offset', 'version': 1}
#: Age [s] beyond which a file is not of this flight.
_LONGEST = 10.0
#: Range of the parameter camera_time_offset [s].
_LARGEST_OFFSET = 1.0
_LIMIT_BYTES = 10_000


def save_clock_offset(path: Path, offset: float) -> None:
    """Replace the file: a reader sees the old ``offset`` [s] or the new one. It need not survive a power cut.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    new = path.with_name(path.name + '.new')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A link or pipe planted at this path is neither followed nor waited for.
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        with os.fdopen(os.open(new, flags, 0o600), 'w', encoding='utf-8') as file:
            json.dump(_FORMAT | {'camera_time_offset': offset}, file)
        new.replace(path)
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None


def recent_clock_offset(path: Path) -> float | None:
    """The clock offset [s] of a filter that crashed within the last seconds; None if there is none.

    A malformed file counts as none.
    """
    try:
        if not 0.0 <= time.time() - path.stat().st_mtime <= _LONGEST:
            return None
        document = json.loads(read_text(path, _LIMIT_BYTES))
        offset = float(document['camera_time_offset'])
        of_this_form = document.items() >= _FORMAT.items()
    except (OSError, InputError, ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
    return offset if of_this_form and abs(offset) <= _LARGEST_OFFSET else None
