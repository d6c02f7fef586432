"""Markers on trial: starts of the fit that cannot be."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_bag import CAMERA as STRAIGHT
from support.walls import CAMERA as OF_WALL
from support.walls import hung, look, see
from support.walls import rows as rows_of

from thermal_fiducial.core.error_model import covariance_by_draws, DRAWS, NO_DRAWS, SystematicErrors
from thermal_fiducial.core.geometry.reprojection import marker_corners
from thermal_fiducial.core.geometry.se3 import difference, inverse, lever_arm, retract, so3_exp, transform
from thermal_fiducial.core.mapping.candidates import Candidate, NewMarkers, WRONG_SIDE
from thermal_fiducial.core.mapping.marker_views import MarkerView, MarkerViews, Viewpoint
from thermal_fiducial.core.measurements import corners_px, LATE, NOTHING_KNOWN, Observations

# What lies far beside the axis a lens with distortion throws farthest.
CAMERA = replace(STRAIGHT, D=np.array([-0.3, 0.12, 0.0, 0.0, -0.02]))
SIZE = 0.3
T_MAP_MARKER = transform(np.diag([1.0, -1.0, -1.0]), [0.1, 0.2, 2.0])


def view(stamp_ns, T_map_camera, covariance=1e-3):
    """A marker seen in the middle of the image, from a camera that may not have seen it there."""
    branch = transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 2.0])
    corners = CAMERA.project((branch[:3, :3] @ marker_corners(SIZE).T).T + branch[:3, 3])
    viewpoint = Viewpoint.known(T_map_camera, covariance * np.eye(6), NO_DRAWS)
    return MarkerView(stamp_ns, viewpoint, corners, np.tile(1e-4 * np.eye(2), (4, 1, 1)), np.stack([branch] * 2))


@pytest.mark.parametrize('covariance', [1e-3, 1e5])
@pytest.mark.parametrize('gap', [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
def test_a_start_through_a_camera_is_no_marker(gap, covariance):
    """The camera of one view stands in the corner where another view has the marker: it cannot have seen it."""
    corner = T_MAP_MARKER[:3, :3] @ marker_corners(SIZE)[0] + T_MAP_MARKER[:3, 3]
    turned = so3_exp([0.1, 0.0, 0.0])
    candidate = Candidate(7, SIZE)
    candidate.add(view(0, transform(np.eye(3), [0.1, 0.2, 0.0])))
    candidate.add(view(1, transform(turned, corner - turned @ [1e-3, 2e-3, gap]), covariance))
    candidate.add(view(2, transform(so3_exp([-0.1, 0.0, 0.0]), [2.0, 2.0, 0.0])))
    reason = candidate.place(CAMERA, SystematicErrors())
    assert isinstance(reason, str)
    assert 'marker 7' in reason


@pytest.mark.parametrize(('covariance', 'kept', 'untried'), [(1e-5, [1, 2], 3), (5e-4, [0, 2], 2)])
def test_of_two_views_from_one_direction_one_that_is_known_far_better_is_kept(covariance, kept, untried):
    """The first camera's attitude is known to 3 degrees, so its direction is as good as any within them."""
    candidate = Candidate(7, SIZE)
    candidate.add(view(0, np.eye(4)))
    candidate.add(view(1, transform(so3_exp([0.01, 0.0, 0.0]), np.zeros(3)), covariance))
    candidate.add(view(2, transform(so3_exp([0.1, 0.0, 0.0]), np.zeros(3))))
    assert [one.stamp_ns for one in candidate.views] == kept
    assert candidate.untried == untried


