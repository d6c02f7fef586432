"""Several runs side by side, with the measures of evo, computed by evo (M. Grupp, github.com/MichaelGrupp/evo).

As in ``evo_ape`` and ``evo_rpe``, poses are paired with the nearest pose of the truth within 10 ms. The absolute pose
error is that of the translation, without and with rigid alignment (``--align``), and of the rotation angle; the
relative pose error is over 1 m of path (``--delta 1 --delta_unit m``).
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from evo.core import metrics as evo_metrics
from evo.core import sync
from evo.core.filters import FilterException
from evo.core.geometry import GeometryException
from evo.core.trajectory import PoseTrajectory3D
import numpy as np

from thermal_fiducial.core.types import SECOND_NS
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.writing import write_text
from thermal_fiducial.report.evaluation import Evaluation
from thermal_fiducial.report.metrics import PAUSE_NS
from thermal_fiducial.report.page import evaluate_run
from thermal_fiducial.report.text_table import number, Table
from thermal_fiducial.report.trajectory import Trajectory

#: evo's own default [s].
MOST_APART_S = 0.01
_STATISTICS = ('rmse', 'mean', 'median', 'std', 'min', 'max')
_COLOURS = ('#3b82f6', '#ef4444', '#22c55e', '#f59e0b', '#a855f7', '#14b8a6', '#ec4899', '#84cc16')
#: Measures of this package: name, unit, path in the numbers of a run.
_OWN = (
    ('jitter over 1/30 s, position, rms', 'mm', ('fused', 'jitter', 'position_mm')),
    ('NEES of the pose (consistent: 1)', 'per d.o.f.', ('fused', 'consistency', 'pose_nees_per_dof')),
    ('position error as available, rms', 'mm', ('as_available', 'in_view', 'fused', 'position_rms_mm')),
    ('map, position error, rms', 'mm', ('map', 'position_rms_mm')),
    ('camera poses compared', 'count', ('innovations', 'poses')),
    ('of these, refused', 'count', ('innovations', 'refused')),
    ('NIS (consistent: 1)', 'per d.o.f.', ('innovations', 'nis_per_dof')),
    ('rate', 'Hz', ('fused', 'rate_hz')),
    ('longest pause', 'ms', ('fused', 'longest_pause_ms')),
    ('path length', 'm', ('fused', 'path_length_m')),
    ('latency, IMU to pose, 99 %', 'ms', ('latency', 'imu_to_pose', 'p99_ms')),
)


@dataclass(frozen=True)
class Comparison:
    """Names of the runs and their measures."""

    names: tuple[str, ...]
    evaluations: tuple[Evaluation, ...]
    #: run name to the measures of evo and of this package
    numbers: dict[str, dict[str, Any]]

    @property
    def tables(self) -> list[Table]:
        """Measures as rows, runs as columns."""
        heads = ('', 'unit', *self.names)
        made = [Table(title, heads, self._rows(part, unit)) for part, (title, unit) in _EVO.items()]
        own = [(name, unit, *(number(_at(self.numbers[run], keys)) for run in self.names)) for name, unit, keys in _OWN]
        made.append(Table('Of the filter', heads, [row for row in own if any(cell != '–' for cell in row[2:])]))
        return [table for table in made if table.rows]

    @property
    def note(self) -> str:
        """Runs without errors, and why; empty if all have them."""
        without = [name for name in self.names if not self.numbers[name]['evo']]
        if not without:
            return ''
        where = '--truth names one for all, truth.tum in a run folder one for that run'
        return f'No errors of {", ".join(without)}: no ground truth at their stamps ({where}).'

    def _rows(self, part: str, unit: str) -> list[tuple[str, ...]]:
        every = [self.numbers[name]['evo'].get(part, {}) for name in self.names]
        if not any(every):
            return []
        return [(key, unit, *(number(values.get(key), 4) for values in every)) for key in _STATISTICS]

    def write(self, path: Path) -> None:
        """Write the comparison as a self-contained page."""
        from thermal_fiducial.report.html import Page, render, Section

        wide = Section('measures', 'Measures', tables=tuple(self.tables))
        charts = Section('errors', 'Errors over time', charts=tuple(_charts(self)), note=self.note)
        lead = f'Fused poses of {len(self.names)} runs, with the conventions of evo.'
        write_text(path, render(Page(' · '.join(self.names), lead, (charts, wide), footer=_FOOTER)))


_EVO = {
    'ape_translation': ('APE, translation, not aligned', 'mm'),
    'ape_translation_aligned': ('APE, translation, after rigid alignment', 'mm'),
    'ape_rotation': ('APE, rotation angle', 'deg'),
    'rpe_translation': ('RPE, translation, over 1 m', 'mm'),
    'rpe_rotation': ('RPE, rotation angle, over 1 m', 'deg'),
}
_FOOTER = (
    'APE and RPE are computed by evo: poses paired with the nearest true one within 10 ms. The own report of a run '
    'interpolates the truth instead, which makes a difference where stamps differ.'
)


def compare(folders: Sequence[Path], truth: Path | None = None) -> Comparison:
    """Evaluate runs and put them beside each other.

    Raises
    ------
    InputError
        As :func:`evaluate_run`; or fewer than two runs.
    """
    if len(folders) < 2:
        raise InputError('--compare wants two runs or more')
    evaluations, numbers = [], {}
    names = _names(folders)
    for name, folder in zip(names, folders, strict=True):
        evaluation, measured = evaluate_run(folder, truth)
        evaluations.append(evaluation)
        run = evaluation.run
        numbers[name] = measured | {'evo': {} if run.truth is None else evo_numbers(run.fused, run.truth)}
    return Comparison(names, tuple(evaluations), numbers)


def _names(folders: Sequence[Path]) -> tuple[str, ...]:
    """Names of the folders, with as many parent folders as distinguish them."""
    paths = [folder.resolve() for folder in folders]
    if len(set(paths)) < len(paths):
        raise InputError('--compare: a run is given twice')
    return tuple(_shortest_name(path, [other for other in paths if other != path]) for path in paths)


def _shortest_name(path: Path, others: Sequence[Path]) -> str:
    """The last parts of ``path`` that none of the ``others`` ends in."""
    tails = (path.parts[-count:] for count in range(1, len(path.parts) + 1))
    tail = next(tail for tail in tails if all(other.parts[-len(tail) :] != tail for other in others))
    return str(Path(*tail))


def evo_numbers(estimate: Trajectory, truth: Trajectory) -> dict[str, dict[str, float]]:
    """Statistics of evo's errors [mm, deg]; empty if no poses can be paired.

    Parameters
    ----------
    estimate, truth : in one frame
    """
    if not (len(estimate) and len(truth)):
        return {}
    try:
        true, found = sync.associate_trajectories(_of_evo(truth), _of_evo(estimate), max_diff=MOST_APART_S)
    except sync.SyncException:
        return {}
    translation, angle = evo_metrics.PoseRelation.translation_part, evo_metrics.PoseRelation.rotation_angle_deg
    result = {
        'ape_translation': _statistics(evo_metrics.APE(translation), true, found, 1e3),
        'ape_rotation': _statistics(evo_metrics.APE(angle), true, found, 1.0),
    }
    aligned = PoseTrajectory3D(poses_se3=list(found.poses_se3), timestamps=found.timestamps)
    with suppress(GeometryException):  # poses in a point or on a line
        aligned.align(true)
        result['ape_translation_aligned'] = _statistics(evo_metrics.APE(translation), true, aligned, 1e3)
    for name, relation, scale in (('rpe_translation', translation, 1e3), ('rpe_rotation', angle, 1.0)):
        try:
            result[name] = _statistics(evo_metrics.RPE(relation, 1.0, evo_metrics.Unit.meters), true, found, scale)
        except FilterException:  # less than a metre of path
            continue
    return result


def _of_evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.T_map_body), timestamps=trajectory.stamps_ns / SECOND_NS)


def _statistics(metric: Any, truth: PoseTrajectory3D, estimate: PoseTrajectory3D, scale: float) -> dict[str, float]:
    metric.process_data((truth, estimate))
    return {name: scale * float(value) for name, value in metric.get_all_statistics().items() if name in _STATISTICS}


def _at(numbers: dict[str, Any], keys: Sequence[str]) -> Any:
    value: Any = numbers
    for key in keys:
        value = value.get(key) if isinstance(value, dict) else None
    return value


def _charts(comparison: Comparison) -> list[Any]:
    from thermal_fiducial.report.stacked_plots import Chart, TimePlots

    plots = TimePlots(('position [mm]', 'attitude [deg]'))
    shown = False
    for index, (name, evaluation) in enumerate(zip(comparison.names, comparison.evaluations, strict=True)):
        e = evaluation.fused_errors
        if e is None or not len(e):
            continue
        shown, colour = True, _COLOURS[index % len(_COLOURS)]
        t, pause = evaluation.seconds(e.stamps_ns), PAUSE_NS / SECOND_NS
        plots.line(1, t, np.maximum(1e3 * e.position_m, 0.01), name, colour, pause=pause)
        plots.line(2, t, np.maximum(e.attitude_deg, 1e-4), name, colour, pause=pause)
    plots.make_logarithmic()
    text = 'Fused poses, each at its own stamp, from the beginning of each run.'
    return [Chart('errors', 'Error against ground truth', text, plots.figure, wide=True)] if shown else []
