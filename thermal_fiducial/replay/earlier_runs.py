"""Folders that a replay may write to: nothing but what an earlier one has left is ever replaced."""

from pathlib import Path

from thermal_fiducial.errors import InputError


def refuse_other_folder(out: Path) -> bool:
    """Refuse a folder that is neither empty nor that of an earlier replay.

    Returns
    -------
    Whether it holds an earlier replay, which a new one replaces.

    Raises
    ------
    InputError
        It holds something else.
    """
    names = {path.name for path in out.iterdir()} if out.is_dir() else set()
    # A failed replay leaves parameters and map.
    failed = all(name.startswith(('parameters.yaml', 'marker_map.', 'truth.tum', 'map_true.yaml')) for name in names)
    earlier = 'parameters.yaml' in names and ('output' in names or failed)
    if out.exists() and not earlier and (not out.is_dir() or names):
        raise InputError(f'{out} exists and is no earlier run: choose another folder with --out')
    return earlier
