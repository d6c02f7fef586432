"""Joint adjustment: exactness, the Schur complement, robustness, gauge, odometry, priors."""

from dataclasses import dataclass, field, replace
import pickle

import numpy as np
import pytest
from support.walls import CAMERA, flight, mirrored, NO_SYSTEMATIC_ERRORS, see, SIZE, wall
from support.wrong_lenses import drawn_lens

from thermal_fiducial.core.error_model import covariance_by_draws, draws_of, SystematicErrors
from thermal_fiducial.core.geometry.reprojection import linearise
from thermal_fiducial.core.geometry.se3 import difference, inverse, retract, rotation_angle, so3_exp, transform
from thermal_fiducial.core.mapping import bundle_adjustment
from thermal_fiducial.core.mapping.adjustment_problem import MapProblem
from thermal_fiducial.core.mapping.keyframes import Keyframe, prior_poses, snapshot_of
from thermal_fiducial.core.mapping.map_data import MapMarker, MarkerMap
from thermal_fiducial.core.measurements import corner_covariances, corners_px

#: Step of numeric derivatives: they are exact to its square, 1e-8 of what is compared to 1e-5.
STEP = 1e-4


@dataclass(frozen=True)
class Recorded:
    """Markers and keyframes, for a snapshot."""

    markers: dict
    keyframes: tuple
    known: dict = field(default_factory=dict)
    map_revision: int = 0
    errors: SystematicErrors = NO_SYSTEMATIC_ERRORS

    def snapshot(self):
        return snapshot_of(self.markers, self.keyframes, CAMERA, self.known, self.map_revision, self.errors)


def refine(recorded):
    return bundle_adjustment.refine(recorded.snapshot())


def keyframe(stamp, T_map_camera, rows):
    return Keyframe(stamp, T_map_camera, rows['id'].astype(np.int64), corners_px(rows), corner_covariances(rows))


def snapshot(rng, poses, sigma=0.02, count=30, disturbance=0.01, fixed=(0,)):
    """A flight past markers, everything but the fixed ones disturbed."""
    frames = []
    for k in range(count):
        T = flight(20.0 * k / count)
        rows = see(T, poses, sigma, rng)
        frames.append(keyframe(k + 1, retract(T, disturbance * rng.normal(size=6)), rows))
    markers = {
        i: MapMarker(i, SIZE, True, T)
        if i in fixed
        else MapMarker(i, SIZE, False, retract(T, disturbance * rng.normal(size=6)), 1e-2 * np.eye(6))
        for i, T in poses.items()
    }
    return Recorded(markers, tuple(frames))


def errors(refinement, poses):
    return np.stack([difference(marker.T_map_marker, poses[i]) for i, marker in refinement.markers.items()])


def test_markers_that_entered_in_the_wrong_one_of_two_poses_are_turned_back():
    poses = wall(np.random.default_rng(8), tilt=0.3)
    recorded = snapshot(np.random.default_rng(9), poses, sigma=0.3, disturbance=0.001)
    wrong = {key: replace(recorded.markers[key], T_map_marker=mirrored(poses[key], flight(0.0))) for key in (2, 5, 7)}
    apart = [rotation_angle(wrong[key].T_map_marker[:3, :3].T @ poses[key][:3, :3]) for key in wrong]
    assert min(apart) > np.deg2rad(20.0)
    turned_back, right = refine(replace(recorded, markers=recorded.markers | wrong)), refine(recorded)
    for key, marker in right.markers.items():
        d = difference(turned_back.markers[key].T_map_marker, marker.T_map_marker)
        # Both ends of the adjustment are within a third of a standard deviation of the minimum.
        assert d @ np.linalg.solve(marker.covariance, d) < 0.5


def test_noiseless_corners_give_the_exact_map():
    poses = wall(np.random.default_rng(0))
    refinement = refine(snapshot(np.random.default_rng(1), poses, sigma=0.0))
    assert refinement is not None
    assert sorted(refinement.markers) == list(range(1, 8))
    # The rows carry corners as float32, 3e-5 px: micrometres.
    assert np.max(np.abs(errors(refinement, poses))) < 2e-5
    assert refinement.rms_px < 1e-4
    for k, T in refinement.keyframes.items():
        assert np.max(np.abs(difference(T, flight(20.0 * (k - 1) / 30)))) < 2e-5


