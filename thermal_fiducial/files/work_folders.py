"""Hidden folders for what appears under its own name once it is whole."""

from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
import fcntl
import os
from pathlib import Path
import re
import shutil
import tempfile

from thermal_fiducial.errors import InputError
from thermal_fiducial.files.atomic import locked
from thermal_fiducial.files.writing import into


@contextmanager
def made_whole(out: Path) -> Iterator[Path]:
    """The path under which to write the new folder ``out``, which has its own name once it is whole.

    Raises
    ------
    InputError
        ``out`` exists or cannot be written.
    """
    if out.exists():
        raise InputError(f'{out} exists already')
    with into(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        with work_folder(out) as folder:
            with _named_as(out, folder / out.name):
                yield folder / out.name
            (folder / out.name).rename(out)


@contextmanager
def _named_as(out: Path, hidden: Path) -> Iterator[None]:
    """Let errors name ``out`` instead of the ``hidden`` place that the user has never heard of."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(str(hidden), str(out))) from None


@contextmanager
def work_folder(out: Path) -> Iterator[Path]:
    """A new folder beside ``out``, to be renamed from; removed in the end.

    It is locked as long as its process lives. What killed processes have left beside the same ``out`` is removed.

    Raises
    ------
    InputError
        Another program writes in the folder of ``out`` for too long.
    OSError
        From the file system.
    """
    # Under the lock of their common folder none is taken for left behind before it has its own lock.
    with locked(out):
        remove_left_behind(out, {out.name})
        folder = Path(tempfile.mkdtemp(prefix=f'.{out.name}-', dir=out.parent))
        descriptor = os.open(folder, os.O_RDONLY)
        _lock(descriptor)
    try:
        yield folder
    finally:
        os.close(descriptor)
        shutil.rmtree(folder)


def named_as_those_of(out: Path) -> list[Path]:
    """Folders beside ``out`` with names as work folders of it have; they may be somebody else's."""
    name = re.compile(rf'\.{re.escape(out.name)}-[a-z0-9_]{{8}}')
    return [path for path in out.parent.iterdir() if name.fullmatch(path.name)]


def remove_left_behind(out: Path, names: Collection[str]) -> None:
    """Remove work folders of ``out`` that hold nothing but ``names``, unless a process has locked them."""
    for folder in named_as_those_of(out):
        with suppress(OSError):
            _remove_if_left(folder, names)


def _remove_if_left(folder: Path, names: Collection[str]) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        if {item.name for item in folder.iterdir()} <= set(names) and _lock(descriptor):
            shutil.rmtree(folder)
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock a folder until its descriptor is closed; False if it is locked, or the file system has no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True
