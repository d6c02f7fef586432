"""What a frame costs the mapper in a large map, and what an hour of mapping leaves in memory."""

from pathlib import Path
import time

import numpy as np
from support.crowds import crowd, frames, mapped, SIZE
from support.walls import CAMERA, flight, FRAME_NS, see, wall

from thermal_fiducial.config import MarkerMapperConfig
from thermal_fiducial.core.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.map_refinement import refine
from thermal_fiducial.core.marker_map import MarkerMapper

ROUNDS, FRAMES, HOUR = 7, 60, 108_000


def milliseconds(marker_map, seen, mode):
    """Least time of a frame, of the processor."""
    m = MarkerMapper(MarkerMapperConfig(marker_size=SIZE, mode=mode), marker_map)
    took = []
    for k, rows in enumerate(seen):
        start = time.process_time()
        m.process((k + 1) * FRAME_NS, rows, CAMERA)
        took.append(1e3 * (time.process_time() - start))
    return min(took)


def resident_mb():
    """Memory of this process [MB]."""
    return int(Path('/proc/self/statm').read_text().split()[1]) * 4096 / 1e6


def an_hour():
    """Frames used, keyframes kept, and memory [MB] after 6 minutes and after an hour, joint refinements included."""
    rng = np.random.default_rng(0)
    poses = wall(rng)
    m = MarkerMapper(MarkerMapperConfig(), MarkerMap({0: MapMarker(0, 0.3, True, poses[0])}))
    seen = [see(flight(k / 30), poses, 0.05, rng) for k in range(1800)]
    refinements, memory = 0, {}
    for k in range(HOUR):
        m.process((k + 1) * FRAME_NS, seen[k % len(seen)], CAMERA)
        # One in ten of those that are due: they hold no memory, and take most of the time.
        if m.refinement_due((k + 1) * FRAME_NS):
            snapshot = m.snapshot()
            refinements += 1
            if refinements % 10 == 0:
                refinement = refine(snapshot)
                assert refinement is not None
                m.apply(refinement)
        if k + 1 in (HOUR // 10, HOUR):
            memory[k + 1] = resident_mb()
    return len(m.snapshot().keyframes), memory[HOUR // 10], memory[HOUR]


def test_scale_of_the_map(benchmark, write_table):
    ten, twenty = crowd(10), crowd(20)
    few, many = mapped(ten, 10), mapped(twenty, 1000)
    shown = frames(ten, FRAMES), frames(twenty, FRAMES)
    rows = [('', '10 markers, all in view', '1000 markers, 20 in view', 'ratio (goal 1.2)')]
    for mode in ('mapping', 'localization'):
        # Rounds alternate, so that both have the machine at its best once.
        pairs = [(milliseconds(few, shown[0], mode), milliseconds(many, shown[1], mode)) for _ in range(ROUNDS)]
        small, large = np.min(pairs, axis=0)
        rows.append((f'time of a frame, {mode}', f'{small:.2f} ms', f'{large:.2f} ms', f'{large / small:.2f}'))
        assert large <= 1.25 * small
    kept, early, late = benchmark.pedantic(an_hour, rounds=1)
    rows.append((f'an hour of mapping at 30 Hz, {kept} keyframes', f'{early:.0f} MB after 6 min', f'{late:.0f} MB', ''))
    write_table('mapping', rows)
    assert late < early + 5.0
