"""Report of a calibration: numbers and pictures in one HTML file."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
import io
from pathlib import Path
from typing import Any

import numpy as np

from thermal_fiducial.calibration.intrinsics import Calibration
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.types import FloatArray, IntArray
from thermal_fiducial.errors import InputError

#: Cells of the coverage picture, columns and rows.
GRID = (16, 12)
NAMES = ('fx', 'fy', 'cx', 'cy')


def coverage(pixels: FloatArray, width: int, height: int) -> IntArray:
    """Number of points (N, 2) in each cell (rows, columns) of the image."""
    edges = np.linspace(-0.5, height - 0.5, GRID[1] + 1), np.linspace(-0.5, width - 0.5, GRID[0] + 1)
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], bins=edges)
    return counts.astype(np.int64)


def parameter_rows(calibration: Calibration) -> list[tuple[str, float, float]]:
    """Name, value and standard deviation of every intrinsic parameter."""
    camera = calibration.camera
    values = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *camera.D]
    names = [*NAMES, *(f'D[{index}]' for index in range(len(camera.D)))]
    return [(name, float(value), float(s)) for name, value, s in zip(names, values, calibration.sigmas, strict=True)]


def write_report(
    path: Path,
    calibration: Calibration,
    sightings: Sequence[Sighting],
    names: Sequence[str],
    errors: Mapping[str, float],
) -> None:
    """Write the report.

    Parameters
    ----------
    sightings, names : all views that the calibration was given
    errors : held-out error of each model [px]

    Raises
    ------
    InputError
        The file can't be written.
    """
    used = [sightings[index] for index in calibration.views.tolist()]
    pixels = np.concatenate([sighting.pixels for sighting in used])
    camera = calibration.camera
    head = (
        f'<p>{escape(camera.model)}, {camera.width} x {camera.height}; {len(used)} views used, '
        f'{len(calibration.dropped)} dropped; re-projection rms {calibration.rms_px:.4f} px, '
        f'of views not fitted {calibration.held_out_px:.4f} px.</p>'
    )
    parameters = _table(
        ('parameter', 'value', 'standard deviation'),
        [(name, f'{value:.6g}', f'{sigma:.2g}') for name, value, sigma in parameter_rows(calibration)],
    )
    models = _table(('model', 'held-out rms px'), [(model, f'{error:.4f}') for model, error in errors.items()])
    dropped = ', '.join(names[index] for index in calibration.dropped) or 'none'
    page = (
        '<!doctype html><html><head><meta charset="utf-8"><title>Calibration</title><style>'
        'body{font-family:sans-serif;max-width:70em;margin:2em auto}td,th{padding:.2em .8em;text-align:right}</style>'
        f'</head><body><h1>Calibration</h1>{head}{parameters}<h2>Models</h2>{models}'
        f'<p>Dropped views: {escape(dropped)}.</p>{_picture(calibration, pixels)}</body></html>'
    )
    try:
        path.write_text(page, encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    cells = ''.join('<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>' for row in rows)
    return f'<table><tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}</tr>{cells}</table>'


def _picture(calibration: Calibration, pixels: FloatArray) -> str:
    """Residual field, coverage and rms a view as an embedded PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 9), layout='constrained')
    FigureCanvasAgg(figure)
    field, cover, spread, views = figure.subplots(2, 2).ravel()
    residuals = np.concatenate(calibration.residuals)
    _draw_field(field, calibration, pixels, residuals)
    camera = calibration.camera
    shown = cover.imshow(coverage(pixels, camera.width, camera.height), extent=(0, camera.width, camera.height, 0))
    figure.colorbar(shown, ax=cover, label='points')
    cover.set(title='coverage', xlabel='u [px]', ylabel='v [px]')
    spread.plot(residuals[:, 0], residuals[:, 1], '.', markersize=2)
    spread.set(title='residuals', xlabel='u [px]', ylabel='v [px]', aspect='equal')
    rms = [float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))) for residual in calibration.residuals]
    views.bar(range(len(rms)), rms)
    views.set(title='rms of each view', xlabel='view', ylabel='[px]')
    stream = io.BytesIO()
    figure.savefig(stream, format='png', dpi=90)
    return (
        f'<img alt="residuals and coverage" src="data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}">'
    )


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