def test_noiseless_corners_give_the_exact_readout_time_and_map():
    """Rows of frames that turn at up to 500 px/s, and are read over 12 ms more than is declared."""
    poses = wall(np.random.default_rng(0))
    recorded, rng = snapshot(np.random.default_rng(1), poses, sigma=0.0), np.random.default_rng(3)
    displaced = []
    for frame in recorded.keyframes:
        rates = CAMERA.readout_shares(frame.corners[..., 1])[..., None] * rng.uniform(-500.0, 500.0, 2)
        displaced.append(replace(frame, corners=frame.corners + 0.012 * rates, rates=rates))
    unsure = replace(NO_SYSTEMATIC_ERRORS, readout_time_std=0.015)
    refinement = refine(replace(recorded, keyframes=tuple(displaced), errors=unsure))
    # Its prior, of 15 ms, pulls by the square of 0.1 to 15 ms. Map as above, with two digits less of the corners.
    assert refinement.readout.seconds == pytest.approx(0.012, abs=5e-6)
    assert np.max(np.abs(errors(refinement, poses))) < 1e-4
    # Its prior where no velocity is known, by 64 draws, whose standard deviation is good to 9 %.
    shown_by_nothing = refine(replace(recorded, errors=unsure)).readout
    assert shown_by_nothing.seconds == 0.0
    assert shown_by_nothing.std == pytest.approx(0.015, rel=0.3)


@pytest.mark.parametrize('fixed', [(0,), ()])
def test_the_schur_complement_answers_like_the_whole_system(fixed):
    """One step, and the covariances, against the dense normal equations of all unknowns."""
    rng = np.random.default_rng(2)
    poses = wall(rng, 4)
    s = snapshot(rng, poses, count=6, disturbance=1e-3, fixed=fixed)
    information = np.diag([1e4] * 3 + [1e5] * 3)
    by_odometry = {k: replace(s.keyframes[k], T_odometry=flight(20 * k / 6), information=information) for k in (2, 4)}
    s = replace(s, keyframes=tuple(by_odometry.get(k, frame) for k, frame in enumerate(s.keyframes)))
    s = replace(s, known=prior_poses({1: replace(s.markers[1], covariance=1e-5 * np.eye(6))}))
    problem = MapProblem.build(s.snapshot())
    assert problem is not None
    e = problem.evaluate(problem.start)
    # The nodes: M markers, and the frame of the odometry.
    F, M = len(problem.stamps), len(problem.ids)
    H, g = np.zeros((6 * (F + M + 1),) * 2), np.zeros(6 * (F + M + 1))

    def add(terms, r):
        for i, J_i in terms:
            g[6 * i : 6 * i + 6] += J_i.T @ r
            for j, J_j in terms:
                H[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] += J_i.T @ J_j

    T_map_camera, T_map_marker = problem.start.T_map_camera[problem.frame], problem.start.T_map_marker[problem.marker]
    _, *J_px = linearise(problem.camera, T_map_camera, T_map_marker, problem.sizes[problem.marker])
    whitened = [(problem.W @ J.reshape(-1, 4, 2, 6)).reshape(-1, 8, 6) for J in J_px]
    for v, (J_camera, J_marker) in enumerate(zip(*whitened, strict=True)):
        w = np.sqrt(e.weights(1.0)[v])
        add([(problem.frame[v], w * J_camera), (F + problem.marker[v], w * J_marker)], w * e.r[v])
    prior, covariance = s.known[1]
    # No place is known better than to 0.1 mm and mrad.
    root = np.linalg.cholesky(np.linalg.inv(covariance + 1e-8 * np.eye(6))).T
    add([(F + 1, root)], root @ difference(prior, s.markers[1].T_map_marker))
    # All odometry counts as one measurement.
    root = np.sqrt(information / len(by_odometry))
    for k, frame in by_odometry.items():
        moved = [difference(retract(np.eye(4), d) @ frame.T_odometry, frame.T_odometry) for d in STEP * np.eye(6)]
        terms = [(k, root), (F + M, -root @ np.transpose(moved) / STEP)]
        add(terms, root @ difference(frame.T_odometry, frame.T_map_camera))
    free = np.repeat(np.concatenate([np.ones(F, dtype=bool), ~problem.held, [True]]), 6)
    expected = np.zeros(6 * (F + M + 1))
    expected[free] = np.linalg.solve(H[np.ix_(free, free)], g[free])
    blocks, sides = problem.normal(e, 1.0)
    system = problem.equations.reduced(blocks)
    frames, nodes, of_lens = system.solve(sides)
    # Pixels of this camera are square as calibrated.
    assert not of_lens.any()
    # Two ways of solving one system of condition 1e8. Where one prior holds the map, or two the frame of the odometry,
    # what keeps blocks from being singular, 1e-12 of them, holds it too: by 1e-4 of a step of 4 mm.
    np.testing.assert_allclose(np.concatenate([frames.ravel(), nodes.ravel()]), expected, rtol=1e-5, atol=1e-6)
    inverse_H = np.linalg.inv(H[np.ix_(free, free)])
    covariances = system.covariances(system.covariance)
    for k, m in enumerate(np.flatnonzero(~problem.held)):
        own = slice(6 * (F + k), 6 * (F + k) + 6)
        # The same; absolute where an element is the small difference of large ones.
        largest = np.max(np.abs(inverse_H[own, own]))
        np.testing.assert_allclose(
            covariances[m], inverse_H[own, own], rtol=1e-4, atol=1e-15 if fixed else 1e-3 * largest
        )


