"""Measures of a run folder, and its page."""

import json
from pathlib import Path
from typing import Any

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.packages import is_installed, remedy
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.writing import write_text
from thermal_fiducial.report.evaluation import evaluate, Evaluation
from thermal_fiducial.report.metrics import Errors, other_unit, TRUTH_HOLE_NS
from thermal_fiducial.report.run_folder import read_run, SUMMARY
from thermal_fiducial.report.trajectory import Trajectory

__all__ = ['Evaluation', 'evaluate_run', 'write_page']

REPORT, VIDEO = 'report.html', 'flight.mp4'


def require_packages(*, tables: bool = False) -> None:
    """Check for the packages of the report (and of ``tables`` on the terminal) before minutes of work.

    Raises
    ------
    InputError
        A package is missing; the message names it.
    """
    needed = ('jinja2', 'plotly', *(('rich',) if tables else ()))
    missing = [name for name in needed if not is_installed(name)]
    if missing:
        raise InputError(f'the report needs {", ".join(missing)}: {remedy("tools")}')


def evaluate_run(
    run_dir: Path, truth: Path | None = None, true_map: Path | None = None
) -> tuple[Evaluation, dict[str, Any]]:
    """Measure a run folder and write the measures into its summary, under ``evaluation``.

    Parameters
    ----------
    run_dir : the run folder
    truth : TUM file or bag with ground truth; default: that of the folder, if any
    true_map : the true map; default: ``map_true.yaml`` beside the truth, if any

    Raises
    ------
    InputError
        No run folder, a broken file in it, or truth that doesn't cover the run or is not in metres.
    """
    evaluation = evaluate(read_run(Path(run_dir), truth, true_map))
    run = evaluation.run
    if run.truth is not None and evaluation.fused_errors is not None and len(run.fused):
        with naming(str(run.truth_path)):
            _refuse_unusable(run.truth, evaluation.fused_errors, run.fused, run_dir)
    numbers = evaluation.numbers()
    text = json.dumps(run.summary | {'evaluation': numbers}, indent=2)
    write_text(Path(run_dir) / SUMMARY, text + '\n')
    return evaluation, numbers


def _refuse_unusable(truth: Trajectory, errors: Errors, fused: Trajectory, run_dir: Path) -> None:
    """Raise InputError for a truth without a pose at any of the run's, and for positions that are not in metres."""
    if not len(errors):
        raise InputError(_why_without_errors(truth, fused, run_dir))
    unit, count = other_unit(errors)
    if unit:
        scale = f'positions of the ground truth are {count:g} times those of run {run_dir}'
        raise InputError(f'{scale}: they seem to be in {unit}, and must be in metres')


def _why_without_errors(truth: Trajectory, fused: Trajectory, run_dir: Path) -> str:
    """Why no fused pose has a true one."""
    begins, ends = (fused.stamps_ns[at] for at in (0, -1))
    if len(truth) > 1 and truth.stamps_ns[0] <= ends and begins <= truth.stamps_ns[-1]:
        apart = f'more than {TRUTH_HOLE_NS / SECOND_NS:g} s apart in the time of run {run_dir}'
        return f'poses of the ground truth are {apart}, and none is taken from between them'
    spans = f'{_span(truth)}, the run is {_span(fused)}'
    return f'ground truth and run {run_dir} have no time in common; it is {spans}'


def _span(trajectory: Trajectory) -> str:
    """When a trajectory begins and ends: another time base shows."""
    if not len(trajectory):
        return 'empty'
    begin, end = (float(trajectory.stamps_ns[at]) / SECOND_NS for at in (0, -1))
    return f'from {begin:.1f} to {end:.1f} s'


def write_page(evaluation: Evaluation, numbers: dict[str, Any], bag: Path | None = None) -> Path:
    """Write ``report.html`` of a measured run, with frames of ``bag`` (default: the replayed one); returns its path.

    Raises
    ------
    InputError
        The file cannot be written, the plot libraries (extra ``tools``) are missing, or the bag is of another flight.
    """
    require_packages()
    from thermal_fiducial.report.frames import strip
    from thermal_fiducial.report.html import render, report_page

    run = evaluation.run
    video = VIDEO if (run.path / VIDEO).is_file() else ''
    path = run.path / REPORT
    write_text(path, render(report_page(evaluation, numbers, strip(run, bag), video)))
    return path
