"""Checks for optional libraries."""

from importlib.util import find_spec

from thermal_fiducial.errors import InputError


def is_installed(package: str) -> bool:
    """Whether a package can be imported, without importing it, which may take a second."""
    try:
        return find_spec(package) is not None
    except ImportError:
        return False


def remedy(extra: str) -> str:
    """How to install the libraries of an extra of ``setup.py``."""
    return f"pip install '.[{extra}]' in the package's folder"


def require_plots(option: str = '--plot') -> None:
    """Check for the plotting library before the work begins.

    Raises
    ------
    InputError
        matplotlib is missing.
    """
    if not is_installed('matplotlib'):
        raise InputError(f'{option} needs matplotlib: {remedy("tools")}')
