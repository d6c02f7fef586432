"""What a frame costs the mapper in a large map, and what an hour of mapping leaves in memory."""

from pathlib import Path
import time

import numpy as np
from support.crowds import crowd, frames, mapped, SIZE
from support.jobs import Elsewhere
from support.walls import CAMERA, flight, FRAME_NS, see, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.mapping.bundle_adjustment import refine
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.mapping.mapper import MarkerMapper

ROUNDS, FRAMES = 7, 60
#: Frames of an hour, five a second: memory depends on what is kept, not on how fast it comes.
HOUR, INTERVAL_NS = 18_000, 200_000_000


def milliseconds(marker_map, seen, mode):
    """Least time of a frame, of the processor."""
    m = MarkerMapper(MarkerMapperConfig(marker_size=SIZE, mode=mode), marker_map)
    took = []
    for k, rows in enumerate(seen):
        start = time.process_time()
        m.process((k + 1) * FRAME_NS, rows, CAMERA)
        took.append(1e3 * (time.process_time() - start))
    return min(took)


def resident_mb(process='self'):
    """Memory of a process [MB]."""
    return int(Path(f'/proc/{process}/statm').read_text().split()[1]) * 4096 / 1e6


def an_hour(elsewhere):
    """Keyframes, refinements, largest error of a marker [mm], and the most memory [MB] in 6 minutes and in an hour.

    The most, as what an instant has freed is chance. As in the node, refinements run in another process: what their
    arrays leave of the heap is not the mapper's memory.

    Parameters
    ----------
    elsewhere : that process, which calls ``refine``
    """
    rng = np.random.default_rng(0)
    poses = wall(rng)
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, 0.3, True, poses[0])}))
    seen = [see(flight(k / 5), poses, 0.05, rng) for k in range(300)]
    processes, memory, most = ('self', elsewhere.pid), [], np.zeros(2)
    for k in range(HOUR):
        stamp = (k + 1) * INTERVAL_NS
        m.process(stamp, seen[k % len(seen)], CAMERA)
        if m.refinement_due(stamp):
            refinement = elsewhere(m.snapshot())
            assert refinement is not None or len(m.map.markers) == 1
            if refinement is not None:
                m.apply(refinement)
            most = np.maximum(most, [resident_mb(process) for process in processes])
        if k + 1 in (HOUR // 10, HOUR):
            memory.append(most)
    errors = [np.linalg.norm(marker.T_map_marker[:3, 3] - poses[i][:3, 3]) for i, marker in m.map.markers.items()]
    return len(m.snapshot().stamps_ns), m.resets, 1e3 * max(errors), *memory


def test_scale_of_the_map(benchmark, write_table):
    ten, twenty = crowd(10), crowd(20)
    few, many = mapped(ten, 10), mapped(twenty, 1000)
    shown = frames(ten, FRAMES), frames(twenty, FRAMES)
    ratios = []
    rows = [('', '10 markers, all in view', '1000 markers, 20 in view', 'ratio (goal 1.2)')]
    for mode in ('mapping', 'localization'):
        # Rounds alternate, so that both have the machine at its best once.
        pairs = [(milliseconds(few, shown[0], mode), milliseconds(many, shown[1], mode)) for _ in range(ROUNDS)]
        small, large = np.min(pairs, axis=0)
        rows.append((f'time of a frame, {mode}', f'{small:.2f} ms', f'{large:.2f} ms', f'{large / small:.2f}'))
        ratios.append(large / small)
    with Elsewhere(refine) as elsewhere:
        kept, refinements, error, early, late = benchmark.pedantic(an_hour, args=(elsewhere,), rounds=1)
    what = f'an hour of mapping: {kept} keyframes, {refinements} refinements, largest error {error:.1f} mm'
    for row, before, after in zip((what, 'process of the refinements'), early, late, strict=True):
        rows.append((row, f'{before:.0f} MB in 6 min', f'{after:.0f} MB in 60 min', ''))
    write_table('mapping', rows)
    assert max(ratios) <= 1.2
    assert late[0] < early[0] + 5.0
    assert error < 1.0
