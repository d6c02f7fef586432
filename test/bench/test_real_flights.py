"""Real IMUs before real markers: the fused pose beside that of the markers alone, and what it claims."""

import pytest
from support import corner_runs, real_flights
from support.corner_runs import coast, fly
from support.sim_flights import simulated

pytestmark = pytest.mark.usefixtures('real_data')
#: Seconds without frames, and what the error at their end should be at most [cm].
GAPS = {1.0: 5.0, 2.0: 15.0}


def cells(run):
    """Of a run: fused after the update and markers alone, at the frames' instants, then what became of the poses."""
    fused, markers = run.updated.score(run.flight), run.markers.score(run.flight)
    published = run.published.score(run.flight)
    return [
        run.flight.name,
        f'{markers.rms_mm:.1f} ({markers.median_mm:.1f}) mm, {markers.rms_deg:.2f} deg',
        f'{fused.rms_mm:.1f} ({fused.median_mm:.1f}) mm, {fused.rms_deg:.2f} deg',
        f'{published.rms_mm:.1f}, {published.peak_mm:.0f} mm',
        f'{fused.claimed_mm:.1f} mm, {fused.nees:.2f}, {markers.nees:.2f}',
        f'{corner_runs.jitter_mm(run.updated) / corner_runs.jitter_mm(run.markers):.2f}',
        f'{run.resets}, {100 * run.refused:.1f} %',
    ]


HEAD = [
    'flight',
    'markers alone: rms (median)',
    'fused, after the update',
    'published 30 ms late: rms, peak',
    'claimed, NEES per d.o.f., of markers',
    'jitter, fused over markers',
    'resets, refused',
]


def test_fused_beside_markers_alone(benchmark, write_recorded):
    """On maps taken for exact; over the carpet that of an adjustment of the same flight's corners."""
    boards = [real_flights.april_board(camera) for camera in ('cam0', 'cam1')]
    benchmark.pedantic(fly, args=(boards[0],), rounds=1)
    flights = [*boards, *map(real_flights.carpet, real_flights.CARPETS)]
    write_recorded('real_flights', [HEAD, *(cells(fly(flight)) for flight in flights)])


def test_simulated_flights_made_like_them(benchmark, write_recorded):
    """What the simulator says in the recordings' place: where it is kinder, it has to be made more like them."""
    flights = [simulated(name, seed) for name in ('april', 'cheap_imu') for seed in range(3)]
    benchmark.pedantic(fly, args=(flights[-1],), rounds=1)
    write_recorded('flights_like_real', [HEAD, *(cells(fly(flight)) for flight in flights)])


def test_maps_of_the_carpet(benchmark, write_recorded):
    """A map of one flight by our mapper against an adjustment of its corners, and the other flight on it."""
    flights = [real_flights.carpet(name) for name in real_flights.CARPETS]
    benchmark.pedantic(fly, args=(flights[0],), rounds=1)
    rows = [['map from', 'markers', 'against batch adjustment', *HEAD]]
    for flight, other in (flights, flights[::-1]):
        run = fly(flight, real_flights.origin_alone(), mode='mapping')
        error = real_flights.map_error_mm(run.marker_map, flight.marker_map)
        on_map = fly(other, run.marker_map)
        rows.append([flight.name, f'{len(run.marker_map.markers)}', f'{error:.1f} mm', *cells(on_map)])
    write_recorded('real_maps', rows)


def test_without_frames(benchmark, write_recorded):
    """Frames left out for a second or two, anywhere in the flight: the error at the end, and what is claimed there."""
    rows = [['flight', 'no frames for', 'goal', 'error: rms, 95 %, worst', 'within 3 sigma', 'claimed over true']]
    flights = [real_flights.april_board(camera) for camera in ('cam0', 'cam1')]
    flights += map(real_flights.carpet, real_flights.CARPETS)
    benchmark.pedantic(coast, args=(flights[0], 1.0), kwargs={'phases': 1}, rounds=1)
    for flight in flights:
        for seconds, goal in GAPS.items():
            gaps = coast(flight, seconds)
            rows.append(
                [
                    flight.name,
                    f'{seconds:.0f} s',
                    f'{goal:.0f} cm',
                    f'{100 * corner_runs.rms(gaps.errors):.1f}, {100 * gaps.percentile(95):.1f}, '
                    f'{100 * gaps.errors.max():.1f} cm',
                    f'{100 * gaps.covered:.0f} %',
                    f'{gaps.claimed_over_true:.2f}',
                ]
            )
    write_recorded('real_coasting', rows)
