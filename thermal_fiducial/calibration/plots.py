"""Drawings of a calibration: residuals, coverage and error over the image, as SVG.

They are side by side on a wide screen and stacked on a narrow one. Lines and letters have the page's text colour, so
they are readable on a dark page too.
"""

from collections.abc import Sequence
from html import escape
import io
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
import numpy as np

from thermal_fiducial.calibration.board_shape import BoardShape
from thermal_fiducial.calibration.lens_check import ImageError
from thermal_fiducial.core.types import FloatArray, IntArray

#: Cells of the coverage drawing, columns and rows.
GRID = (16, 12)
# Placeholder colour in matplotlib's output, replaced by the page's text colour.
_INK = '#010203'
_INKED = ('text.color', 'axes.labelcolor', 'axes.edgecolor', 'xtick.color', 'ytick.color')
_STYLE: dict[Any, Any] = {'svg.fonttype': 'none', 'svg.hashsalt': 'calibration', 'font.size': 9}
_STYLE.update(dict.fromkeys(_INKED, _INK))
_SIZE, _WIDE = (5.2, 4.0), (10.6, 3.6)
# Most views whose names fit the width; with more the drawing grows and is scrolled.
_NAMES_IN_WIDTH, _INCHES_A_NAME = 50, 0.2
# Fewest points of a cell whose mean residual is drawn.
_LEAST_POINTS = 3
# Number of contour levels of the standard deviation, and its lower limit [px].
_LEVELS, _LEAST_PX = 13, 1e-3


def coverage(pixels: FloatArray, width: int, height: int) -> IntArray:
    """Number of points (N, 2) in each cell (rows, columns) of the image."""
    edges = np.linspace(-0.5, height - 0.5, GRID[1] + 1), np.linspace(-0.5, width - 0.5, GRID[0] + 1)
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=edges)
    return counts.astype(np.int64)


def drawings(
    size: tuple[int, int],
    pixels: FloatArray,
    residuals: Sequence[FloatArray],
    names: Sequence[str],
    error: ImageError,
    board: BoardShape,
) -> str:
    """All drawings as HTML.

    Parameters
    ----------
    size : width and height of the image [px]
    pixels : (N, 2) measured points of all views
    residuals : of each view (n, 2) [px], measured minus predicted
    names : of the views
    board : as described, and as found
    """
    every = np.concatenate(residuals)
    with rc_context(_STYLE):
        parts = [
            _field(size, pixels, every),
            _coverage(size, pixels),
            _known(size, error),
            _spread(every),
            *([_shape(board)] if board.largest_m > 0.0 else []),
            _bars(names, residuals),
        ]
    return f'<div class="plots">{"".join(parts)}</div>'


def _figure(title: str, size: tuple[float, float] = _SIZE) -> tuple[Figure, Any]:
    figure = Figure(figsize=size, layout='constrained')
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0.0)
    axes = figure.add_subplot()
    axes.patch.set_alpha(0.0)
    axes.set_title(title)
    return figure, axes


def _html(figure: Figure, title: str, *, wide: bool = False) -> str:
    stream = io.StringIO()
    figure.savefig(stream, format='svg', metadata={'Date': None})
    text = stream.getvalue()
    drawing = text[text.index('<svg') :].replace(_INK, 'currentColor')
    return f'<figure class="{"wide" if wide else "plot"}" aria-label="{escape(title)}">{drawing}</figure>'


def _frame(axes: Any, size: tuple[int, int]) -> None:
    """Axes of the image: v down."""
    axes.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), xlabel='u [px]', ylabel='v [px]', aspect='equal')


def _field(size: tuple[int, int], pixels: FloatArray, residuals: FloatArray) -> str:
    """Mean residual of each cell as an arrow: the systematic error of the model."""
    figure, axes = _figure('mean residual of each cell')
    column = np.clip(pixels[:, 0] * GRID[0] / size[0], 0, GRID[0] - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * GRID[1] / size[1], 0, GRID[1] - 1).astype(np.int64)
    cell = row * GRID[0] + column
    count = np.bincount(cell, minlength=GRID[0] * GRID[1])
    filled = np.flatnonzero(count >= _LEAST_POINTS)
    u, v, du, dv = (
        np.bincount(cell, weights=values, minlength=GRID[0] * GRID[1])[filled] / count[filled]
        for values in (*pixels.T, *residuals.T)
    )
    _frame(axes, size)
    if len(filled):
        # Scaled so that 95 % of the arrows are shorter than a cell; longer ones are of few points.
        long = max(float(np.percentile(np.hypot(du, dv), 95.0)), 1e-6)
        scale = long * GRID[0] / size[0]
        arrows = axes.quiver(u, v, du, dv, angles='xy', scale_units='xy', scale=scale, color=_INK, width=0.004)
        # Below, beside the name of the axis: above it would run into the title.
        axes.quiverkey(arrows, 0.95, -0.1, long, f'{long:.2g} px', labelpos='W')
    return _html(figure, 'mean residual of each cell')