def test_outliers_do_not_move_the_map_and_are_named():
    rng = np.random.default_rng(4)
    poses = wall(rng)
    s = snapshot(rng, poses)
    frames = []
    for k, frame in enumerate(s.keyframes):
        corners = frame.corners.copy()
        corners[frame.ids == 3] += 5.0 * (k % 2)
        frames.append(replace(frame, corners=corners))
    refinement = refine(replace(s, keyframes=tuple(frames)))
    assert refinement is not None
    clean = refine(s)
    assert clean is not None
    # Without half the views of one marker, the error grows a little; outliers of 250 sigma would be centimetres.
    assert np.max(np.abs(errors(refinement, poses))) < 5.0 * np.max(np.abs(errors(clean, poses))) + 1e-4
    # Every second one of its views is off.
    assert refinement.inconsistent == {3: pytest.approx(0.5, abs=0.1)}


def test_optimistic_corner_covariances_are_found_out():
    rng = np.random.default_rng(5)
    poses = wall(rng)
    s = snapshot(rng, poses, sigma=0.1, count=60)
    optimistic = tuple(replace(frame, covariances=frame.covariances / 25.0) for frame in s.keyframes)
    promised, corrected = refine(s), refine(replace(s, keyframes=optimistic))
    assert promised is not None
    assert corrected is not None
    # The variance is from a thousand residuals, less the views beyond 99.9 %, in either of them.
    for key in promised.markers:
        np.testing.assert_allclose(
            np.diag(corrected.markers[key].covariance), np.diag(promised.markers[key].covariance), rtol=0.2
        )


def test_the_covariance_of_a_fixed_marker_enters_that_of_the_others():
    rng = np.random.default_rng(6)
    poses = wall(rng)
    s = snapshot(rng, poses)
    survey = np.diag([1e-4, 2e-4, 3e-4, 0.0, 0.0, 0.0])
    draws = draws_of(survey, np.random.default_rng(0))
    unsure = replace(s, markers={**s.markers, 0: replace(s.markers[0], covariance=survey, draws=draws)})
    sharp, blurred = refine(s), refine(unsure)
    assert sharp is not None
    assert blurred is not None
    for key, marker in blurred.markers.items():
        # A fixed marker off by some way takes the whole map along by as much.
        np.testing.assert_allclose(marker.covariance - sharp.markers[key].covariance, survey, atol=1e-8)
        np.testing.assert_allclose(marker.T_map_marker, sharp.markers[key].T_map_marker, atol=1e-9)


