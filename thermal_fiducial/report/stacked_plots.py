"""Stacked plots with a common time axis (Plotly): markers alone red, fused blue, truth grey."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.interruptions import Cause

FUSED, FIDUCIAL, TRUTH, GOOD = '#3b82f6', '#ef4444', '#94a3b8', '#22c55e'
BAND = 'rgba(59, 130, 246, 0.18)'
CAUSES = {
    Cause.SHUTTER: 'rgba(139, 92, 246, 0.20)',
    Cause.WITHHELD: 'rgba(236, 72, 153, 0.18)',
    Cause.NO_IMAGE: 'rgba(236, 72, 153, 0.18)',
    Cause.NO_MARKERS: 'rgba(245, 158, 11, 0.20)',
    Cause.UNUSED: 'rgba(239, 68, 68, 0.18)',
}
#: Most points of a line and of a scatter plot: half a minute at 400 Hz; more slow a phone down.
MOST_POINTS, MOST_DOTS = 12_000, 3_000
#: Height of one of the stacked plots, and of the margins around all [px].
ROW_PX, AROUND_PX = 128, 92
#: Values under the pointer, as in the tables: four digits (of D3's format).
_HOVER = '.4~g'
# Tick digits of a logarithmic axis, by its number of decades.
_LOG_TICKS = ((2, (1, 2, 5)), (4, (1, 3)), (np.inf, (1,)))


@dataclass(frozen=True)
class Chart:
    """A plot of the page. ``timed``: shares its time axis; ``wide``: as wide as the page."""

    name: str
    title: str
    text: str
    figure: Any
    timed: bool = True
    wide: bool = False


def thinned(length: int, most: int = MOST_POINTS) -> IntArray:
    """Indices of at most ``most`` of ``length`` samples, evenly."""
    if not length:
        return np.zeros(0, np.int64)
    return np.unique(np.linspace(0, length - 1, min(length, most)).round().astype(np.int64))


class TimePlots:
    """Stacked plots with a common time axis; traces are added one by one.

    Parameters
    ----------
    labels : titles of the vertical axes, from the top
    heights : relative; default: equal
    """

    def __init__(self, labels: Sequence[str], heights: Sequence[float] | None = None) -> None:
        rows = len(labels)
        self.figure = make_subplots(rows, 1, shared_xaxes=True, vertical_spacing=0.16 / rows, row_heights=heights)
        self.figure.update_layout(
            template='none',
            height=ROW_PX * max(rows, 2) + AROUND_PX,
            margin={'l': 62, 'r': 14, 't': 30, 'b': 44},
            legend={'orientation': 'h', 'yanchor': 'bottom', 'y': 1.0, 'x': 0.0, 'itemsizing': 'constant'},
            hovermode='x unified',
        )
        for row, label in enumerate(labels, 1):
            self.figure.update_yaxes(title_text=label, title_standoff=6, hoverformat=_HOVER, row=row, col=1)
        self.figure.update_xaxes(hoverformat='.3f')
        self.figure.update_xaxes(title_text='time [s]', row=rows, col=1)
        self._named: set[str] = set()

    def add(self, row: int, x: FloatArray, y: FloatArray, name: str, **look: Any) -> None:
        """Add a trace; traces of the same name share one entry of the legend, which switches them all."""
        first = name not in self._named
        self._named.add(name)
        values = {'x': np.asarray(x, np.float32), 'y': np.asarray(y, np.float32)}
        trace = go.Scatter(**values, name=name, legendgroup=name, showlegend=first, **look)
        self.figure.add_trace(trace, row=row, col=1)

    def line(
        self, row: int, x: FloatArray, y: FloatArray, name: str, colour: str, width: float = 1.3, pause: float = np.inf
    ) -> None:
        """Add a line of at most :data:`MOST_POINTS`, which ends where ``x`` pauses."""
        shown = thinned(len(x))
        behind = np.flatnonzero(np.diff(x) > pause) + 1
        at = np.searchsorted(shown, behind)
        drawn = np.insert(x[shown], at, x[behind]), np.insert(y[shown], at, np.nan)
        self.add(row, *drawn, name, mode='lines', line={'color': colour, 'width': width})

    def dots(self, row: int, x: FloatArray, y: FloatArray, name: str, colour: str, symbol: str = 'circle') -> None:
        """Add at most :data:`MOST_DOTS` dots."""
        shown = thinned(len(x), MOST_DOTS)
        marker = {'color': colour, 'size': 3.5 if symbol == 'circle' else 7, 'symbol': symbol}
        self.add(row, x[shown], y[shown], name, mode='markers', marker=marker)

    def band(self, row: int, x: FloatArray, half: FloatArray, name: str) -> None:
        """Add a band from ``-half`` to ``half``."""
        shown = thinned(len(x), MOST_DOTS)
        both = np.concatenate([half[shown], -half[shown][::-1]])
        look = {'fill': 'toself', 'fillcolor': BAND, 'line': {'width': 0}, 'mode': 'lines', 'hoverinfo': 'skip'}
        self.add(row, np.concatenate([x[shown], x[shown][::-1]]), both, name, **look)

    def make_logarithmic(self) -> None:
        """Make the vertical axes logarithmic, with full numbers at the ticks: Plotly writes single digits."""
        for number, row in enumerate(self.figure.select_yaxes(), 1):
            drawn = np.concatenate([trace.y for trace in self.figure.select_traces(row=number, col=1)] or [[]])
            values = drawn[np.isfinite(drawn)]
            if not len(values):
                continue
            first, last = np.floor(np.log10(values.min())), np.ceil(np.log10(values.max()))
            between = next(digits for decades, digits in _LOG_TICKS if last - first <= decades)
            ticks = [digit * 10.0**power for power in range(int(first), int(last) + 1) for digit in between]
            row.update(type='log', tickvals=ticks, ticktext=[f'{tick:g}' for tick in ticks])

    def shade(self, evaluation: Evaluation) -> None:
        """Shade the interruptions, with a colour per cause."""
        for entry in evaluation.interruptions:
            start, end = evaluation.seconds_at(entry.start_ns), evaluation.seconds_at(entry.end_ns)
            place = {'x0': start, 'x1': end, 'y0': 0, 'y1': 1, 'xref': 'x', 'yref': 'paper'}
            look = {'fillcolor': CAUSES[entry.cause], 'line': {'width': 0}, 'layer': 'below'}
            self.figure.add_shape(type='rect', **place, **look)
        for cause in dict.fromkeys(entry.cause for entry in evaluation.interruptions):
            square = {'symbol': 'square', 'size': 12, 'color': CAUSES[cause]}
            self.figure.add_trace(go.Scatter(x=[None], y=[None], mode='markers', marker=square, name=cause.value))
