"""Report of a calibration: numbers and pictures in one HTML file."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from thermal_fiducial.calibration.intrinsics import Calibration
from thermal_fiducial.calibration.lens_check import ImageError
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.types import Counts, FloatArray, Gray, IntArray
from thermal_fiducial.files.writing import write_text

#: Cells of the coverage picture, columns and rows.
GRID = (16, 12)
# Longest residual of a view as drawn, as a share of the picture's width; width of the pictures [px].
_ARROW, _WIDTH = 0.06, 480
_STYLE = """
:root{color-scheme:light dark;--line:#8888}
body{font-family:system-ui,sans-serif;max-width:75em;margin:1em auto;padding:0 1em;line-height:1.4}
table{border-collapse:collapse;display:block;overflow-x:auto}
td,th{padding:.2em .8em;text-align:right;border-bottom:1px solid var(--line)}
td:first-child,th:first-child{text-align:left}
img{max-width:100%;background:#fff}
.views{display:grid;grid-template-columns:repeat(auto-fill,minmax(20em,1fr));gap:1em}
figure{margin:0}figcaption{font-size:.9em;overflow-wrap:anywhere}
svg{width:100%;height:auto;background:#ddd}
"""


@dataclass(frozen=True)
class BoardView:
    """A frame that shows the board.

    Parameters
    ----------
    name : of its file, or its number in the bag
    sighting : the points
    counts : the frame; None where points were measured elsewhere
    """

    name: str
    sighting: Sighting
    counts: Counts | Gray | None = None


def coverage(pixels: FloatArray, width: int, height: int) -> IntArray:
    """Number of points (N, 2) in each cell (rows, columns) of the image."""
    edges = np.linspace(-0.5, height - 0.5, GRID[1] + 1), np.linspace(-0.5, width - 0.5, GRID[0] + 1)
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=edges)
    return counts.astype(np.int64)


def write_report(
    path: Path,
    calibration: Calibration,
    views: Sequence[BoardView],
    fits: Mapping[str, Calibration],
    error: ImageError,
    unusable: Sequence[tuple[str, str]] = (),
) -> None:
    """Write the report.

    Parameters
    ----------
    views : all that the calibration was given
    fits : the best of each model
    unusable : name and reason of the frames that gave nothing

    Raises
    ------
    InputError
        The file can't be written.
    """
    page = (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Calibration</title>'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}</style></head><body>'
        f'<h1>Calibration</h1>{_overview(calibration, error)}{_numbers(calibration, fits)}'
        f'{_picture(calibration, views, error)}{_left_out(calibration, views, unusable)}'
        f'<h2>Views</h2>{_view_figures(calibration, views)}</body></html>'
    )
    write_text(path, page)


def _overview(calibration: Calibration, error: ImageError) -> str:
    camera = calibration.camera
    held_out, sigma = calibration.held_out_px
    return (
        f'<p><b>{escape(calibration.lens_name())}</b>, {camera.width} x {camera.height} px; {len(calibration.views)} '
        f'views used, {len(calibration.dropped)} dropped; re-projection rms {calibration.rms_px:.4f} px, of views that '
        f'were not fitted {held_out:.4f} &plusmn; {sigma:.4f} px.</p><p>{error.sentence().capitalize()}.</p>'
    )


def _numbers(calibration: Calibration, fits: Mapping[str, Calibration]) -> str:
    parameters = [(name, f'{value:.6g}', f'{sigma:.2g}') for name, value, sigma in calibration.parameter_rows()]
    lenses = [
        (fit.lens_name(), f'{fit.held_out_px[0]:.4f}', f'{fit.held_out_px[1]:.4f}', f'{fit.rms_px:.4f}')
        for fit in fits.values()
    ]
    return (
        _table(('parameter', 'value', 'standard deviation'), parameters)
        + '<p>A coefficient of exactly 0 was not determined by these views; its standard deviation says what it may be.'
        + '</p><h2>Models</h2>'
        + _table(('model', 'held-out rms [px]', 'standard error [px]', 'rms [px]'), lenses)
    )


def _left_out(calibration: Calibration, views: Sequence[BoardView], unusable: Sequence[tuple[str, str]]) -> str:
    rows = [(views[index].name, 'fits far worse than the other views') for index in calibration.dropped]
    rows += list(unusable)
    return '<h2>Not used</h2>' + (_table(('frame', 'reason'), rows) if rows else '<p>Every frame was used.</p>')


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = ''.join('<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>' for row in rows)
    return f'<table><tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}</tr>{cells}</table>'


# --- each view ----------------------------------------------------------------------------------------


def _view_figures(calibration: Calibration, views: Sequence[BoardView]) -> str:
    """Every view with its points, and residuals as enlarged lines."""
    every = np.concatenate(calibration.residuals)
    longest = float(np.percentile(np.linalg.norm(every, axis=1), 99.0))
    enlarged = _ARROW * calibration.camera.width / max(longest, 1e-6)
    figures = [
        _view_figure(views[index], residual, enlarged, calibration)
        for index, residual in zip(calibration.views.tolist(), calibration.residuals, strict=True)
    ]
    text = f'<p>Residuals, measured minus predicted, are drawn {enlarged:.0f} times as long as they are.</p>'
    return f'{text}<div class="views">{"".join(figures)}</div>'


def _view_figure(view: BoardView, residual: FloatArray, enlarged: float, calibration: Calibration) -> str:
    width, height = calibration.camera.width, calibration.camera.height
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    worst = float(np.linalg.norm(residual, axis=1).max())
    size = width / 200.0
    marks = []
    for (u, v), (du, dv) in zip(view.sighting.pixels.tolist(), (enlarged * residual).tolist(), strict=True):
        marks.append(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{size:.1f}"/>')
        marks.append(f'<path d="M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}"/>')
    return (
        f'<figure><svg viewBox="-0.5 -0.5 {width} {height}" role="img">{_thumbnail(view)}'
        f'<g fill="none" stroke="#e6005c" stroke-width="{0.4 * size:.1f}">{"".join(marks)}</g></svg>'
        f'<figcaption>{escape(view.name)}: {len(residual)} points, rms {rms:.3f} px, largest {worst:.2f} px'
        f'</figcaption></figure>'
    )


def _thumbnail(view: BoardView) -> str:
    if view.counts is None:
        return ''
    low, high = np.percentile(view.counts, (0.5, 99.5))
    shown = np.clip((view.counts - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    height, width = shown.shape
    small = cv2.resize(shown, (min(width, _WIDTH), round(height * min(width, _WIDTH) / width)))
    code = base64.b64encode(cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()).decode()
    return f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="data:image/jpeg;base64,{code}"/>'


# --- all views together -------------------------------------------------------------------------------


def _picture(calibration: Calibration, views: Sequence[BoardView], error: ImageError) -> str:
    """Residual field, coverage, error over the image and rms a view as an embedded PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    used = [views[index] for index in calibration.views.tolist()]
    pixels = np.concatenate([view.sighting.pixels for view in used])
    figure = Figure(figsize=(13, 13), layout='constrained')
    FigureCanvasAgg(figure)
    (field, cover), (known, spread) = figure.subplots(3, 2)[:2]
    for axes in figure.axes[4:]:
        axes.remove()
    bars = figure.add_subplot(3, 1, 3)
    residuals = np.concatenate(calibration.residuals)
    _draw_field(field, calibration, pixels, residuals)
    camera = calibration.camera
    shown = cover.imshow(coverage(pixels, camera.width, camera.height), extent=(0, camera.width, camera.height, 0))
    figure.colorbar(shown, ax=cover, label='points')
    cover.set(title='coverage', xlabel='u [px]', ylabel='v [px]')
    levels = np.log10(np.maximum(error.sigma_px, 1e-3))
    shown = known.contourf(error.u, error.v, levels, levels=12)
    figure.colorbar(shown, ax=known, label='log10 of standard deviation [px]')
    known.set(title='how well the lens is known', xlabel='u [px]', ylabel='v [px]', ylim=(camera.height, 0))
    spread.plot(residuals[:, 0], residuals[:, 1], '.', markersize=2)
    spread.set(title='residuals', xlabel='u [px]', ylabel='v [px]', aspect='equal')
    _draw_bars(bars, [view.name for view in used], calibration.residuals)
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=90)
    code = base64.b64encode(stream.getvalue()).decode()
    return f'<img alt="residuals, coverage and error over the image" src="data:image/png;base64,{code}">'


def _draw_bars(axes: Any, names: Sequence[str], residuals: Sequence[FloatArray]) -> None:
    rms = [float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))) for residual in residuals]
    axes.bar(range(len(rms)), rms)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set(title='rms of each view', ylabel='[px]')


def _draw_field(axes: Any, calibration: Calibration, pixels: FloatArray, residuals: FloatArray) -> None:
    """Mean residual of each cell as an arrow: what the model does not explain."""
    camera = calibration.camera
    column = np.clip(pixels[:, 0] * GRID[0] / camera.width, 0, GRID[0] - 1).astype(np.int64)
    row = np.clip(pixels[:, 1] * GRID[1] / camera.height, 0, GRID[1] - 1).astype(np.int64)
    cell = row * GRID[0] + column
    count = np.bincount(cell, minlength=GRID[0] * GRID[1])
    filled = np.flatnonzero(count >= 3)
    u, v, du, dv = (
        np.bincount(cell, weights=values, minlength=GRID[0] * GRID[1])[filled] / count[filled]
        for values in (*pixels.T, *residuals.T)
    )
    arrows = axes.quiver(u, v, du, dv, angles='xy')
    axes.quiverkey(arrows, 0.85, 1.03, 0.02, '0.02 px', labelpos='E')
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), title='mean residual', xlabel='u [px]', ylabel='v [px]')
