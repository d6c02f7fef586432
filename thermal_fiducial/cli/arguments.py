"""Arguments that many commands have, and types of arguments."""

import argparse
from collections.abc import Callable, Iterable, Sequence
import math
from pathlib import Path
import sys

from thermal_fiducial.core.wording import listed
from thermal_fiducial.errors import InputError


def add_remap(parser: argparse.ArgumentParser) -> None:
    """Option ``--remap``, for :func:`thermal_fiducial.files.bags.parse_remaps`."""
    parser.add_argument(
        '--remap',
        action='append',
        default=[],
        metavar='FROM:=TO',
        help='rename a topic of the bag; may be given several times',
    )


def add_calibration(parser: argparse.ArgumentParser) -> None:
    """Option ``--calibration``, for :func:`thermal_fiducial.calibration.sources.camera_of`."""
    parser.add_argument(
        '--calibration', type=Path, metavar='FILE', help='camera_info YAML (default: the camera_info of the bag)'
    )


#: The largest seed.
_MOST = 2**32 - 1


def whole_number(least: int, most: int = _MOST) -> Callable[[str], int]:
    """Type of an argument: a whole number from ``least`` to ``most``."""
    allowed = f'{least} or more' if most == _MOST else f'{least} to {most}'

    def number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f'{text!r} is not a whole number, {allowed}')
        return value

    return number


def number(least: float, most: float, unit: str = '') -> Callable[[str], float]:
    """Type of an argument: a number from ``least`` to ``most`` [unit], which excludes NaN and infinity."""

    def within(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f'{text!r} is not a number from {least:g} to {most:g} {unit}'.rstrip())
        return value

    return within


def warn(line: str) -> None:
    """Print a warning to standard error."""
    print(f'warning: {line}', file=sys.stderr)


def require_unit(option: str, quaternion: Sequence[float]) -> None:
    """Raise InputError for an orientation x y z w that is far from a unit quaternion, as one of zeros."""
    if not 0.9 < math.hypot(*quaternion) < 1.1:
        raise InputError(f'{option} is no unit quaternion x y z w')


def any_path(text: str) -> Path:
    """Type of an argument: a path; an empty one would be the folder in which the command runs."""
    if not text:
        raise argparse.ArgumentTypeError('a path cannot be empty')
    return Path(text)


def file_to_write(text: str) -> Path:
    """Type of an argument: a file that the command will write, refused before the work that leads to it.

    Raises
    ------
    argparse.ArgumentTypeError
        Its folder is not there, or it is a folder itself, or nothing.
    """
    path = any_path(text)
    if not path.parent.is_dir():
        raise argparse.ArgumentTypeError(f'{path}: no folder {path.parent}')
    if path.is_dir():
        raise argparse.ArgumentTypeError(f'{path}: is a folder, not a file to write')
    return path


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add the option that allows overwriting files."""
    parser.add_argument('--force', action='store_true', help='overwrite files that exist')


def refuse_to_overwrite(paths: Iterable[Path], force: bool) -> None:
    """Refuse to overwrite files, before any is written.

    Raises
    ------
    InputError
        One of ``paths`` exists, without ``force``.
    """
    existing = [] if force else [path for path in paths if path.exists()]
    if existing:
        raise InputError(f'{listed(existing, 1)}: the file exists; --force overwrites it')
