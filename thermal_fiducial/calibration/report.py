"""Report of a calibration: numbers and pictures in one HTML file."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np

from thermal_fiducial.calibration.intrinsics import Calibration
from thermal_fiducial.calibration.lens_check import ImageError
from thermal_fiducial.calibration.plots import drawings
from thermal_fiducial.calibration.targets import Sighting
from thermal_fiducial.core.types import Counts, FloatArray, Gray
from thermal_fiducial.files.writing import write_text

# Drawn length of a view's largest residual, relative to the picture's width; width of the pictures [px].
_ARROW, _WIDTH = 0.06, 480
_STYLE = """
:root{color-scheme:light dark;--line:#8888}
body{font-family:system-ui,sans-serif;max-width:75em;margin:1em auto;padding:0 1em;line-height:1.4}
table{border-collapse:collapse;display:block;overflow-x:auto}
td,th{padding:.2em .8em;text-align:right;border-bottom:1px solid var(--line)}
td:first-child,th:first-child,.words td,.words th{text-align:left}
@media (max-width:32em){table{font-size:.88em}td,th{padding:.2em .35em}}
.views,.plots{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,20em),1fr));gap:1em}
.plots{grid-template-columns:repeat(auto-fit,minmax(min(100%,28em),1fr));margin:1em 0}
figure{margin:0}figcaption{font-size:.9em;overflow-wrap:anywhere}
svg{width:100%;height:auto}.views svg{background:#ddd}
.wide{grid-column:1/-1;overflow-x:auto}.wide svg{min-width:52em}
"""


@dataclass(frozen=True)
class BoardView:
    """A frame that shows the board.

    Parameters
    ----------
    name : of its file, or its number in the bag
    sighting : the points
    counts : the frame; None for points from a file
    """

    name: str
    sighting: Sighting
    counts: Counts | Gray | None = None


@dataclass(frozen=True)
class LeftOut:
    """A frame that is no view.

    Parameters
    ----------
    name : as of a :class:`BoardView`
    reason : why it is none
    counts : the frame; None where it is not shown
    """

    name: str
    reason: str
    counts: Counts | Gray | None = None


def write_report(
    path: Path,
    calibration: Calibration,
    views: Sequence[BoardView],
    fits: Mapping[str, Calibration],
    error: ImageError,
    unusable: Sequence[LeftOut] = (),
) -> None:
    """Write the report.

    Parameters
    ----------
    views : all input views
    fits : the best of each model
    unusable : the frames without a sighting

    Raises
    ------
    InputError
        The file can't be written.
    """
    dropped = [LeftOut(views[index].name, 'fits far worse than the other views') for index in calibration.dropped]
    body = (
        f'{_overview(calibration, error)}{_numbers(calibration, fits)}{_drawings(calibration, views, error)}'
        f'{_left_out([*dropped, *unusable])}<h2>Views</h2>{_view_figures(calibration, views)}'
    )
    write_text(path, _page('Calibration', body))


def write_refusal(
    path: Path, reason: str, size: tuple[int, int], views: Sequence[BoardView], unusable: Sequence[LeftOut]
) -> None:
    """Write why there is no calibration: the frames that are no views, and the views, of ``size`` (width, height).

    Raises
    ------
    InputError
        The file can't be written.
    """
    figures = [_figure(view, '', f'{len(view.sighting.pixels)} points', size) for view in views]
    body = f'<p>{escape(reason)}</p>{_left_out(unusable)}<h2>Views</h2><div class="views">{"".join(figures)}</div>'
    write_text(path, _page('Calibration refused', body))


def _page(title: str, body: str) -> str:
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>'
        f'<meta name="viewport" content="width=device-width,initial-scale=1"><style>{_STYLE}</style></head><body>'
        f'<h1>{title}</h1>{body}</body></html>'
    )


def _overview(calibration: Calibration, error: ImageError) -> str:
    camera = calibration.camera
    held_out, sigma = calibration.held_out_px
    return (
        f'<p><b>{escape(calibration.lens_name())}</b>, {camera.width} x {camera.height} px; {len(calibration.views)} '
        f'views used, {len(calibration.dropped)} dropped; re-projection rms {calibration.rms_px:.4f} px, of views that '
        f'were not fitted {held_out:.4f} &plusmn; {sigma:.4f} px.</p><p>{error.sentence().capitalize()}. '
        f'{calibration.board.sentence().capitalize()}.</p>'
    )


def _numbers(calibration: Calibration, fits: Mapping[str, Calibration]) -> str:
    parameters = [
        (name, f'{value:.6g}', f'{sigma:.2g}', 'px' if name in ('fx', 'fy', 'cx', 'cy') else '')
        for name, value, sigma in calibration.parameter_rows()
    ]
    lenses = [
        (fit.lens_name(), f'{fit.held_out_px[0]:.4f}', f'{fit.held_out_px[1]:.4f}', f'{fit.rms_px:.4f}')
        for fit in fits.values()
    ]
    return (
        _table(('parameter', 'value', 'standard deviation', 'unit'), parameters)
        + '<p>A coefficient of exactly 0 was not determined by these views; its standard deviation says what it may be.'
        + '</p><h2>Models</h2>'
        + _table(('model', 'held-out rms [px]', 'standard error [px]', 'rms [px]'), lenses)
    )


def _drawings(calibration: Calibration, views: Sequence[BoardView], error: ImageError) -> str:
    used = [views[index] for index in calibration.views.tolist()]
    pixels = np.concatenate([view.sighting.pixels for view in used])
    size = calibration.camera.width, calibration.camera.height
    names = [view.name for view in used]
    return drawings(size, pixels, calibration.residuals, names, error, calibration.board)


def _left_out(frames: Sequence[LeftOut]) -> str:
    if not frames:
        return '<h2>Not used</h2><p>Every frame was used.</p>'
    figures = [
        f'<figure>{_drawn(frame.counts, frame.counts.shape[::-1], "")}'
        f'<figcaption>{escape(f"{frame.name}: {frame.reason}")}</figcaption></figure>'
        for frame in frames
        if frame.counts is not None
    ]
    rows = [(frame.name, frame.reason) for frame in frames]
    table = _table(('frame', 'reason'), rows, 'words')
    return f'<h2>Not used</h2>{table}<div class="views">{"".join(figures)}</div>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], kind: str = 'numbers') -> str:
    cells = ''.join('<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>' for row in rows)
    return f'<table class="{kind}"><tr>{"".join(f"<th>{escape(cell)}</th>" for cell in head)}</tr>{cells}</table>'


# --- each view ----------------------------------------------------------------------------------------


def _view_figures(calibration: Calibration, views: Sequence[BoardView]) -> str:
    """Every view with its points, and residuals as enlarged lines."""
    every = np.concatenate(calibration.residuals)
    longest = float(np.percentile(np.linalg.norm(every, axis=1), 99.0))
    enlarged = _ARROW * calibration.camera.width / max(longest, 1e-6)
    size = calibration.camera.width, calibration.camera.height
    figures = [
        _view_figure(views[index], residual, enlarged, size)
        for index, residual in zip(calibration.views.tolist(), calibration.residuals, strict=True)
    ]
    figures += [
        _figure(views[index], '', f'{len(views[index].sighting.pixels)} points, not used', size)
        for index in calibration.dropped
    ]
    text = f'<p>Residuals, measured minus predicted, are drawn {enlarged:.0f} times as long as they are.</p>'
    return f'{text}<div class="views">{"".join(figures)}</div>'


def _view_figure(view: BoardView, residual: FloatArray, enlarged: float, size: tuple[int, int]) -> str:
    rms = float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))
    worst = float(np.linalg.norm(residual, axis=1).max())
    lines = ''.join(
        f'<path d="M{u:.1f} {v:.1f}l{du:.1f} {dv:.1f}"/>'
        for (u, v), (du, dv) in zip(view.sighting.pixels.tolist(), (enlarged * residual).tolist(), strict=True)
    )
    caption = f'{len(residual)} points, rms {rms:.3f} px, largest {worst:.2f} px'
    return _figure(view, lines, caption, size)


def _figure(view: BoardView, lines: str, caption: str, size: tuple[int, int]) -> str:
    """A view with its points, and ``lines`` from them."""
    radius = size[0] / 200.0
    points = ''.join(f'<circle cx="{u:.1f}" cy="{v:.1f}" r="{radius:.1f}"/>' for u, v in view.sighting.pixels.tolist())
    marks = f'<g fill="none" stroke="#e6005c" stroke-width="{0.4 * radius:.1f}">{points}{lines}</g>'
    return f'<figure>{_drawn(view.counts, size, marks)}<figcaption>{escape(view.name)}: {caption}</figcaption></figure>'


def _drawn(counts: Counts | Gray | None, size: tuple[int, ...], marks: str) -> str:
    """A frame of ``size`` (width, height) with ``marks`` over it."""
    width, height = size
    thumbnail = '' if counts is None else _thumbnail(counts)
    return f'<svg viewBox="-0.5 -0.5 {width} {height}" role="img">{thumbnail}{marks}</svg>'


def _thumbnail(counts: Counts | Gray) -> str:
    low, high = np.percentile(counts, (0.5, 99.5))
    shown = np.clip((counts - low) * (255.0 / max(high - low, 1.0)), 0, 255).astype(np.uint8)
    height, width = shown.shape
    small = cv2.resize(shown, (min(width, _WIDTH), round(height * min(width, _WIDTH) / width)))
    code = base64.b64encode(cv2.imencode('.jpg', small, [cv2.IMWRITE_JPEG_QUALITY, 70])[1].tobytes()).decode()
    return f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="data:image/jpeg;base64,{code}"/>'
