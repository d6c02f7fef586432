"""Measures of a run folder, and its page."""

import json
from pathlib import Path
from typing import Any

from thermal_fiducial.errors import InputError
from thermal_fiducial.report.evaluation import evaluate, Evaluation
from thermal_fiducial.report.run_folder import read_run, SUMMARY

__all__ = ['Evaluation', 'evaluate_run', 'write_report']

REPORT = 'report.html'


def evaluate_run(run_dir: Path, truth: Path | None = None) -> tuple[Evaluation, dict[str, Any]]:
    """Measure a run folder and write the measures into its summary, under ``evaluation``.

    Parameters
    ----------
    run_dir : the run folder
    truth : TUM file or bag with ground truth; default: the folder's own, where it has one

    Raises
    ------
    InputError
        No run folder, a broken file in it, or truth that doesn't cover the run.
    """
    evaluation = evaluate(read_run(Path(run_dir), truth))
    run = evaluation.run
    if (
        run.truth is not None
        and len(run.fused)
        and evaluation.fused_errors is not None
        and not len(evaluation.fused_errors)
    ):
        raise InputError(f'{truth}: ground truth and run {run_dir} have no time in common')
    numbers = evaluation.numbers()
    text = json.dumps(run.summary | {'evaluation': numbers}, indent=2)
    _write(Path(run_dir) / SUMMARY, text + '\n')
    return evaluation, numbers


def write_report(run_dir: Path, truth: Path | None = None) -> Path:
    """Measure a run folder and write ``report.html`` into it; the path of that page.

    Raises
    ------
    InputError
        As :func:`evaluate_run`; or without the libraries that draw (extra ``tools``).
    """
    return write_page(*evaluate_run(run_dir, truth))


def write_page(evaluation: Evaluation, numbers: dict[str, Any]) -> Path:
    """Write ``report.html`` of a run that has been measured."""
    try:
        from thermal_fiducial.report.html import render
    except ImportError as error:
        raise InputError(f'the report needs {error.name}: install the extra "tools"') from None
    path = evaluation.run.path / REPORT
    _write(path, render(evaluation, numbers))
    return path


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding='utf-8')
    except OSError as error:
        raise InputError(f'{path}: {error.strerror}') from None
