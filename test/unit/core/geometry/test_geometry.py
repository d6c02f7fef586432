"""Rotations and rigid transforms against independent formulas."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from thermal_fiducial.core.geometry import se3

ANGLES = [0.0, 1e-12, 1e-6, 0.99e-2, 1.01e-2, 0.5, 2.0, np.pi - 1e-7, np.pi]
AXIS = np.array([0.48, -0.6, 0.64])


@pytest.mark.parametrize('angle', ANGLES)
def test_exp_is_the_matrix_exponential(angle):
    assert np.allclose(se3.so3_exp(angle * AXIS), expm(se3.skew(angle * AXIS)), atol=1e-14)


@pytest.mark.parametrize('angle', ANGLES)
def test_exp_and_log_agree_with_scipy(angle):
    R = Rotation.from_rotvec(angle * AXIS)
    assert np.allclose(se3.so3_exp(angle * AXIS), R.as_matrix(), atol=1e-15)
    # At half a turn the sign of the axis is free: what counts is that it is the same rotation.
    assert np.allclose(se3.so3_exp(se3.so3_log(R.as_matrix())), R.as_matrix(), atol=1e-14)
    assert np.linalg.norm(se3.so3_log(R.as_matrix())) == pytest.approx(angle, abs=2e-8)


@pytest.mark.parametrize('angle', [0.0, 1e-9, 0.99e-2, 1.01e-2, 0.7, 3.0, 5.5])
def test_the_left_jacobian_is_the_derivative_of_exp(angle):
    phi, h = angle * AXIS, 1e-6
    J = se3.so3_left_jacobian(phi)
    # Rounding, times the inverse's size: 10 where 5.5 rad are near to a whole turn.
    np.testing.assert_allclose(J @ se3.so3_left_jacobian_inverse(phi), np.eye(3), atol=1e-13)
    for k in range(3):
        d = h * np.eye(3)[k]
        forward, backward = (se3.so3_exp(phi + s * d) @ se3.so3_exp(phi).T for s in (1, -1))
        numeric = (se3.so3_log(forward) - se3.so3_log(backward)) / (2 * h)
        # Central differences: h^2 / 6 times a third derivative of order one, and 1e-16 / h of rounding.
        assert np.allclose(J[:, k], numeric, atol=1e-9)


def test_the_series_meet_the_closed_forms():
    """On both sides of the switch the functions agree to what they change in between."""
    below, above = np.nextafter(se3.SMALL_ANGLE, 0.0) * AXIS, np.nextafter(se3.SMALL_ANGLE, 1.0) * AXIS
    for function in (se3.so3_exp, se3.so3_left_jacobian, se3.so3_left_jacobian_inverse):
        # The closed form of 1/a^2 - 1/(2 a tan) cancels to 1e-16 / a^2 = 1e-12 here, times a^2 in the matrix.
        assert np.allclose(function(below), function(above), atol=1e-14)


def test_quaternions_are_those_of_scipy():
    rotations = Rotation.random(500, random_state=1)
    q = se3.quaternion_from_rotation(rotations.as_matrix())
    assert np.allclose(q, rotations.as_quat(canonical=True), atol=1e-14)
    assert np.allclose(se3.rotation_from_quaternion(q), rotations.as_matrix(), atol=1e-14)
    assert np.allclose(se3.rotation_from_quaternion(-3.0 * q), rotations.as_matrix(), atol=1e-14)


@pytest.mark.parametrize('half_turn', [np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])])
def test_half_turns(half_turn):
    q = se3.quaternion_from_rotation(half_turn)
    assert np.allclose(se3.rotation_from_quaternion(q), half_turn, atol=1e-15)
    assert se3.rotation_angle(half_turn) == pytest.approx(np.pi)


def test_the_turn_between_poses_is_that_of_either_seen_from_the_other():
    first, other = (se3.transform(se3.so3_exp(w), [1.0, -2.0, 0.5]) for w in ([0.4, -1.0, 0.3], [0.9, 0.2, -0.7]))
    turned = first @ se3.transform(se3.so3_exp([0.3, 0.0, 0.4]), [5.0, 0.0, 0.0])
    angles = se3.turn_between(first, np.stack([first, turned, other]))
    np.testing.assert_allclose(angles[:2], [0.0, 0.5], atol=1e-12)
    assert se3.turn_between(other, first) == pytest.approx(angles[2], abs=1e-12)


def test_transforms_chain_as_their_names_do():
    T_a_b = se3.transform(se3.so3_exp([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    T_b_c = se3.transform(se3.so3_exp([-0.4, 0.0, 1.0]), [0.0, -1.0, 0.5])
    p_c = np.array([[0.3, 0.2, 0.1], [5.0, 0.0, -1.0]])
    assert np.allclose(se3.apply(T_a_b @ T_b_c, p_c), se3.apply(T_a_b, se3.apply(T_b_c, p_c)))
    assert np.allclose(se3.inverse(T_a_b) @ T_a_b, np.eye(4), atol=1e-15)
    # The origin of b in a.
    assert np.allclose(se3.apply(T_a_b, np.zeros((1, 3))), [[1.0, 2.0, 3.0]])


def test_transform_from_quaternion():
    T = se3.transform_from_quaternion([1.0, 2.0, 3.0], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    assert np.allclose(se3.apply(T, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]])


def test_batches_are_single_calls_side_by_side():
    rng = np.random.default_rng(2)
    phi = rng.normal(size=(4, 5, 3))
    phi[1, 2] = 0.0
    p = rng.normal(size=(4, 5, 3))
    T = se3.transform(se3.so3_exp(phi), p)
    points = rng.normal(size=(4, 5, 7, 3))
    q = se3.quaternion_from_rotation(T[..., :3, :3])
    for i in np.ndindex(4, 5):
        assert np.allclose(T[i], se3.transform(se3.so3_exp(phi[i]), p[i]))
        assert np.allclose(se3.inverse(T)[i], se3.inverse(T[i]))
        assert np.allclose(se3.apply(T, points)[i], se3.apply(T[i], points[i]))
        assert np.allclose(se3.so3_log(T[..., :3, :3])[i], se3.so3_log(T[i][:3, :3]))
        assert np.allclose(q[i], se3.quaternion_from_rotation(T[i][:3, :3]))
        assert np.allclose(se3.so3_left_jacobian_inverse(phi)[i], se3.so3_left_jacobian_inverse(phi[i]))


def test_skew_is_the_cross_product():
    v, w = np.random.default_rng(3).normal(size=(2, 10, 3))
    assert np.allclose((se3.skew(v) @ w[..., None])[..., 0], np.cross(v, w))


def test_one_rotation_gives_the_quaternion_that_a_batch_gives():
    rng = np.random.default_rng(5)
    phi = rng.normal(size=(300, 3))
    phi[::3] *= np.pi / np.linalg.norm(phi[::3], axis=1, keepdims=True)
    phi[1::7] *= 1e-9
    R = se3.so3_exp(phi)
    batch = se3.quaternion_from_rotation(R)
    single = np.array([se3.quaternion_from_rotation(one) for one in R])
    assert np.all(single[:, 3] >= 0.0)
    # The same formulas in doubles; at half a turn the sign is free.
    sign = np.where(np.sum(batch * single, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    np.testing.assert_allclose(sign * single, batch, atol=1e-15)


def test_difference_undoes_retract():
    rng = np.random.default_rng(1)
    T = se3.transform(se3.so3_exp(rng.normal(size=(20, 3))), rng.normal(size=(20, 3)))
    d = np.clip(rng.normal(size=(20, 6)), -1.7, 1.7)  # rotations below pi
    np.testing.assert_allclose(se3.difference(se3.retract(T, d), T), d, atol=1e-12)


def test_a_screw_about_a_point_leaves_it_where_it_is():
    rng = np.random.default_rng(7)
    T, point, turn = (
        se3.transform(se3.so3_exp(rng.normal(size=3)), rng.normal(size=3)),
        rng.normal(size=3),
        rng.normal(size=3),
    )
    d = np.concatenate((np.cross(turn, T[:3, 3] - point), turn))
    moved = se3.screwed(T, d)
    # As a point of the camera.
    inside = T[:3, :3].T @ (point - T[:3, 3])
    np.testing.assert_allclose(moved[:3, :3] @ inside + moved[:3, 3], point, atol=1e-12)
    np.testing.assert_allclose(se3.screw_difference(moved, T), d, atol=1e-12)
    # Half of it twice is all of it, with the half seen from where the first one ends.
    half = se3.screwed(T, 0.5 * d)
    np.testing.assert_allclose(se3.screwed(half, se3.lever_arm(half[:3, 3] - T[:3, 3]) @ (0.5 * d)), moved, atol=1e-12)
    small = 1e-4 * d
    # Of second order.
    np.testing.assert_allclose(se3.screwed(T, small), se3.retract(T, small), atol=1e-7)


def test_weighted_alignments_are_those_of_the_points_that_count():
    """Many at once, about a place far from the origin; turned, and mirrored, which no rotation undoes."""
    rng = np.random.default_rng(4)
    source = rng.normal([20.0, -30.0, 5.0], 1.0, (12, 3))
    T = se3.transform(se3.so3_exp([0.3, -1.0, 2.0]), [1.0, 2.0, 3.0])
    target = se3.apply(T, source) + 0.01 * rng.normal(size=source.shape)
    counts = rng.random((6, 12)) < 0.5
    counts[:, :4] = True
    for there in (target, target * [1.0, 1.0, -1.0]):
        found = se3.rigid_alignment(there, source, counts)
        for some, one in zip(counts, found, strict=True):
            # A turn that is off by rounding, 1e-15, moves a place 40 m away by 4e-14.
            np.testing.assert_allclose(one, se3.rigid_alignment(there[some], source[some]), atol=1e-12)
            assert np.linalg.det(one[:3, :3]) == pytest.approx(1.0, abs=1e-12)
    # A point twice is a weight of two.
    twice = np.concatenate([np.arange(12), [3]])
    weights = np.where(np.arange(12) == 3, 2.0, 1.0)
    of_two = se3.rigid_alignment(target[twice], source[twice])
    np.testing.assert_allclose(se3.rigid_alignment(target, source, weights), of_two, atol=1e-12)
