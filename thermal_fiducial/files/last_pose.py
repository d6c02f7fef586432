"""The file with the last pose of a running filter, for its restart after a crash."""

import json
import os
from pathlib import Path
import time

import numpy as np

from thermal_fiducial.core.filter.initialization import HINT_SECONDS, LastPose
from thermal_fiducial.core.geometry.plausibility import LARGEST_COORDINATE
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_text

_FORMAT = {'format': 'thermal_fiducial/last_pose', 'version': 1}
#: Range of the parameter camera_time_offset [s].
_LARGEST_OFFSET = 1.0
_LIMIT_BYTES = 10_000


def save_last_pose(path: Path, last: LastPose) -> None:
    """Replace the file: a reader sees the old pose or the new one. It need not survive a power cut.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    document = _FORMAT | {
        'stamp_ns': last.stamp_ns,
        'T_map_body': last.T_map_body.tolist(),
        'camera_time_offset': last.camera_time_offset,
    }
    new = path.with_name(path.name + '.new')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # A link or pipe planted at this path is neither followed nor waited for.
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
        with os.fdopen(os.open(new, flags, 0o600), 'w', encoding='utf-8') as file:
            json.dump(document, file)
        new.replace(path)
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None


def recent_pose(path: Path) -> LastPose | None:
    """The pose of a filter that crashed within the last seconds; None if there is none.

    A malformed file counts as none, since the pose is only a hint.
    """
    try:
        if not 0.0 <= time.time() - path.stat().st_mtime <= HINT_SECONDS:
            return None
        document = json.loads(read_text(path, _LIMIT_BYTES))
        T_map_body, offset = np.array(document['T_map_body'], dtype=np.float64), document['camera_time_offset']
        last = LastPose(int(document['stamp_ns']), T_map_body, None if offset is None else float(offset))
        of_this_form = document.items() >= _FORMAT.items()
    except (OSError, InputError, ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
    is_pose = T_map_body.shape == (4, 4) and bool((np.abs(T_map_body) <= LARGEST_COORDINATE).all())
    in_time = 0 <= last.stamp_ns < 2**63 and abs(last.camera_time_offset or 0.0) <= _LARGEST_OFFSET
    return last if of_this_form and is_pose and in_time else None
