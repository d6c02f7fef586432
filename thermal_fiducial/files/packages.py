"""Which of the libraries that only some commands need are installed."""

from importlib.util import find_spec


def is_installed(package: str) -> bool:
    """Whether a package could be imported; it is not, as that may take a second."""
    try:
        return find_spec(package) is not None
    except ImportError:
        return False