def test_odometry_carries_the_map_over_a_gap():
    """Two groups of markers that no frame shows together: only odometry joins them."""
    rng = np.random.default_rng(7)
    poses = wall(rng)
    s = snapshot(rng, poses, count=20)
    frames = []
    for frame in s.keyframes:
        group = frame.ids < 4 if frame.stamp_ns <= 10 else frame.ids >= 4
        frames.append(replace(frame, ids=frame.ids[group], corners=frame.corners[group],
                              covariances=frame.covariances[group]))  # fmt: skip
    drift = np.array([0.01, -0.02, 0.005, 0.002, -0.001, 0.003])
    covariance = np.diag([4e-4] * 3 + [1e-5] * 3)
    T = retract(flight(20.0 * (11 - 1) / 20), drift)
    frames[10] = replace(frames[10], T_odometry=T, information=np.linalg.inv(covariance), bridge=True)
    # Before the gap it follows the markers.
    frames[9] = replace(frames[9], T_odometry=flight(20.0 * 9 / 20), information=np.linalg.inv(covariance))
    refinement = refine(replace(s, keyframes=tuple(frames)))
    assert refinement is not None
    near = [difference(refinement.markers[i].T_map_marker, poses[i]) for i in (1, 2, 3)]
    # Ten frames of 0.02 px; the gap is no concern of theirs.
    assert np.max(np.abs(near)) < 5e-3
    for i in range(4, 8):
        d = difference(refinement.markers[i].T_map_marker, poses[i])
        # As far off as the odometry, and knowing it.
        assert 0.005 < np.linalg.norm(d[:3]) < 0.05
        assert d @ np.linalg.solve(refinement.markers[i].covariance, d) < 12.6
        assert np.trace(refinement.markers[i].covariance[:3, :3]) > np.trace(covariance[:3, :3])


def test_without_odometry_the_other_side_of_a_gap_is_left_alone():
    rng = np.random.default_rng(8)
    poses = wall(rng, 2)
    s = snapshot(rng, poses, count=5)
    lonely = [replace(f, ids=f.ids[:1], corners=f.corners[:1], covariances=f.covariances[:1])
              for f in s.keyframes]  # fmt: skip
    assert refine(replace(s, keyframes=tuple(lonely))) is None


def test_a_snapshot_goes_to_another_process_in_a_moment():
    """Handed over while the next frame waits: as a few large arrays, not as thousands of small ones."""
    rng = np.random.default_rng(13)
    s = snapshot(rng, wall(rng), count=30)
    there = pickle.loads(pickle.dumps(s.snapshot()))
    assert len(there.ids) == sum(len(frame.ids) for frame in s.keyframes)
    here, over_there = refine(s), bundle_adjustment.refine(there)
    for key, marker in here.markers.items():
        np.testing.assert_array_equal(marker.T_map_marker, over_there.markers[key].T_map_marker)
    buffers = []
    pickle.dumps(replace(s.snapshot(), markers={}), protocol=5, buffer_callback=buffers.append)
    assert len(buffers) < len(s.keyframes)


def test_what_has_lost_its_connection_stays_and_the_rest_is_adjusted():
    """Thinned keyframes may no longer join a part of the map to the rest."""
    rng = np.random.default_rng(12)
    poses = wall(rng)
    s = snapshot(rng, poses, count=12)
    halves = []
    for k, f in enumerate(s.keyframes):
        own = (f.ids < 4) == (k % 2 == 0)
        halves.append(replace(f, ids=f.ids[own], corners=f.corners[own], covariances=f.covariances[own]))  # fmt: skip
    refinement = refine(replace(s, keyframes=tuple(halves)))
    assert sorted(refinement.markers) == [1, 2, 3]
    for i, marker in refinement.markers.items():
        assert np.linalg.norm(difference(marker.T_map_marker, poses[i])[:3]) < 5e-3
        assert np.trace(marker.covariance[:3, :3]) < 1e-4


def test_known_markers_keep_their_prior():
    rng = np.random.default_rng(10)
    poses = wall(rng, 3)
    s = snapshot(rng, poses, sigma=2.0, count=3)
    sharp = np.diag([1e-8] * 6)
    before = {**s.markers, 1: replace(s.markers[1], T_map_marker=poses[1], covariance=sharp)}
    held = refine(replace(s, markers=before, known=prior_poses(before)))
    assert held is not None
    # Two markers are known from before: each counts half.
    assert np.max(np.abs(difference(held.markers[1].T_map_marker, poses[1]))) < 5 * np.sqrt(2e-8)


