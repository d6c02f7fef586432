"""Schur complement, solutions and covariances of a bundle adjustment, against its system in one piece."""

from types import SimpleNamespace

import numpy as np
import pytest

from thermal_fiducial.core.mapping import normal_equations
from thermal_fiducial.core.mapping.normal_equations import Blocks, inverse_of_triangular, NormalEquations, Vectors

#: Unknowns of six each, and those that all have in common.
FRAMES, MARKERS, COMMON = 7, 5, 2
APART = 6 * (FRAMES + MARKERS)


def system(seed, held):
    """Equations, their blocks, and J' J in one piece, of keyframes that see two to four markers each."""
    rng = np.random.default_rng(seed)
    shown = [rng.choice(MARKERS, size=rng.integers(2, 5), replace=False) for _ in range(FRAMES)]
    frame = np.repeat(np.arange(FRAMES), [len(markers) for markers in shown])
    marker = np.concatenate(shown)
    J_frame, J_marker = rng.normal(size=(2, len(frame), 8, 6))
    J_common = rng.normal(size=(len(frame), 8, COMMON))
    whole = np.zeros((APART + COMMON, APART + COMMON))
    for f, m, of_frame, of_marker, of_common in zip(frame, marker, J_frame, J_marker, J_common, strict=True):
        J = np.zeros((8, len(whole)))
        J[:, APART:] = of_common
        J[:, 6 * f : 6 * f + 6] = of_frame
        J[:, 6 * (FRAMES + m) : 6 * (FRAMES + m) + 6] = of_marker
        whole += J.T @ J
    each = np.arange(FRAMES + MARKERS)
    own = whole[:APART, :APART].reshape(len(each), 6, len(each), 6)[each, :, each]
    blocks = Blocks(own[:FRAMES], own[FRAMES:], np.swapaxes(J_frame, 1, 2) @ J_marker, parts(whole[:, APART:]))
    return NormalEquations(frame, marker, held), blocks, whole


def parts(vectors):
    """Vectors (n, K) of all unknowns, by their kinds."""
    count = vectors.shape[1]
    frames, nodes, common = np.split(vectors, [6 * FRAMES, APART])
    return Vectors(frames.reshape(-1, 6, count), nodes.reshape(-1, 6, count), common)


def joined(vectors):
    """The reverse of :func:`parts`."""
    return np.concatenate([part.reshape(-1, part.shape[-1]) for part in vectors])


def unknowns(held):
    """Which rows of the system in one piece are those of keyframes, free markers, and what is common."""
    apart = np.repeat(np.concatenate([np.ones(FRAMES, dtype=bool), ~held]), 6)
    return np.flatnonzero(np.concatenate([apart, np.ones(COMMON, dtype=bool)]))


def only(*markers):
    held = np.zeros(MARKERS, dtype=bool)
    held[list(markers)] = True
    return held


@pytest.fixture(params=['dense', 'sparse'])
def way(request, monkeypatch):
    """Each of the ways to solve: of small maps, and of large ones."""
    # Three parts of the keyframes, of which the last has one.
    monkeypatch.setattr(normal_equations, '_TOGETHER', 3)
    if request.param == 'sparse':
        monkeypatch.setattr(normal_equations, '_DENSE', 0)
        # One marker's columns of the inverse at a time.
        monkeypatch.setattr(normal_equations, '_ENTRIES', 0)


@pytest.mark.usefixtures('way')
@pytest.mark.parametrize('held', [only(0), only(1, 3)])
def test_the_solution_is_that_of_the_system_in_one_piece(held):
    equations, blocks, whole = system(1, held)
    rng, free = np.random.default_rng(2), unknowns(held)
    right = rng.normal(size=(APART + COMMON, 2))
    solution = equations.reduced(blocks).solve(parts(right))
    expected, found = np.linalg.solve(whole[np.ix_(free, free)], right[free]), joined(solution)
    # The ridge is 1e-12 of the largest entry; the condition of these systems is below a thousand.
    np.testing.assert_allclose(found[free], expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max())
    assert not solution.nodes[held].any()