def test_views_of_another_calibration_keep_their_directions():
    """A camera that is calibrated anew in flight, to another size of the image: the pixels of before mean others."""
    half = replace(CAMERA, width=CAMERA.width // 2, height=CAMERA.height // 2, K=CAMERA.K * [[0.51], [0.49], [1.0]])
    before = replace(view(0, np.eye(4)), late_px=np.ones((4, 2, LATE)))
    found = before.in_pixels_of(CAMERA, half)
    np.testing.assert_allclose(half.normalise(found.corners), CAMERA.normalise(before.corners), atol=1e-9)
    # In the middle of the image, where the lens hardly distorts: half a pixel of one is a pixel of the other.
    np.testing.assert_allclose(found.corner_covariances, 0.25 * before.corner_covariances, rtol=0.1, atol=1e-6)
    np.testing.assert_allclose(found.late_px, 0.5 * before.late_px, rtol=0.1)


@pytest.mark.parametrize('change', [1.0, 1.025])
def test_a_marker_enters_where_it_is_though_the_calibration_changes_meanwhile(change):
    new, errors = NewMarkers(SIZE, {}), SystematicErrors(corner_px=0.0)
    other = replace(CAMERA, K=CAMERA.K * [[change], [change], [1.0]])
    placed = []
    for k, x in enumerate((-0.3, -0.15, 0.0, 0.15, 0.3)):
        camera = CAMERA if k < 3 else other
        own = seen_from(x, NO_DRAWS, camera)
        shown = Observations(
            np.array([7]),
            own.corners[None],
            own.corner_covariances[None],
            np.zeros(1),
            own.branches[None],
            np.zeros((1, 4, 2, 6)),
            np.zeros((1, 4, 2)),
            np.zeros((1, 4, 2, LATE)),
        )
        placed += new.add_views(own.stamp_ns, shown, camera, own.viewpoint, errors)[0]
    (marker,) = placed
    # Corners without noise, but for the cameras' own 0.1 mm and mrad.
    np.testing.assert_allclose(marker.T_map_marker, T_MAP_MARKER, atol=1e-3)


def seen_from(x, draws, camera=CAMERA):
    """The marker seen without error by a camera ``x`` beside the middle, whose pose has joint ``draws`` of errors."""
    T_map_camera = transform(np.eye(3), [x, 0.2, 0.0])
    branch = inverse(T_map_camera) @ T_MAP_MARKER
    corners = camera.project((branch[:3, :3] @ marker_corners(SIZE).T).T + branch[:3, 3])
    viewpoint = Viewpoint.known(T_map_camera, 1e-8 * np.eye(6), draws)
    return MarkerView(
        round(1e9 * (1.0 + x)), viewpoint, corners, np.tile(1e-4 * np.eye(2), (4, 1, 1)), np.stack([branch] * 2)
    )


def placed(*draws, lens_px=0.0):
    candidate = Candidate(7, SIZE)
    for x, own in zip((-0.3, 0.0, 0.3), draws, strict=True):
        candidate.add(seen_from(x, own))
    return candidate.place(CAMERA, SystematicErrors(corner_px=lens_px, focal_length_std=0.0))


def test_a_new_marker_has_the_errors_of_the_cameras_draw_by_draw():
    shift = np.zeros((6, DRAWS))
    shift[:3] = 0.1 * np.random.default_rng(0).normal(size=(3, DRAWS))
    known, shared = placed(*[np.zeros((6, DRAWS))] * 3), placed(*[shift] * 3)
    # Cameras that are shifted alike shift the marker by as much.
    assert np.allclose(shared.draws - known.draws, shift, rtol=0.0, atol=1e-9)
    assert np.allclose(shared.covariance - known.covariance, covariance_by_draws(shift), rtol=0.0, atol=1e-9)


def test_a_new_marker_has_the_errors_of_the_lens_at_its_own_corners():
    exact = [np.zeros((6, DRAWS))] * 3
    alone, behind_lens, behind_worse = (placed(*exact, lens_px=px) for px in (0.0, 0.1, 0.2))
    variances = [(p.covariance - alone.covariance).diagonal() for p in (behind_lens, behind_worse)]
    assert np.all(variances[0] > 0.0)
    # Errors twice as large in the same draws: four times the variance, to rounding.
    assert np.allclose(variances[1], 4.0 * variances[0], rtol=1e-6)


def test_one_of_two_cameras_has_the_draws_of_each():
    first, second = (seen_from(x, x * np.ones((6, DRAWS))).viewpoint for x in (0.1, 0.2))
    both = Viewpoint.either(first, second, np.zeros(2))
    assert len(both.poses) == 2
    assert np.array_equal(both.draws[:, 0, 0], [0.1, 0.2])


def placed_by_either(chi2):
    """Exact views from cameras that may as well all be turned by half a radian, with the map; ``chi2`` of the two."""
    turn, candidate = transform(so3_exp([0.0, 0.0, 0.5]), np.zeros(3)), Candidate(7, SIZE)
    for x in (-0.3, 0.0, 0.3):
        view = seen_from(x, np.zeros((6, DRAWS)))
        turned = replace(view.viewpoint, T_map_camera=turn @ view.viewpoint.T_map_camera)
        candidate.add(replace(view, viewpoint=Viewpoint.either(view.viewpoint, turned, np.array(chi2))))
    return candidate.place(CAMERA, SystematicErrors(corner_px=0.0))


@pytest.mark.parametrize(('chi2', 'sign'), [((0.0, 15.0), 1.0), ((15.0, 0.0), -1.0)])
def test_of_two_cameras_that_place_a_marker_equally_well_the_likelier_one_counts(chi2, sign):
    known = placed(*[np.zeros((6, DRAWS))] * 3).T_map_marker
    there = transform(so3_exp([0.0, 0.0, 0.5 * (sign < 0.0)]), np.zeros(3)) @ known
    # Exact views, to where a step is negligible.
    assert np.allclose(placed_by_either(chi2).T_map_marker, there, rtol=0.0, atol=1e-6)
    assert 'unsettled' in placed_by_either((0.0, 0.0))


def test_a_place_is_found_though_the_first_camera_and_the_last_one_hardly_show_it():
    """They are taken for turned as the second poses of the others are, and known to that angle only."""
    turn, candidate = transform(so3_exp([0.0, 0.0, 0.2]), np.zeros(3)), Candidate(7, SIZE)
    own = 1e-5 * np.eye(6)
    for x in (-0.4, -0.2, 0.0, 0.2, 0.4):
        view = seen_from(x, NO_DRAWS)
        T = view.viewpoint.T_map_camera[0]
        first, second = (Viewpoint.known(pose, own, NO_DRAWS) for pose in (T, turn @ T))
        along_turn = 0.2 * lever_arm((turn @ T)[:3, 3])[:, 5]
        vague = Viewpoint.known(turn @ T, own + np.outer(along_turn, along_turn), NO_DRAWS)
        is_vague = abs(x) > 0.3
        candidate.add(replace(view, viewpoint=vague if is_vague else Viewpoint.either(first, second, np.zeros(2))))
    assert 'unsettled' in candidate.place(CAMERA, SystematicErrors(corner_px=0.0))


def test_a_camera_is_no_likelier_for_being_known_better():
    """Of two that explain all views equally well, one is known three times less well."""
    turn, candidate = transform(so3_exp([0.0, 0.0, 0.5]), np.zeros(3)), Candidate(7, SIZE)
    for x in (-0.3, 0.0, 0.3):
        view = seen_from(x, NO_DRAWS)
        turned = Viewpoint.known(turn @ view.viewpoint.T_map_camera[0], 9e-8 * np.eye(6), NO_DRAWS)
        candidate.add(replace(view, viewpoint=Viewpoint.either(view.viewpoint, turned, np.array([0.0, 3.0]))))
    views = MarkerViews(candidate.views, SIZE, CAMERA, SystematicErrors(corner_px=0.0))
    fits = views.fit(np.stack([T_MAP_MARKER, turn @ T_MAP_MARKER]))
    # Three views: nine, to where a step of the fit is negligible.
    assert fits.cost == pytest.approx([0.0, 9.0], abs=1e-6)


def cost_of_turned_place(swapped):
    """Excess of the wrong of two places of a marker, of which cameras with a common error have two poses each.

    Each camera is known but for a common turn about an axis beside it, which is another one for its second pose. The
    poses of those in ``swapped`` stand in the other order.
    """
    turn, candidate = transform(so3_exp([0.0, 0.0, 0.5]), np.zeros(3)), Candidate(7, SIZE)
    error = 0.02 * np.random.default_rng(0).normal(size=DRAWS)
    for k, x in enumerate((-0.3, 0.0, 0.3)):
        view = seen_from(x, np.multiply.outer(lever_arm(np.array([x, 0.0, -2.0]))[:, 4], error))
        T, place = turn @ view.viewpoint.T_map_camera[0], np.array([-x, 0.5, -2.0])
        turned = Viewpoint.known(T, 1e-8 * np.eye(6), np.multiply.outer(lever_arm(place)[:, 3], error))
        first, second = (turned, view.viewpoint) if k in swapped else (view.viewpoint, turned)
        candidate.add(replace(view, viewpoint=Viewpoint.either(first, second, np.zeros(2))))
    views = MarkerViews(candidate.views, SIZE, CAMERA, SystematicErrors(corner_px=0.0))
    there = turn @ T_MAP_MARKER
    return views.fit(np.stack([T_MAP_MARKER, there])).cost


@pytest.mark.parametrize('swapped', [(0,), (1,), (2,), (0, 1, 2)])
def test_the_order_of_two_possible_cameras_means_nothing(swapped):
    """An error that cameras have in common is common to those of their poses that go together."""
    # The same sums in another order.
    assert np.allclose(cost_of_turned_place(swapped), cost_of_turned_place(()), rtol=1e-9)


def test_a_camera_whose_turn_is_unknown_takes_nothing_from_a_claim():
    """The last camera saw the marker without error, may be turned by anything about it, and is taken for 10 deg off."""
    turn = transform(so3_exp([0.0, 0.17, 0.0]), np.zeros(3))
    about_marker = transform(np.eye(3), T_MAP_MARKER[:3, 3]) @ turn @ transform(np.eye(3), -T_MAP_MARKER[:3, 3])
    claims = []
    for spread in (0.0, NOTHING_KNOWN):
        candidate = Candidate(7, SIZE)
        for x in (-0.3, 0.0, 0.15):
            candidate.add(seen_from(x, NO_DRAWS))
        if spread:
            last = seen_from(0.3, NO_DRAWS)
            taken_for = about_marker @ last.viewpoint.T_map_camera[0]
            along_arc = lever_arm(taken_for[:3, 3] - T_MAP_MARKER[:3, 3])[:, 4]
            covariance = 1e-8 * np.eye(6) + spread**2 * np.outer(along_arc, along_arc)
            candidate.add(replace(last, viewpoint=Viewpoint.known(taken_for, covariance, NO_DRAWS)))
        claims.append(np.sqrt(candidate.place(CAMERA, SystematicErrors()).covariance.trace()))
    # 5.1 and 5.3 mm; 28 mm with the camera on the tangent of its arc, with the weights of the start alone 610 mm.
    assert claims[1] < 1.01 * claims[0]


def from_cameras_in_doubt(seed, *, apart_deg, side=SIZE, distance=2.5):
    """A marker of ``side``, taken for one of :data:`SIZE`, and where it is, (4, 4).

    Three cameras see it, up to ``apart_deg`` apart, with corners of 0.1 px; each is known to 5 mm and 3.5 mrad.
    """
    rng, stds, candidate = np.random.default_rng(seed), np.repeat([5e-3, 3.5e-3], 3), Candidate(7, SIZE)
    T_map_marker = hung(rng, [0.0, 0.0, 1.5], 0.0, 0.3)
    centre = T_map_marker[:3, 3]
    for k, bearing in enumerate(0.2 + np.deg2rad(apart_deg) * np.array([-0.5, 0.0, 0.5])):
        T_map_camera = look(centre + distance * np.array([-np.cos(bearing), np.sin(bearing), 0.1]), centre)
        seen = see(T_map_camera, {7: T_map_marker}, 0.1, rng, side)
        own = Observations.of(rows_of(seen['id'], corners_px(seen), 0.1))
        taken_for = retract(T_map_camera[None], stds * rng.normal(size=(1, 6)))[0]
        viewpoint = Viewpoint.known(taken_for, np.diag(stds**2), NO_DRAWS)
        candidate.add(MarkerView(k, viewpoint, own.corners[0], own.covariances[0], own.branches[0]))
    assert len(candidate.views) == 3
    return candidate, T_map_marker


@pytest.mark.parametrize('apart_deg', [5.0, 10.0])
@pytest.mark.parametrize('ratio', [0.5, 2.0 / 3.0, 1.5, 2.0])
def test_by_views_that_show_the_side_no_marker_of_another_enters(ratio, apart_deg):
    """Without the chi square of the side most enter: residuals are small beside what the cameras may be off."""
    for seed in range(20):
        candidate, _ = from_cameras_in_doubt(seed, apart_deg=apart_deg, side=ratio * SIZE)
        reason = candidate.place(OF_WALL, SystematicErrors(corner_px=0.0))
        assert reason == 'marker 7: its views contradict each other; is its side 0.3 m?'


@pytest.mark.parametrize('distance', [2.5, 6.0])
def test_markers_of_the_declared_side_enter_in_the_right_one_of_the_two_poses(distance):
    entered = 0
    for seed in range(40):
        candidate, T_map_marker = from_cameras_in_doubt(seed, apart_deg=5.0, distance=distance)
        marker = candidate.place(OF_WALL, SystematicErrors(corner_px=0.0))
        if isinstance(marker, str):
            assert 'ambiguity' in marker
            continue
        entered += 1
        error = difference(T_map_marker, marker.T_map_marker)
        # A chi square of six degrees of freedom exceeds it once in a million.
        assert error @ np.linalg.solve(marker.covariance, error) < 38.3
    # From 2.5 m one view settles it; from 6 m the two poses differ by little.
    assert entered == 40 if distance < 5.0 else entered > 10


def test_the_chi_square_of_a_right_side_is_one_in_the_mean():
    exact = SystematicErrors(corner_px=0.0, marker_size_std=0.0)
    values = []
    for seed in range(100):
        candidate, T_map_marker = from_cameras_in_doubt(seed, apart_deg=5.0)
        views = MarkerViews(candidate.views, SIZE, OF_WALL, exact)
        values.append(views.chi2_of_side(views.fit(T_map_marker[None])))
    # The standard deviation of the mean is 0.14; beyond the gate are 0.1 % of them.
    assert 0.5 < np.mean(values) < 1.5
    assert np.count_nonzero(np.array(values) > WRONG_SIDE) <= 1


def test_a_side_may_be_as_wrong_as_it_is_declared():
    candidate, _ = from_cameras_in_doubt(0, apart_deg=10.0, side=1.5 * SIZE)
    assert isinstance(candidate.place(OF_WALL, SystematicErrors(corner_px=0.0)), str)
    assert not isinstance(candidate.place(OF_WALL, SystematicErrors(corner_px=0.0, marker_size_std=0.3)), str)


def test_one_view_shows_no_side():
    candidate, _ = from_cameras_in_doubt(0, apart_deg=10.0, side=1.5 * SIZE)
    views = MarkerViews(candidate.views[:1], SIZE, OF_WALL, SystematicErrors())
    assert views.chi2_of_side(views.fit(candidate.views[0].branches[:1])) == 0.0
