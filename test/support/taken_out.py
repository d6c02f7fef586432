"""Parts of the core by their places, how long they are, and the core with something else in their place."""

from collections.abc import Callable, Iterable, Iterator, Mapping
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


def ablation_row(
    name: str, mechanism: Any, package: str, scenes: Iterable[str], figures_of: Callable[..., Any], notable: float
) -> str:
    """A line of the table: all figures of ``scenes`` that change by more than ``notable`` without a mechanism.

    ``figures_of(scene)`` are those with it; ``figures_of(scene, mechanism)`` are measured anew, without it.
    """
    cells = []
    for scene in scenes:
        base = figures_of(scene)
        with replaced(package, mechanism.off):
            figures = figures_of(scene, mechanism)
        changes = [
            f'{what} {base[what]:.3g} -> {value:.3g}'
            for what, value in figures.items()
            if not abs(value - base[what]) <= notable * abs(base[what])
        ]
        cells += [f'{scene}: {", ".join(changes)}'] if changes else []
    return f'| {name} | {mechanism.lines} | {"; ".join(cells) or "nothing"} |'
