"""Small files of running nodes, which refresh them in flight, for their restart after a crash."""

from collections.abc import Mapping
import json
import os
from pathlib import Path
import time
from typing import Any

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.reading import read_text

#: Age [s] beyond which a file is not of this flight.
_LONGEST = 10.0
_LIMIT_BYTES = 10_000


def save_for_restart(path: Path, kind: str, values: Mapping[str, object]) -> None:
    """Replace the file: a reader sees the old ``values`` of this ``kind`` or the new ones.

    It need not survive a power cut.

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
            json.dump(_form_of(kind) | dict(values), file)
        new.replace(path)
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None


def recent_values(path: Path, kind: str) -> dict[str, Any]:
    """The values of a node that crashed within the last seconds; empty if there are none.

    A malformed file, or one of another ``kind``, counts as none.
    """
    try:
        if not 0.0 <= time.time() - path.stat().st_mtime <= _LONGEST:
            return {}
        document = json.loads(read_text(path, _LIMIT_BYTES))
        is_of_kind = isinstance(document, dict) and document.items() >= _form_of(kind).items()
    except (OSError, InputError, ValueError, TypeError, RecursionError):
        return {}
    return document if is_of_kind else {}


def _form_of(kind: str) -> dict[str, object]:
    return {'format': f'thermal_fiducial/{kind}', 'version': 1}
