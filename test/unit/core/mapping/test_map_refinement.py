"""Joint adjustment: exactness, the Schur complement, robustness, gauge, odometry, priors."""

from dataclasses import dataclass, field, replace
import pickle

import numpy as np
import pytest
from support.walls import CAMERA, flight, NO_SYSTEMATIC_ERRORS, see, SIZE, wall
from support.wrong_lenses import drawn_lens

from thermal_fiducial.core.error_model import covariance_of, draws_of, SystematicErrors
from thermal_fiducial.core.geometry.reprojection import difference, retract
from thermal_fiducial.core.geometry.se3 import rotation_angle, so3_exp, transform
from thermal_fiducial.core.mapping import bundle_adjustment
from thermal_fiducial.core.mapping.adjustment_problem import MapProblem
from thermal_fiducial.core.mapping.keyframes import Keyframe, prior_poses, snapshot_of
from thermal_fiducial.core.mapping.map_data import MapMarker
from thermal_fiducial.core.measurements import corner_covariances, corners_px


@dataclass(frozen=True)
class Recorded:
    """Markers and keyframes, for a snapshot."""

    markers: dict
    keyframes: tuple
    known: dict = field(default_factory=dict)
    map_revision: int = 0
    errors: SystematicErrors = NO_SYSTEMATIC_ERRORS

    def snapshot(self):
        return snapshot_of(self.markers, self.keyframes, self.known, self.map_revision, self.errors)


def refine(recorded):
    return bundle_adjustment.refine(recorded.snapshot())


def keyframe(stamp, T_map_camera, rows):
    return Keyframe(
        stamp, T_map_camera, CAMERA, rows['id'].astype(np.int64), corners_px(rows), corner_covariances(rows)
    )


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


def mirrored(T_map_marker, T_map_camera):
    """About the other pose of a marker that a camera sees alike: turned half round the line of sight and its normal."""
    sight = T_map_camera[:3, 3] - T_map_marker[:3, 3]
    half_turn = so3_exp(np.pi * sight / np.linalg.norm(sight))
    R = half_turn @ T_map_marker[:3, :3] @ so3_exp([0.0, 0.0, np.pi])
    return transform(R, T_map_marker[:3, 3])


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


def test_the_schur_complement_answers_like_the_whole_system():
    """One step, and the covariances, against the dense normal equations of all unknowns."""
    rng = np.random.default_rng(2)
    poses = wall(rng, 4)
    s = snapshot(rng, poses, count=6, disturbance=1e-3)
    information = np.diag([1e4] * 3 + [1e5] * 3)
    bridge = replace(s.keyframes[2], T_odometry=flight(40 / 6), information=information)
    s = replace(s, keyframes=(*s.keyframes[:2], bridge, *s.keyframes[3:]))
    s = replace(s, known=prior_poses({1: s.markers[1]}))
    problem = MapProblem.build(s.snapshot())
    assert problem is not None
    e = problem.evaluate(problem.start)
    F, M = len(problem.stamps), len(problem.ids)
    H, g = np.zeros((6 * (F + M),) * 2), np.zeros(6 * (F + M))

    def add(terms, r):
        for i, J_i in terms:
            g[6 * i : 6 * i + 6] += J_i.T @ r
            for j, J_j in terms:
                H[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] += J_i.T @ J_j

    for v in range(len(problem.frame)):
        w = np.sqrt(e.weights(1.0)[v])
        terms = [(problem.frame[v], w * e.J_camera[v]), (F + problem.marker[v], w * e.J_marker[v])]
        add(terms, w * e.r[v])
    for T, known, node in (
        (bridge.T_map_camera, (bridge.T_odometry, information), 2),
        (s.markers[1].T_map_marker, (s.known[1][0], np.linalg.inv(s.known[1][1])), F + 1),
    ):
        root = np.linalg.cholesky(known[1]).T
        add([(node, root)], root @ difference(known[0], T))
    free = np.repeat(np.concatenate([np.ones(F, dtype=bool), ~problem.held]), 6)
    expected = np.zeros(6 * (F + M))
    expected[free] = np.linalg.solve(H[np.ix_(free, free)], g[free])
    blocks, *sides = problem.normal(e, 1.0)
    system = problem.equations.reduced(blocks)
    frames, markers = system.solve(*sides)
    # Two ways of solving one system of condition 1e8.
    np.testing.assert_allclose(np.concatenate([frames.ravel(), markers.ravel()]), expected, rtol=1e-5, atol=1e-9)
    inverse_H = np.linalg.inv(H[np.ix_(free, free)])
    covariances = system.covariances()
    for k, m in enumerate(np.flatnonzero(~problem.held)):
        own = slice(6 * (F + k), 6 * (F + k) + 6)
        np.testing.assert_allclose(covariances[m], inverse_H[own, own], rtol=1e-4, atol=1e-15)


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
    assert refinement.outliers[3] == pytest.approx(0.5, abs=0.1)
    assert max(share for key, share in refinement.outliers.items() if key != 3) < 0.05


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
    frames[10] = replace(frames[10], T_odometry=T, information=np.linalg.inv(covariance))
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


def test_odometry_holds_keyframes_that_a_marker_leaves_loose():
    """A chain of pairs: each frame sees two markers, and noise turns the chain at every link."""
    rng = np.random.default_rng(11)
    poses = dict(list(wall(rng).items())[:4])
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
    held = replace(loose, keyframes=tuple(known))
    off = {name: errors(refine(s), poses)[:, :3] for name, s in (('loose', loose), ('held', held))}
    assert np.sqrt(np.mean(off['held'] ** 2)) < 0.5 * np.sqrt(np.mean(off['loose'] ** 2))
    # What is far off counts less: of a filter that is lost by half a metre less than a tenth gets into the map.
    lost = [replace(frame, T_odometry=retract(frame.T_odometry, np.full(6, 0.5))) for frame in known]
    off = errors(refine(replace(loose, keyframes=tuple(lost))), poses)[:, :3]
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


def test_draws_say_how_the_errors_of_markers_are_correlated():
    """Two markers side by side have nearly the same error: their distance is known better than the place of either."""
    poses = wall(np.random.default_rng(0), tilt=0.0)
    recorded = snapshot(np.random.default_rng(1), poses, sigma=0.05)
    adjusted = refine(replace(recorded, errors=SystematicErrors(marker_size_std=0.0))).markers
    for marker in adjusted.values():
        variances = np.stack([marker.covariance.diagonal(), covariance_of(marker.draws).diagonal()])
        # By 64 draws a variance is known to 18 %: beyond four standard deviations of its logarithm.
        assert np.abs(np.diff(np.log(variances), axis=0)).max() < 4 * 0.18
    # The markers farthest from the held one, 0, are 3 and 7 (3 m); each is 1 m from the other.
    third, seventh = (adjusted[i].draws for i in (3, 7))
    between, alone = (covariance_of(draws)[:3, :3].trace() for draws in (third - seventh, seventh))
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
