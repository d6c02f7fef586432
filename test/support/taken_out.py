"""Parts of the core by their places, how long they are, and the core with something else in their place."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, ExitStack
from importlib import import_module
import inspect
from typing import Any
from unittest import mock


def place(package: str, path: str) -> Any:
    """What ``path`` names in ``package``: ``module``, ``module:name`` or ``module:class.name``."""
    module, _, names = path.partition(':')
    thing: Any = import_module(f'{package}.{module}')
    for name in names.split('.') if names else ():
        thing = getattr(thing, name)
    return thing


def lines_of(package: str, paths: Iterable[str]) -> int:
    """Lines of the source at these places."""
    return sum(len(inspect.getsource(place(package, path)).splitlines()) for path in paths)


@contextmanager
def replaced(package: str, stand_ins: Mapping[str, Any]) -> Iterator[None]:
    """The package with ``stand_ins`` at their places."""
    with ExitStack() as stack:
        for path, stand_in in stand_ins.items():
            owner, _, name = path.rpartition('.') if '.' in path.partition(':')[2] else path.rpartition(':')
            stack.enter_context(mock.patch.object(place(package, owner), name, stand_in))
        yield
