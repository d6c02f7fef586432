"""Scores of flights as a line, and of many as a table."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from rigs.flight import MODES
from rigs.score import Score

#: Column to the format of its figures.
_COLUMNS = {
    'pose [mm]': '.1f',
    'NEES': '.2f',
    'beyond 3 sigma [%]': '.1f',
    'lost [%]': '.1f',
    'found [%]': '.1f',
    'resets': '.0f',
    'false': '.0f',
    'false in map': '.0f',
    'placed': '.0f',
    'map [mm]': '.1f',
    'NEES of the map': '.2f',
}


def line(score: Score) -> str:
    """All figures of a flight."""
    figures = ', '.join(f'{name} {_text(name, value)}' for name, value in _figures(score).items())
    return f'    {score.mode}: {figures}' + ' BEYOND ITS CLAIMS' * score.is_beyond_claims


def table(flights: Mapping[int, list[Score]]) -> str:
    """Markdown: medians and worst of each mode, and the flights that were beyond their claims."""
    rows = [('', *_COLUMNS), ['---'] * (len(_COLUMNS) + 1)]
    for number, mode in enumerate(MODES):
        figures = [_figures(scores[number]) for scores in flights.values()]
        rows.append((f'{mode}, median', *_row(figures, np.median)))
        rows.append((f'{mode}, worst', *_row(figures, max)))
    beyond = [
        f'{seed} ({score.mode})' for seed, scores in flights.items() for score in scores if score.is_beyond_claims
    ]
    lines = ''.join(f'| {" | ".join(row)} |\n' for row in rows)
    return f'{lines}\nof {len(flights)} rigs beyond their claims: {", ".join(beyond) or "none"}'


def _row(figures: Sequence[Mapping[str, float]], statistic: Callable[[list[float]], float]) -> list[str]:
    """A statistic of each column, of the flights that have such a figure."""
    cells = []
    for name in _COLUMNS:
        # Of what should be found, the least is the worst.
        sign = -1.0 if name == 'found [%]' else 1.0
        values = [sign * row[name] for row in figures if not np.isnan(row[name])]
        cells.append(_text(name, sign * statistic(values) if values else np.nan))
    return cells


def _text(name: str, value: float) -> str:
    return '–' if np.isnan(value) else f'{value:{_COLUMNS[name]}}'


def _figures(score: Score) -> dict[str, float]:
    values = (
        1e3 * score.poses.rms,
        score.poses.nees,
        1e2 * score.poses.beyond,
        1e2 * score.lost,
        1e2 * score.found,
        score.resets,
        score.false,
        score.false_mapped,
        score.markers.count,
        1e3 * score.markers.rms,
        score.markers.nees,
    )
    return dict(zip(_COLUMNS, values, strict=True))
