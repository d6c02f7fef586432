"""Prints how large and how deep the package is: ``make structure``.

What one easy frame with four markers and one IMU sample pass through in :class:`Pipeline` is traced with
``sys.setprofile``, counting named functions of the package alone (no comprehensions, no lambdas, nothing of numpy or
OpenCV); of some frames and samples in a row the one in the middle counts. A frame comes later than samples of its
instant, so what it passes through includes the correction of the filter. All other figures are read from the source.
"""

import ast
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
import sys
from types import CodeType, FrameType
from typing import Any

import numpy as np
from support import small_bag

from thermal_fiducial.core.measurements import ImuSample
from thermal_fiducial.core.pipeline import Pipeline, PipelineConfig
from thermal_fiducial.files.dictionary import load_dictionary

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'thermal_fiducial'
CORE = PACKAGE / 'core'

#: Until the filter follows the map and the detector the filter: 1.5 s, with 200 samples and 30 frames a second.
WARM_UP_SAMPLES = 300
TRACED_FRAMES, SAMPLES_A_FRAME = 9, 7
#: Frames come 15 ms late, by more than the clock offset is uncertain in so short a flight.
LATE = 3
#: Numbers that say nothing by themselves: halves, doubles, powers.
PLAIN = {0.0, 0.5, 1.0, 2.0, 3.0, 4.0}


@dataclass
class Trace:
    """The functions of the package that ran."""

    calls: Counter[CodeType] = field(default_factory=Counter)
    depth: int = 0

    def row(self) -> str:
        """Functions, files, depth, calls."""
        files = {code.co_filename for code in self.calls}
        return f'{len(self.calls)} / {len(files)} / {self.depth} ({sum(self.calls.values())} calls)'


def is_ours(code: CodeType) -> bool:
    """Whether it is a named function of the package."""
    return code.co_filename.startswith(str(PACKAGE)) and not code.co_name.startswith('<')


@contextmanager
def traced() -> Iterator[Trace]:
    """Trace what runs inside."""
    trace, stack = Trace(), 0

    def on_event(frame: FrameType, event: str, _: Any) -> None:
        nonlocal stack
        if event not in ('call', 'return') or not is_ours(frame.f_code):
            return
        stack += 1 if event == 'call' else -1
        if event == 'call':
            trace.calls[frame.f_code] += 1
            trace.depth = max(trace.depth, stack)

    sys.setprofile(on_event)
    try:
        yield trace
    finally:
        sys.setprofile(None)


def middle(traces: list[Trace]) -> Trace:
    """The trace with the median number of functions."""
    return sorted(traces, key=lambda trace: len(trace.calls))[len(traces) // 2]


def traces() -> tuple[Trace, Trace]:
    """Of one frame, and of one IMU sample, in flight in front of four markers of the map."""
    parameters = small_bag.PARAMETERS | {'mode': 'localization'}
    config = PipelineConfig.from_mapping(parameters)
    marker_map = small_bag.map_of(small_bag.CENTRES)
    pipeline = Pipeline(config, load_dictionary('DICT_4X4_50'), marker_map, small_bag.CAMERA)
    rng = np.random.default_rng(0)
    frames: list[Trace] = []
    samples: list[Trace] = []

    def run(action: Callable[[], object], into: list[Trace], *, warm: bool) -> None:
        with traced() as trace:
            action()
        if warm:
            into.append(trace)

    total = WARM_UP_SAMPLES + TRACED_FRAMES * SAMPLES_A_FRAME
    for k in range(total):
        stamp = small_bag.START_NS + k * 5_000_000
        values = small_bag.true_imu(k * 0.005)
        sample = ImuSample(stamp, values[:3], values[3:])
        run(lambda sample=sample: pipeline.add_imu(sample), samples, warm=k >= WARM_UP_SAMPLES)
        if k % SAMPLES_A_FRAME == LATE:
            taken = k - LATE
            counts = small_bag.frame(small_bag.true_pose(taken * 0.005), rng)
            image = small_bag.START_NS + taken * 5_000_000, counts
            run(lambda image=image: pipeline.add_image(*image), frames, warm=k >= WARM_UP_SAMPLES)
    return middle(frames), middle(samples)


def sources(folder: Path) -> list[Path]:
    """Modules below ``folder``, without ``__init__``."""
    return sorted(path for path in folder.rglob('*.py') if path.name != '__init__.py')


def lines(paths: list[Path]) -> int:
    """Lines of files, blank ones and comments included."""
    return sum(len(path.read_text().splitlines()) for path in paths)


def constants(path: Path) -> int:
    """Numbers with a decimal point that are written into a module, without those that say nothing by themselves."""
    values = [node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)]
    return sum(isinstance(value, float) and value not in PLAIN for value in values)


def repeated_names() -> list[str]:
    """Names of classes, types and modules that stand more than once in the package, were it with an underscore before.

    Types are names of a module that begin with a capital letter and are no constants.
    """
    names: Counter[str] = Counter(path.stem for path in sources(PACKAGE))
    for path in sources(PACKAGE):
        tree = ast.parse(path.read_text())
        names.update(node.name.lstrip('_') for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
        assigned = [node for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)]
        targets = [node.target if isinstance(node, ast.AnnAssign) else node.targets[0] for node in assigned]
        types = [target.id.lstrip('_') for target in targets if isinstance(target, ast.Name)]
        names.update(name for name in types if name[:1].isupper() and not name.isupper())
    return sorted(f'{name} x{count}' for name, count in names.items() if count > 1)


def main() -> None:
    """Print the table; the last two columns are where the rebuilding of the core began and what it aims at."""
    frame, sample = traces()
    core, twice = sources(CORE), repeated_names()
    rows = [
        ('functions / files / depth of an easy frame', frame.row(), '245 / 44 / 13', '120 / 25 / 8'),
        ('the same of an IMU sample', sample.row(), '48 / 12 / 12', '25 / 8 / 7'),
        ('core: lines, files', f'{lines(core)}, {len(core)}', '11.6 k, 75', '8.5 k, 55'),
        ('filter: lines', str(lines(sources(CORE / 'filter'))), '2.2 k', '1.4 k'),
        ('constants wired into the core', str(sum(map(constants, core))), '407', '136'),
        ('names that stand twice', str(len(twice)), '22', '0'),
        ('README: lines', str(lines([ROOT / 'README.md'])), '701', '150'),
    ]
    width = max(len(row[0]) for row in rows)
    print(f'{"":{width}}  {"now":30} {"began at":15} goal')
    for name, now, before, goal in rows:
        print(f'{name:{width}}  {now:30} {before:15} {goal}')
    if twice:
        print('twice:', ', '.join(twice))


if __name__ == '__main__':
    main()
