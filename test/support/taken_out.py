"""Parts of the core by their places, how long they are, and the core with something else in their place."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, ExitStack
from dataclasses import dataclass, field
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


@dataclass(frozen=True)
class Mechanism:
    """A part of the core that can be taken out.

    Parameters
    ----------
    scenes : that it is for
    parts : modules, or functions and classes of modules as ``module:name``, that exist for it alone
    off : places (``module:name``, ``module:class.name``), and what is put there
    changes : parameters that take it out
    """

    scenes: tuple[str, ...]
    parts: tuple[str, ...] = ()
    off: Mapping[str, Any] = field(default_factory=dict)
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Study:
    """What each mechanism of a package buys: all figures of its scenes that change without it.

    Parameters
    ----------
    mechanisms : by name
    scenes : by name, from parameters to figures
    notable : change of a figure that is worth printing, as a share of it
    always : scenes that every mechanism is judged by, beside its own
    """

    package: str
    mechanisms: Mapping[str, Mechanism]
    scenes: Mapping[str, Callable[[Mapping[str, Any]], Mapping[str, float]]]
    notable: float
    always: tuple[str, ...] = ()

    def print(self, chosen: Sequence[str]) -> None:
        """Print the table of the ``chosen`` mechanisms; none: of all. Scenes that are not there are left out."""
        chosen = chosen or list(self.mechanisms)
        names = {scene for name in chosen for scene in self._scenes_of(name)}
        base = {scene: self.scenes[scene]({}) for scene in sorted(names)}
        for scene, figures in base.items():
            print(scene, {what: float(f'{value:.4g}') for what, value in figures.items()}, flush=True)
        print('| mechanism | lines | without it |')
        print('| --- | --- | --- |')
        for name in chosen:
            print(self._row(name, base), flush=True)

    def _scenes_of(self, name: str) -> list[str]:
        wanted = dict.fromkeys((*self.mechanisms[name].scenes, *self.always))
        return [scene for scene in wanted if scene in self.scenes]

    def _row(self, name: str, base: Mapping[str, Mapping[str, float]]) -> str:
        mechanism, cells = self.mechanisms[name], []
        for scene in self._scenes_of(name):
            with replaced(self.package, mechanism.off):
                figures = self.scenes[scene](mechanism.changes)
            changes = [
                f'{what} {base[scene][what]:.3g} -> {value:.3g}'
                for what, value in figures.items()
                if not abs(value - base[scene][what]) <= self.notable * abs(base[scene][what])
            ]
            cells += [f'{scene}: {", ".join(changes)}'] if changes else []
        return f'| {name} | {lines_of(self.package, mechanism.parts)} | {"; ".join(cells) or "nothing"} |'
