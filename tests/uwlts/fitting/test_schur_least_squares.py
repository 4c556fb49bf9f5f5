"""Blocks with a diagonal part are inverted as any matrix, and prior knowledge counts as any observation."""

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import block_diag

from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import LocalPrior, Observation, invert_block, schur_least_squares

HEAD, ALONE = 8, 30


def block(rng, *, head=HEAD, alone=ALONE):
    """Return a normal matrix of ``head`` parameters of all images, and one parameter of each image."""
    matrix = np.zeros((head + alone,) * 2)
    for image in range(alone):
        places = [*range(head), head + image]
        rows = rng.normal(size=(12, len(places)))
        matrix[np.ix_(places, places)] += rows.T @ rows
    return matrix


@pytest.mark.parametrize(("head", "alone"), [(8, 30), (0, 30), (30, 0), (6, 2), (0, 0)])
def test_the_inverse_of_a_block_is_that_of_the_whole_matrix(head, alone):
    matrix = block(np.random.default_rng(3), head=head, alone=alone)
    if not alone:
        rows = np.random.default_rng(4).normal(size=(3 * head, head))
        matrix = rows.T @ rows
    np.testing.assert_allclose(invert_block(matrix, least=1e-9), np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)


def test_a_singular_block_is_refused_wherever_it_is_singular():
    matrix = block(np.random.default_rng(5))
    empty = matrix.copy()
    empty[HEAD + 4] = empty[:, HEAD + 4] = 0.0
    twice = matrix.copy()
    twice[:, 1] = twice[:, 0]
    twice[1] = twice[0]
    for each in (empty, twice):
        with pytest.raises(np.linalg.LinAlgError):
            invert_block(each, least=1e-9)


@pytest.mark.parametrize("soft_limit", [None, 1.5])
def test_prior_knowledge_of_local_parameters_counts_as_an_observation(soft_limit):
    """Of twenty parameters per group, each in its own rows: the solution is the same with dense derivatives."""
    rng, count = np.random.default_rng(6), 20
    by_global, values = rng.normal(size=(2, 6 * count, 3)), rng.normal(size=(2, 6 * count))
    own = np.kron(np.eye(count), np.ones((6, 1)))
    known = rng.normal(size=(2, count))

    def fit(dense):
        def model(group, global_values, local):
            off = values[group] - by_global[group] @ global_values - own @ local
            prior, by_prior = (local - known[group])[:, None] / 0.5, np.eye(count) / 0.5
            rest = Observation(prior, np.zeros((count, 3)), by_prior)
            return [
                Observation(off[:, None], -by_global[group], -own),
                rest if dense else LocalPrior(prior, sparse.csr_array(by_prior)),
            ]

        return schur_least_squares(model, np.zeros(3), [np.zeros(count)] * 2, soft_limit=soft_limit)

    one, other = fit(dense=True), fit(dense=False)
    for name in ("global_values", "covariance", "local", "local_covariances"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-7, atol=1e-9)
    assert one.rounds == other.rounds
    assert one.sigma == pytest.approx(other.sigma)


def test_a_linear_problem_has_the_solution_and_covariance_of_the_normal_equations():
    """Two groups with two parameters each and three common ones, of very different sizes."""
    rng = np.random.default_rng(7)
    by_global, by_local = rng.normal(size=(2, 30, 3)) * [1e-3, 1.0, 50.0], rng.normal(size=(2, 30, 2)) * [0.2, 7.0]
    values = rng.normal(size=(2, 30))

    def model(group, global_values, local):
        off = values[group] - by_global[group] @ global_values - by_local[group] @ local
        return Observation(off[:, None], -by_global[group], -by_local[group])

    found = schur_least_squares(model, np.zeros(3), [np.zeros(2)] * 2)
    whole = np.hstack([by_global.reshape(60, 3), block_diag(*by_local)])
    solution, squares, _, _ = np.linalg.lstsq(whole, values.ravel())
    np.testing.assert_allclose(np.r_[found.global_values, *found.local], solution, rtol=1e-6)
    covariance = squares[0] / (60 - 7) * np.linalg.inv(whole.T @ whole)
    assert found.sigma**2 == pytest.approx(squares[0] / (60 - 7))
    np.testing.assert_allclose(found.covariance, covariance[:3, :3], rtol=1e-6)
    np.testing.assert_allclose(found.local_covariances[1], covariance[5:, 5:], rtol=1e-6)
    with pytest.raises(CalibrationError, match="behind"):
        schur_least_squares(lambda *_: None, np.zeros(3), [np.zeros(2)])


def curve(residual, derivative, *, feasible=lambda x: True):
    """Return the model of one residual of one global parameter, and of another that is zero, without local ones."""

    def model(_, values, local):
        x = values[0]
        if not feasible(x):
            return None
        return Observation(np.array([[residual(x)], [0.0]]), np.array([[derivative(x)], [0.0]]), np.zeros((2, 0)))

    return model


def test_steps_that_raise_the_cost_or_are_infeasible_are_damped():
    """From 2, Gauss-Newton's step of atan(x) leads to -3.5 and on to infinity; that of log(x) from 5 to -3.05."""
    overshooting = curve(np.arctan, lambda x: 1 / (1 + x * x))
    bounded = curve(np.log, lambda x: 1 / x, feasible=lambda x: x > 0)
    for model, start, end in ((overshooting, 2.0, 0.0), (bounded, 5.0, 1.0)):
        found = schur_least_squares(model, np.array([start]), [np.zeros(0)])
        assert found.global_values[0] == pytest.approx(end, abs=1e-6)


def test_a_border_of_what_is_feasible_ends_the_iteration():
    """No step towards the minimum at 0 is feasible: damping grows from 1e-4 to beyond 1e8 in 13 rounds."""
    found = schur_least_squares(curve(lambda x: x, lambda x: 1.0, feasible=lambda x: x >= 1), np.ones(1), [np.zeros(0)])
    assert found.global_values[0] == 1.0 and found.stopped == "no step lowers the cost further"
    assert found.rounds == 14
