"""filterpy's extended Kalman filter, imported alone: the whole of filterpy takes two thirds of a node's start time.

Importing any module of filterpy imports all of them, and scipy.stats. The EKF module needs only two helpers,
``logpdf`` for a likelihood that is not used here, and ``scipy.linalg.inv``, which numpy replaces.
"""

from importlib import import_module
from importlib.util import find_spec
import sys
from types import ModuleType
from typing import Any

import numpy as np

_NAME = 'filterpy'


def _logpdf(*args: Any, **kwargs: Any) -> Any:
    """The likelihood's ``logpdf`` of filterpy, imported when it is called."""
    return import_module(f'{_NAME}.stats').logpdf(*args, **kwargs)


def _load() -> Any:
    """``ExtendedKalmanFilter``; imports all of filterpy if it is loaded already, or if its layout has changed."""
    spec = find_spec(_NAME)
    if _NAME not in sys.modules and spec is not None and spec.submodule_search_locations:
        try:
            return _load_alone(list(spec.submodule_search_locations))
        except (ImportError, AttributeError):
            pass
    return import_module(f'{_NAME}.kalman').ExtendedKalmanFilter


def _load_alone(places: list[str]) -> Any:
    """The class alone, from the package at ``places``: shells stand for what would be imported beside it."""
    shells = {
        name: ModuleType(name) for name in (_NAME, *(f'{_NAME}.{part}' for part in ('kalman', 'common', 'stats')))
    }
    for name, shell in shells.items():
        shell.__path__ = [place + name.removeprefix(_NAME).replace('.', '/') for place in places]
    shells[f'{_NAME}.stats'].logpdf = _logpdf  # type: ignore[attr-defined]
    scipy = ModuleType('scipy')
    scipy.linalg = np.linalg  # type: ignore[attr-defined]
    shells |= {'scipy': scipy, 'scipy.linalg': np.linalg}
    before = {name: sys.modules[name] for name in shells if name in sys.modules}
    sys.modules.update(shells)
    try:
        helpers = import_module(f'{_NAME}.common.helpers')
        vars(shells[f'{_NAME}.common']).update(pretty_str=helpers.pretty_str, reshape_z=helpers.reshape_z)
        return import_module(f'{_NAME}.kalman.EKF').ExtendedKalmanFilter
    finally:
        # Whoever imports filterpy or scipy gets all of it.
        for name in [name for name in sys.modules if name in shells or name.startswith(f'{_NAME}.')]:
            del sys.modules[name]
        sys.modules.update(before)


ExtendedKalmanFilter = _load()
