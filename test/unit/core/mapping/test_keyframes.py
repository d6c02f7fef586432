"""The store of keyframes: bounded, spread out, moved as one."""

from dataclasses import replace
import time

import numpy as np
from support.walls import flight

from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.keyframes import Keyframe, KeyframeStore
from thermal_fiducial.core.mapping.map_data import MarkerMap


def frame(stamp, T):
    return Keyframe(stamp, T, np.array([1, 2]), np.zeros((2, 4, 2)), np.zeros((2, 4, 2, 2)))


def test_the_budget_is_kept_however_long_the_flight():
    store = KeyframeStore(100, MarkerMap())
    for k in range(5000):
        store.add(frame(k, flight(k / 30)))
        assert len(store.frames) <= 100
    assert len(store.frames) > 60


def test_rare_views_outlive_common_ones():
    store = KeyframeStore(50, MarkerMap())
    rare = transform(np.eye(3), [10.0, 0.0, 0.0])
    store.add(frame(0, rare))
    for k in range(1, 2000):
        store.add(frame(k, transform(np.eye(3), [0.0, 0.0, 1e-4 * (k % 7)])))
    assert 0 in store.frames


def test_frames_on_all_sides_of_the_origin_are_thinned_as_soon_as_others():
    """Cells with a corner in the origin never become fewer than its octants, however coarse they are."""
    rng = np.random.default_rng(0)
    turns, places = so3_exp(rng.normal(size=(300, 3))), rng.uniform(-4.0, 4.0, (300, 3))

    def seconds(origin):
        store, begun = KeyframeStore(10, MarkerMap()), time.perf_counter()
        for k in range(300):
            store.add(frame(k, transform(turns[k], places[k] + origin)))
        return time.perf_counter() - begun

    ratios = [seconds(np.zeros(3)) / seconds(np.full(3, 100.0)) for _ in range(3)]
    # As many coarser grids, 4 or 5, are tried around the origin as elsewhere; until floating point overflows, 1024.
    assert min(ratios) < 10.0


def test_bridges_are_never_dropped():
    store = KeyframeStore(20, MarkerMap())
    for k in range(500):
        store.add(replace(frame(k, np.eye(4)), bridge=k == 3))
    assert 3 in store.frames


def test_frames_that_were_not_adjusted_move_with_the_nearest():
    """After a loop is closed, its beginning and its end move differently."""
    store = KeyframeStore(10, MarkerMap())
    for k in range(6):
        store.add(frame(k, transform(np.eye(3), [k, 0.0, 0.0])))
    early, late = transform(np.eye(3), [0.0, 0.1, 0.0]), transform(so3_exp([0.0, 0.0, 0.1]), [0.5, 0.0, 0.0])
    moves = {0: early, 1: early, 2: early, 3: late, 4: late, 5: late}
    moved = store.move({k: moves[k] @ store.frames[k].T_map_camera for k in (1, 4)})
    for k, T in moves.items():
        np.testing.assert_allclose(moved.at(k), T, atol=1e-12)
        np.testing.assert_allclose(store.frames[k].T_map_camera, T @ transform(np.eye(3), [k, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_allclose(moved.at(1000), late, atol=1e-12)
    np.testing.assert_array_equal(store.move({99: early}).at(3), np.eye(4))


def test_a_frame_of_a_repeated_stamp_does_not_move_the_map():
    """A simulation begins once more while an adjustment is under way: the robot has moved, the map has not."""
    store = KeyframeStore(10, MarkerMap())
    store.add(frame(0, np.eye(4)))
    store.add(frame(0, transform(np.eye(3), [1.0, 0.0, 0.0])))
    shift = transform(np.eye(3), [0.0, 0.001, 0.0])
    np.testing.assert_allclose(store.move({0: shift}).at(0), shift, atol=1e-12)


def test_rotations_stay_rotations_however_often_the_map_moves():
    """Rounding errors must not double from one adjustment to the next: in half an hour there are hundreds."""
    rng = np.random.default_rng(0)
    store = KeyframeStore(10, MarkerMap())
    for k in range(6):
        store.add(frame(k, transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))))
    for _ in range(300):
        stamps = rng.choice(6, 4, replace=False).tolist()
        steps = {k: transform(so3_exp(0.01 * rng.normal(size=3)), 0.01 * rng.normal(size=3)) for k in stamps}
        moved = store.move({k: step @ store.frames[k].T_map_camera for k, step in steps.items()})
        R = np.stack([f.T_map_camera[:3, :3] for f in store.frames.values()] + [moved.at(3)[:3, :3]])
        np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
