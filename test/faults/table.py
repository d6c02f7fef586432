"""The table of faults for the documents."""

from collections.abc import Sequence

import numpy as np

from faults.kinds import Fault
from faults.score import Score, TOO_LONG

_HEAD = (
    'worst pose',
    'declared after',
    'recovered after',
    'beyond 3 sigma',
    'off by 0.1 m for',
    'beyond 3 sigma for',
    'to the autopilot: off / all, worst',
)


def table(results: Sequence[tuple[Fault, Score]], flights: int) -> str:
    """Markdown, a row for each fault; what is undeclared for too long stands in bold."""
    head = (f'fault ({flights} flight{"s" * (flights > 1)} each)', *_HEAD)
    rows = [head, ['---'] * len(head)] + [_row(fault, result) for fault, result in results]
    return ''.join(f'| {" | ".join(row)} |\n' for row in rows)


def _row(fault: Fault, result: Score) -> list[str]:
    name = fault.name if fault.group == 'none' else f'{fault.group}: {fault.name}'
    return [
        name,
        _metres(result.worst),
        _seconds(result.declared),
        _seconds(result.recovered),
        f'{100 * result.beyond:.1f} %',
        _stretch(result.off_for),
        _stretch(result.beyond_for),
        f'{result.sent_off} / {result.sent}, {_metres(result.sent_worst)}',
    ]


def _metres(value: float) -> str:
    return f'{1e3 * value:.0f} mm' if value < 1.0 else f'{value:.1f} m' if value < 1e4 else f'{value:.0e} m'


def _seconds(value: float) -> str:
    return 'never' if np.isinf(value) else '–' if np.isnan(value) else f'{value:.2f} s'


def _stretch(value: float) -> str:
    words = f'{value:.2f} s' if value else '–'
    return f'**{words}**' if value > TOO_LONG else words
