"""Which of the libraries that only some commands need are installed."""

from importlib.util import find_spec

from thermal_fiducial.errors import InputError


def is_installed(package: str) -> bool:
    """Whether a package could be imported; it is not, as that may take a second."""
    try:
        return find_spec(package) is not None
    except ImportError:
        return False


def require_plots(option: str = '--plot') -> None:
    """Say that nothing can be drawn before work begins.

    Raises
    ------
    InputError
        matplotlib is missing.
    """
    if not is_installed('matplotlib'):
        raise InputError(f'{option} needs matplotlib: install the extra "tools"')
