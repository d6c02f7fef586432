"""The store of keyframes: bounded, spread out, moved as one."""

from dataclasses import replace
import time

import numpy as np
from support.walls import CAMERA, flight

from thermal_fiducial.core.geometry.se3 import so3_exp, transform
from thermal_fiducial.core.mapping.keyframes import Keyframe, KeyframeStore
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import CameraPose, LATE, Observations


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


def mapped(poses):
    """Markers of 0.3 m by ID."""
    return {key: MapMarker(key, 0.3, False, T) for key, T in poses.items()}


def test_frames_that_were_not_adjusted_move_with_the_markers_that_they_see():
    """After a loop is closed, its beginning and its end move differently."""
    store = KeyframeStore(10, MarkerMap())
    seen = {0: [1, 2], 1: [1], 2: [2, 9], 3: [9], 4: [3, 4], 5: [4]}
    for k, ids in seen.items():
        store.add(replace(frame(k, transform(np.eye(3), [k, 0.0, 0.0])), ids=np.array(ids)))
    early, late = transform(np.eye(3), [0.0, 0.1, 0.0]), transform(so3_exp([0.0, 0.0, 0.1]), [0.5, 0.0, 0.0])
    before = mapped({key: transform(so3_exp([0.1 * key, 0.0, 0.2]), [5.0 + key, 2.0, 1.0]) for key in (1, 2, 3, 4)})
    moves = {1: early, 2: early, 3: late, 4: late}
    after = {key: replace(marker, T_map_marker=moves[key] @ marker.T_map_marker) for key, marker in before.items()}
    adjusted = {4: transform(np.eye(3), [7.0, 0.0, 0.0])}
    moved = store.move(adjusted, before, after)
    # Frame 3 sees no marker of the map: it moves with the nearest that does.
    for k, T in {0: early, 1: early, 2: early, 3: early, 5: late}.items():
        np.testing.assert_allclose(moved.at(k), T, atol=1e-12)
        np.testing.assert_allclose(store.frames[k].T_map_camera, T @ transform(np.eye(3), [k, 0.0, 0.0]), atol=1e-12)
    np.testing.assert_array_equal(store.frames[4].T_map_camera, adjusted[4])
    np.testing.assert_allclose(moved.at(1000), late, atol=1e-12)


def test_what_a_pose_is_corrected_by_is_no_displacement_of_the_map():
    """A pose that was 0.2 m off when it was kept moved another one, which was not, by as much."""
    store = KeyframeStore(10, MarkerMap())
    good = transform(so3_exp([0.3, 0.0, 0.0]), [1.0, 0.0, 0.0])
    for k in range(2):
        store.add(replace(frame(k, good), ids=np.array([1])))
    markers = mapped({1: transform(np.eye(3), [3.0, 0.0, 1.0])})
    moved = store.move({1: transform(np.eye(3), [0.2, 0.0, 0.0]) @ good}, markers, markers)
    np.testing.assert_allclose(store.frames[0].T_map_camera, good, atol=1e-12)
    np.testing.assert_allclose(moved.at(1), np.eye(4), atol=1e-12)


def test_markers_in_quarantine_and_an_empty_map_move_nothing():
    store = KeyframeStore(10, MarkerMap())
    assert np.array_equal(store.move({}, {}, {}).at(3), np.eye(4))
    store.add(frame(0, np.eye(4)))
    before = mapped({1: np.eye(4), 2: transform(np.eye(3), [1.0, 0.0, 0.0])})
    before[2] = replace(before[2], trusted=False)
    shift = transform(np.eye(3), [0.0, 0.1, 0.0])
    # What an adjustment moves is what is trusted.
    after = {1: replace(before[1], T_map_marker=shift), 2: before[2]}
    np.testing.assert_allclose(store.move({}, before, after).at(0), shift, atol=1e-12)
    assert np.array_equal(store.move({}, {7: before[1]}, {7: after[1]}).at(0), np.eye(4))


def test_a_frame_of_a_repeated_stamp_is_not_kept():
    """A simulation begins once more while an adjustment is under way: that has the pose of the first one."""
    store = KeyframeStore(10, MarkerMap())
    store.add(frame(0, np.eye(4)))
    store.add(frame(0, transform(np.eye(3), [1.0, 0.0, 0.0])))
    np.testing.assert_array_equal(store.frames[0].T_map_camera, np.eye(4))


def test_rotations_stay_rotations_however_often_the_map_moves():
    """Rounding errors must not double from one adjustment to the next: in half an hour there are hundreds."""
    rng = np.random.default_rng(0)
    store = KeyframeStore(10, MarkerMap())
    for k in range(6):
        store.add(frame(k, transform(so3_exp(rng.normal(size=3)), rng.normal(size=3))))
    markers = mapped({key: transform(so3_exp(rng.normal(size=3)), rng.normal(size=3)) for key in (1, 2)})
    for _ in range(300):
        step = transform(so3_exp(0.01 * rng.normal(size=3)), 0.01 * rng.normal(size=3))
        after = {key: replace(marker, T_map_marker=step @ marker.T_map_marker) for key, marker in markers.items()}
        moved, markers = store.move({}, markers, after), after
        R = np.stack([f.T_map_camera[:3, :3] for f in store.frames.values()] + [moved.at(3)[:3, :3]])
        np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-12)


def test_what_displaces_late_rows_keeps_its_direction_where_the_calibration_changes():
    """A camera that is calibrated anew in flight, to half the size: a pixel of before is half a pixel now."""
    half = replace(CAMERA, width=CAMERA.width // 2, height=CAMERA.height // 2, K=CAMERA.K * [[0.5], [0.5], [1.0]])
    late = np.zeros((2, 4, 2, LATE))
    # How fast the corners move in the image is known of the first marker only.
    late[0, ..., 0] = late[1, ..., 1] = 3.0
    px, noise, rates = np.full((2, 4, 2), 200.0), np.tile(0.01 * np.eye(2), (2, 4, 1, 1)), np.full((2, 4, 2), 200.0)
    branches, by_readout = np.tile(np.eye(4), (2, 2, 1, 1)), np.zeros((2, 4, 2, 6))
    observed = Observations(np.array([1, 2]), px, noise, np.zeros(2), branches, by_readout, rates, late)
    store = KeyframeStore(10, MarkerMap())
    for stamp, camera in enumerate((CAMERA, half)):
        store.keep(observed, CameraPose(stamp, np.eye(4), np.eye(6)), camera, None)
    before, after = store.frames[1], store.frames[0]
    np.testing.assert_allclose(after.rates, 0.5 * before.rates, rtol=1e-9)
    np.testing.assert_allclose(after.late, 0.25 * before.late, rtol=1e-9)
    assert before.rates[0].all()
    assert before.late[1].all()