def _coverage(size: tuple[int, int], pixels: FloatArray) -> str:
    figure, axes = _figure('coverage')
    extent = (-0.5, size[0] - 0.5, size[1] - 0.5, -0.5)
    shown = axes.imshow(coverage(pixels, *size), extent=extent)
    figure.colorbar(shown, ax=axes, label='points of a cell', shrink=0.8)
    _frame(axes, size)
    return _html(figure, 'coverage')


def _known(size: tuple[int, int], error: ImageError) -> str:
    title = 'how well the lens is known'
    figure, axes = _figure(title)
    sigma = np.maximum(error.sigma_px, _LEAST_PX)
    levels = np.geomspace(sigma.min(), max(sigma.max(), 1.001 * sigma.min()), _LEVELS)
    shown = axes.contourf(error.u, error.v, sigma, levels=levels, norm=LogNorm(levels[0], levels[-1]))
    ticks = levels[:: (_LEVELS - 1) // 4]
    bar = figure.colorbar(shown, ax=axes, label='standard deviation [px]', shrink=0.8, ticks=ticks)
    bar.ax.minorticks_off()
    bar.ax.set_yticklabels([f'{level:.2g}' for level in ticks])
    _frame(axes, size)
    if error.covered.any() and not error.covered.all():
        axes.contour(error.u, error.v, error.covered, levels=[0.5], colors='white', linestyles='dashed')
        axes.set_xlabel('u [px]; dashed: as far as the views reach')
    return _html(figure, title)


def _spread(residuals: FloatArray) -> str:
    figure, axes = _figure('residuals of all points')
    axes.plot(residuals[:, 0], residuals[:, 1], '.', markersize=2, rasterized=True)
    axes.set(xlabel='u [px]', ylabel='v [px]', aspect='equal')
    # Numbers of three digits run into each other where there are more.
    axes.locator_params(nbins=5)
    return _html(figure, 'residuals of all points')


def _shape(board: BoardShape) -> str:
    """Where the points of the board are off: arrows in its plane, colours across it."""
    title = 'the board against its description'
    figure, axes = _figure(title)
    points, along, across = board.seen_from_the_front()
    most = 1e3 * float(np.abs(across).max())
    shown = axes.scatter(*points.T, c=1e3 * across, cmap='coolwarm', vmin=-most, vmax=most)
    figure.colorbar(shown, ax=axes, label='towards the viewer [mm]', shrink=0.8)
    # Arrows are a twentieth of the board long, at the most.
    long = max(float(np.linalg.norm(along, axis=1).max()), 1e-9)
    scale = 20.0 * long / float(np.ptp(points, axis=0).max())
    arrows = axes.quiver(*points.T, *along.T, angles='xy', scale_units='xy', scale=scale, color=_INK, width=0.004)
    axes.quiverkey(arrows, 0.95, -0.1, long, f'{1e3 * long:.2g} mm', labelpos='W')
    axes.set(xlabel='[m]', ylabel='[m]', aspect='equal')
    axes.margins(0.1)
    axes.locator_params(nbins=5)
    return _html(figure, title)


def _bars(names: Sequence[str], residuals: Sequence[FloatArray]) -> str:
    width = _WIDE[0] + _INCHES_A_NAME * max(0, len(names) - _NAMES_IN_WIDTH)
    figure, axes = _figure('rms of each view', (width, _WIDE[1]))
    axes.bar(range(len(names)), [float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))) for residual in residuals])
    # Names of files are no formulas, whatever is between two dollar signs.
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7, parse_math=False)
    axes.set(ylabel='[px]', xlim=(-0.7, len(names) - 0.3))
    return _html(figure, 'rms of each view', wide=True)