def surveyed(rng, poses, stds):
    """Poses and markers of a map that was measured one by one, each with errors of its own."""
    off = {i: retract(T, stds * rng.normal(size=6)) for i, T in poses.items()}
    return MarkerMap({i: MapMarker(i, SIZE, False, T, np.diag(stds**2)) for i, T in off.items()})


def flown_over(rng, survey, poses, T_map_odometry=None):
    """A surveyed map after a flight; its odometry, if there is any, is exact but for where its frame lies."""
    s = snapshot(rng, poses, sigma=0.05, disturbance=0.001)
    frames = s.keyframes
    if T_map_odometry is not None:
        information = np.diag([1e6] * 6)
        frames = tuple(
            replace(frame, T_odometry=T_map_odometry @ flight(20.0 * k / len(frames)), information=information)
            for k, frame in enumerate(frames)
        )
    known = survey.with_assumed_draws(s.errors).markers
    return refine(replace(s, markers=known, keyframes=frames, known=prior_poses(known))).markers


def test_a_flight_makes_a_surveyed_map_better():
    """To 20 mm and 2 deg each: the flight relates them, and all together know where the map lies."""
    stds = np.array([0.02] * 3 + [0.035] * 3)
    before, after, squares = [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        poses = wall(rng)
        survey = surveyed(rng, poses, stds)
        for key, marker in flown_over(rng, survey, poses).items():
            before.append(difference(survey.markers[key].T_map_marker, poses[key]))
            after.append(difference(marker.T_map_marker, poses[key]))
            squares.append(after[-1] @ np.linalg.solve(marker.covariance, after[-1]))
    assert len(after) == 64
    # Eight of them are better by the root of eight, 0.35; less in depth, as the wall is turned by 2 deg over that root,
    # and more in rotations, which positions show. To hold one of them turned the others about it: 100 mm.
    gain = np.linalg.norm(after, axis=0) / np.linalg.norm(before, axis=0)
    assert np.all(gain < 0.7)
    assert np.mean(gain) < 0.4
    # Markers of one map have their six errors in common: 99.9 % of chi square of 48 degrees of freedom.
    assert 0.48 < np.mean(squares) / 6.0 < 1.75


def test_a_flight_finds_a_marker_that_was_surveyed_wrongly():
    rng = np.random.default_rng(3)
    poses, stds = wall(rng), np.array([0.01] * 3 + [0.02] * 3)
    survey = surveyed(rng, poses, stds)
    wrong = survey.markers[2]
    survey.markers[2] = replace(wrong, T_map_marker=retract(wrong.T_map_marker, [0.0, 0.3, 0.0, 0.0, 0.0, 0.0]))
    off = [difference(marker.T_map_marker, poses[key])[:3] for key, marker in flown_over(rng, survey, poses).items()]
    # In a mean of eight, 0.3 m are 40 mm.
    assert np.max(np.abs(off)) < 0.02


def test_odometry_does_not_say_where_a_surveyed_map_lies():
    """The filter's poses come from the map, so they know no better than the survey where it is."""
    stds = np.array([0.02] * 3 + [0.035] * 3)
    poses = wall(np.random.default_rng(4))
    survey = surveyed(np.random.default_rng(5), poses, stds)
    T_map_odometry = retract(np.eye(4), [0.1, 0.05, -0.1, 0.02, -0.04, 0.03])
    alone, beside = (flown_over(np.random.default_rng(6), survey, poses, T) for T in (None, T_map_odometry))
    for key, marker in beside.items():
        apart = difference(marker.T_map_marker, alone[key].T_map_marker)
        # A tenth of what is claimed: the odometry does say how far apart markers are.
        assert np.all(np.abs(apart) < 0.1 * np.sqrt(np.diag(marker.covariance)))
        ratio = np.diag(marker.covariance) / np.diag(alone[key].covariance)
        np.testing.assert_allclose(ratio, 1.0, atol=0.1)


def loose_and_held(rng, poses):
    """A chain of pairs: each frame sees two markers, and noise turns the chain at every link; without odometry, with.

    The odometry is off by 5 mm and 1 mrad in each frame.
    """
    pairs = [{key: poses[key] for key in (k, k + 1)} for k in range(3)]
    frames = []
    for k in range(60):
        T = flight(0.1 * k)
        rows = see(T, pairs[k // 20], 0.2, rng)
        if len(rows) == 2:
            frames.append(keyframe(k + 1, T, rows))
    markers = {
        i: MapMarker(i, SIZE, i == 0, T if i == 0 else retract(T, 0.02 * rng.normal(size=6)), (i > 0) * np.eye(6))
        for i, T in poses.items()
    }
    loose = Recorded(markers, tuple(frames))
    sigma = np.diag([5e-3] * 3 + [1e-3] * 3)
    known = [
        replace(
            frame,
            T_odometry=retract(frame.T_map_camera, sigma @ rng.normal(size=6)),
            information=np.linalg.inv(sigma @ sigma),
        )
        for frame in frames
    ]
    return loose, replace(loose, keyframes=tuple(known))


def test_odometry_holds_the_shape_of_a_chain():
    off = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        poses = dict(list(wall(rng).items())[:4])
        maps = [refine(recorded).markers for recorded in loose_and_held(rng, poses)]
        last = inverse(poses[1]) @ poses[3]
        off.append([difference(inverse(m[1].T_map_marker) @ m[3].T_map_marker, last) for m in maps])
    loose, held = np.sqrt(np.mean(np.square(off), axis=0))
    # 0.60 of positions and 0.59 of rotations over twelve seeds: half-way to 1, which is no gain.
    assert np.linalg.norm(held[:3]) < 0.8 * np.linalg.norm(loose[:3])
    assert np.linalg.norm(held[3:]) < 0.8 * np.linalg.norm(loose[3:])


def test_a_filter_that_is_lost_spoils_no_map():
    """Its motion is right, its place is not: half a metre and radian off."""
    rng = np.random.default_rng(11)
    poses = dict(list(wall(rng).items())[:4])
    loose, held = loose_and_held(rng, poses)
    lost = [replace(f, T_odometry=retract(f.T_odometry, np.full(6, 0.5))) for f in held.keyframes]
    off = errors(refine(replace(loose, keyframes=tuple(lost))), poses)[:, :3]
    # Less than a tenth of it gets into the map.
    assert np.sqrt(np.mean(off**2)) < 0.1 * 0.5


def nees_of_lasting(sources, drawn):
    """Mean NEES (six degrees of freedom) of twenty maps whose corners are off by ``drawn``, as ``sources`` claim.

    ``drawn(rng)`` are the errors of keyframes whose corners are exact otherwise.
    """
    poses, nees = wall(np.random.default_rng(0)), []
    exact = snapshot(np.random.default_rng(1), poses, sigma=0.0, disturbance=0.0)
    white, both = (refine(replace(exact, errors=errors)).markers for errors in (NO_SYSTEMATIC_ERRORS, sources))
    P = np.stack([both[i].covariance - white[i].covariance for i in range(1, 8)])
    for seed in range(20):
        off = drawn(np.random.default_rng(seed))
        frames = tuple(replace(frame, corners=frame.corners + off(frame)) for frame in exact.keyframes)
        d = errors(refine(replace(exact, keyframes=frames)), poses)
        nees.append(np.mean(np.einsum('ni,nij,nj->n', d, np.linalg.inv(P), d)))
    return np.mean(nees)


def test_errors_that_last_are_in_the_covariances():
    """Corners that are off by the same in all views of a marker, and by nothing else."""

    def shapes(rng):
        # Corners of noiseless rows declare 1e-3 px.
        off = 1e-3 * rng.normal(size=(8, 4, 2))
        return lambda frame: off[frame.ids]

    nees = nees_of_lasting(replace(NO_SYSTEMATIC_ERRORS, marker_shape=1.0), shapes)
    # Six, or 64 / 57 times that (the mean of an inverted Wishart matrix of 64 samples). A map's markers share most
    # of their error: the mean of twenty has a standard deviation of 0.9.
    assert 6.0 - 2.7 < nees < 6.0 * 64 / 57 + 2.7


def test_a_lens_that_is_wrong_is_in_the_covariances():
    def lens(rng):
        off = drawn_lens(rng, 0.1)
        return lambda frame: off(frame.corners)

    nees = nees_of_lasting(replace(NO_SYSTEMATIC_ERRORS, corner_px=0.1), lens)
    # Six. The markers share the lens: the means of single maps scatter by 2.5, their mean by 0.6.
    assert 6.0 - 1.8 < nees < 6.0 + 1.8


def test_a_focal_length_that_is_wrong_is_in_the_covariances():
    """One number moves all markers together: each covariance is the product of the error by one standard deviation."""
    # So little that it costs no view its weight: corners of noiseless rows declare 1e-3 px.
    share, poses = 1e-5, wall(np.random.default_rng(0))
    exact = snapshot(np.random.default_rng(1), poses, sigma=0.0, disturbance=0.0)
    sources = (NO_SYSTEMATIC_ERRORS, replace(NO_SYSTEMATIC_ERRORS, focal_length_std=share))
    white, both = (refine(replace(exact, errors=errors)).markers for errors in sources)
    off = [replace(f, corners=f.corners + share * (f.corners - CAMERA.principal_point)) for f in exact.keyframes]
    moved = errors(refine(replace(exact, keyframes=tuple(off))), poses)[:, :3]
    stds = np.sqrt([(both[i].covariance - white[i].covariance)[:3, :3].trace() for i in range(1, 8)])
    # Up to 5 um. The adjustment ends where a step is small against the corners' claims: 6 % of these.
    np.testing.assert_allclose(stds, np.linalg.norm(moved, axis=1), rtol=0.1)


def test_draws_say_how_the_errors_of_markers_are_correlated():
    """Two markers side by side have nearly the same error: their distance is known better than the place of either."""
    poses = wall(np.random.default_rng(0), tilt=0.0)
    recorded = snapshot(np.random.default_rng(1), poses, sigma=0.05)
    adjusted = refine(replace(recorded, errors=SystematicErrors(marker_size_std=0.0))).markers
    for marker in adjusted.values():
        variances = np.stack([marker.covariance.diagonal(), covariance_by_draws(marker.draws).diagonal()])
        # By 64 draws a variance is known to 18 %: beyond four standard deviations of its logarithm.
        assert np.abs(np.diff(np.log(variances), axis=0)).max() < 4 * 0.18
    # The markers farthest from the held one, 0, are 3 and 7 (3 m); each is 1 m from the other.
    third, seventh = (adjusted[i].draws for i in (3, 7))
    between, alone = (covariance_by_draws(draws)[:3, :3].trace() for draws in (third - seventh, seventh))
    assert between < 0.5 * alone


def test_a_side_that_is_covered_in_all_views_is_in_the_covariance():
    """Its outline ends 3 px beyond the side; where that looks like a square, in one view of ten, it claims little."""
    poses = wall(np.random.default_rng(0))
    recorded = snapshot(np.random.default_rng(1), poses, count=60, disturbance=0.0)
    off = np.zeros((8, 4, 2))
    off[5, :2, 1] = 3.0, 2.0
    frames = []
    for index, frame in enumerate(recorded.keyframes):
        covariances = frame.covariances.copy()
        if index % 10:
            covariances[frame.ids == 5] = 4.0**2 * np.eye(2)
        frames.append(replace(frame, corners=frame.corners + off[frame.ids], covariances=covariances))
    refinement = refine(replace(recorded, keyframes=tuple(frames), errors=SystematicErrors()))
    d, C = difference(refinement.markers[5].T_map_marker, poses[5]), refinement.markers[5].covariance
    # Six are expected of as much as is claimed; hundreds where the claim of each view counts as white noise.
    assert d @ np.linalg.solve(C, d) < 6.0


def test_a_marker_that_starts_behind_the_camera_spoils_nothing():
    poses = wall(np.random.default_rng(0))
    start = snapshot(np.random.default_rng(1), poses)
    turned = start.keyframes[5].T_map_camera @ transform(so3_exp([0.0, np.pi, 0.0]), np.zeros(3))
    frames = (*start.keyframes[:5], replace(start.keyframes[5], T_map_camera=turned), *start.keyframes[6:])
    refinement = refine(replace(start, keyframes=frames))
    # As in the flight without the turned frame: a millimetre.
    assert np.max(np.abs(errors(refinement, poses)[:, :3])) < 1e-3
