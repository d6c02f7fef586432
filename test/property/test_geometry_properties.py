"""What holds for every rotation and transform."""

from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np

from thermal_fiducial.core.geometry import se3

coordinates = st.floats(-10.0, 10.0, allow_subnormal=False)
vectors = arrays(np.float64, 3, elements=coordinates)
directions = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
angles = st.one_of(st.floats(0.0, 3.1), st.floats(0.0, 0.03), st.sampled_from([0.0, 1e-15, 1e-9, se3.SMALL_ANGLE]))
rotation_vectors = st.builds(lambda axis, angle: angle * axis, directions, angles)
quaternions = arrays(np.float64, 4, elements=coordinates).filter(lambda q: np.linalg.norm(q) > 1e-3)
transforms = st.builds(lambda phi, p: se3.transform(se3.so3_exp(phi), p), rotation_vectors, vectors)


@given(rotation_vectors)
def test_log_inverts_exp(phi):
    # Below pi; towards it the angle's error grows as 1e-16 / (pi - angle), 1e-15 here.
    assert np.allclose(se3.so3_log(se3.so3_exp(phi)), phi, atol=1e-13)


@given(rotation_vectors)
def test_exp_is_a_rotation(phi):
    R = se3.so3_exp(phi)
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.isclose(np.linalg.det(R), 1.0)
    assert np.allclose(R @ phi, phi, atol=1e-13)
    assert np.allclose(se3.so3_exp(-phi), R.T, atol=1e-15)


@given(rotation_vectors, rotation_vectors)
def test_jacobian_carries_small_turns(phi, d):
    d = 1e-6 * d
    exact = se3.so3_exp(phi + d)
    linear = se3.so3_exp(np.linalg.solve(se3.so3_left_jacobian_inverse(phi), d)) @ se3.so3_exp(phi)
    # Second order in d, which is up to 3e-6 long.
    assert np.allclose(exact, linear, atol=2e-11)


@given(quaternions)
def test_quaternions_return(q):
    R = se3.rotation_from_quaternion(q)
    back = se3.quaternion_from_rotation(R)
    unit = q / np.linalg.norm(q)
    assert back[3] >= 0.0
    assert np.isclose(np.linalg.norm(back), 1.0)
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 1e-13
    assert se3.rotation_angle(R) <= np.pi + 1e-12


@given(transforms, transforms, vectors)
def test_transforms_are_a_group(T_a_b, T_b_c, p_c):
    assert np.allclose(se3.inverse(T_a_b @ T_b_c), se3.inverse(T_b_c) @ se3.inverse(T_a_b), atol=1e-12)
    p_a = se3.apply(T_a_b @ T_b_c, p_c[None])
    assert np.allclose(se3.apply(se3.inverse(T_a_b @ T_b_c), p_a), p_c, atol=1e-12)


@given(transforms, vectors, vectors)
def test_transforms_keep_distances(T, p, q):
    moved = se3.apply(T, np.stack([p, q]))
    assert np.isclose(np.linalg.norm(moved[0] - moved[1]), np.linalg.norm(p - q), atol=1e-12)
