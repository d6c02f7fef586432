"""Records whose fields are drawn: each field stands with its range, as parameters of the package do."""

from collections.abc import Callable
from dataclasses import field, fields
from typing import Any, TypeVar

import numpy as np

T = TypeVar('T')
Draw = Callable[[np.random.Generator], Any]


def drawn(kind: type[T], rng: np.random.Generator) -> T:
    """A ``kind`` with all of its fields drawn, one after another."""
    return kind(**{item.name: item.metadata['draw'](rng) for item in fields(kind)})  # type: ignore[arg-type]


def by(draw: Draw) -> Any:
    """A field that is drawn so."""
    return field(metadata={'draw': draw})


def between(low: float, high: float) -> Any:
    """Any of a range."""
    return by(lambda rng: rng.uniform(low, high))


def sometimes(low: float, high: float) -> Any:
    """Zero in half of the flights, else any of a range."""
    return by(lambda rng: rng.choice([0.0, 1.0]) * rng.uniform(low, high))


def one_of(*values: Any, shares: list[float] | None = None) -> Any:
    """One of ``values``, with their shares, or as often as each other."""
    return by(lambda rng: values[rng.choice(len(values), p=shares)])


def normal(*sigma: float) -> Any:
    """A vector of these standard deviations, or a number of this one."""
    return by(lambda rng: rng.normal(0.0, sigma if len(sigma) > 1 else sigma[0]))