@pytest.mark.usefixtures('way')
def test_the_covariances_are_those_of_the_free_markers_in_the_inverse():
    held = only(2)
    equations, blocks, whole = system(3, held)
    free = unknowns(held)
    inverse = np.linalg.inv(whole[np.ix_(free, free)])
    reduced = equations.reduced(blocks)
    covariances = reduced.covariances(reduced.covariance)
    for place, marker in enumerate(np.flatnonzero(~held)):
        rows = slice(6 * (FRAMES + place), 6 * (FRAMES + place) + 6)
        np.testing.assert_allclose(covariances[marker], inverse[rows, rows], rtol=1e-8, atol=1e-12)
    assert not covariances[2].any()


@pytest.mark.usefixtures('way')
def test_draws_have_the_covariance_of_the_free_markers():
    held = only(2)
    equations, blocks, whole = system(8, held)
    apart = unknowns(held)[:-COMMON]
    free = slice(6 * FRAMES, len(apart))
    expected = np.linalg.inv(whole[np.ix_(apart, apart)])[free, free]
    # Draws are linear in independent variables: of each alone they are the columns of a root of the covariance.
    each = SimpleNamespace(standard_normal=lambda shape: np.eye(*shape))
    root = equations.reduced(blocks).drawn(np.zeros((COMMON, len(expected))), each)[~held].reshape(expected.shape)
    np.testing.assert_allclose(root @ root.T, expected, rtol=1e-8, atol=1e-10)


def test_a_triangular_matrix_is_inverted_by_halves():
    rng = np.random.default_rng(9)
    # Halved twice, unequally.
    A = rng.normal(size=(301, 301))
    L = np.linalg.cholesky(A @ A.T + 301.0 * np.eye(301))
    inverse = inverse_of_triangular(L)
    # Its condition is below ten.
    np.testing.assert_allclose(inverse @ L, np.eye(301), rtol=0.0, atol=1e-13)
    assert not np.triu(inverse, 64).any()


def test_damping_adds_to_the_diagonals_of_keyframes_and_markers():
    held = only(0)
    equations, blocks, whole = system(5, held)
    free = unknowns(held)
    right = np.random.default_rng(6).normal(size=(APART + COMMON, 1))
    found = joined(equations.reduced(blocks, damping=0.5).solve(parts(right)))[free]
    # What is common has a prior that keeps it in place.
    added = 0.5 * np.diag(whole) * (np.arange(len(whole)) < APART)
    expected = np.linalg.solve((whole + np.diag(added))[np.ix_(free, free)], right[free])
    np.testing.assert_allclose(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize('of', ['frame', 'node'])
def test_a_system_that_is_not_positive_definite_has_no_solution(of):
    """A keyframe or a marker with less than no information, as rounding may leave it."""
    equations, blocks, _ = system(7, only(0))
    getattr(blocks, of)[3] = -np.eye(6)
    assert equations.reduced(blocks) is None


@pytest.mark.usefixtures('way')
@pytest.mark.parametrize('held', [only(0), only(1, 3)])
def test_the_others_follow_the_held_markers(held):
    equations, blocks, whole = system(4, held)
    drawn = np.random.default_rng(5).normal(size=(MARKERS, 6, 3))
    found = equations.reduced(blocks).by_held(drawn)
    assert np.array_equal(found.nodes[held], drawn[held])
    free = unknowns(held)
    moved = np.zeros((APART + COMMON, 3))
    moved[6 * FRAMES : APART] = np.where(held[:, None, None], drawn, 0.0).reshape(-1, 3)
    expected = moved.copy()
    expected[free] -= np.linalg.solve(whole[np.ix_(free, free)], (whole @ moved)[free])
    # As for the solutions above.
    assert np.allclose(joined(found)[6 * FRAMES :], expected[6 * FRAMES :], rtol=0.0, atol=1e-7)
