"""Uncertainties after a candidate, compared with a least-squares estimate that contains it."""

import numpy as np
import pytest

from uwlts.fitting.next_observation import Candidate, CovarianceRoot, Forecast, eliminate_others, rank_candidates

RNG = np.random.default_rng(5)
BY_PARAMETERS = RNG.normal(size=(40, 4)) * [1.0, 1e3, 1e-3, 1.0]
BY_LOCAL = RNG.normal(size=(40, 3))
LENGTHS = RNG.normal(size=(2, 4)) * [1.0, 1e3, 1e-3, 1.0]


def inverse(information):
    """Inverse without an elimination, by a pseudo-inverse of the scaled matrix."""
    scale = 1 / np.sqrt(np.diag(information))
    return np.linalg.pinv(information * np.outer(scale, scale)) * np.outer(scale, scale)


def named(information):
    """Return candidates from the diagonals of the information that they add."""
    return [Candidate(words=name, information=np.diag(own), pose=np.eye(4)) for name, own in information.items()]


def test_uncertainty_after_a_candidate_is_that_of_the_estimate_with_it():
    """Local parameters of the candidate, such as a pose, are unknown before it."""
    first, rows = np.vstack([BY_PARAMETERS[:30]]), np.hstack([BY_PARAMETERS[30:], BY_LOCAL[30:]])
    together = np.zeros((7, 7))
    together[:4, :4] = first.T @ first
    covariance = inverse(together + rows.T @ rows)[:4, :4]
    before = CovarianceRoot.from_covariance(inverse(first.T @ first))
    after = before.with_information(eliminate_others(rows.T @ rows, 4))
    np.testing.assert_allclose(after.std(LENGTHS), np.sqrt(np.diag(LENGTHS @ covariance @ LENGTHS.T)), rtol=1e-9)
    np.testing.assert_allclose(CovarianceRoot.from_information(first.T @ first).std(LENGTHS), before.std(LENGTHS))


def test_a_parameter_without_information_is_uncertain_until_a_candidate_determines_it():
    known = CovarianceRoot.from_information(np.array([[1.0, 1.0], [1.0, 1.0]]))
    assert known.std(np.array([[1.0, -1.0]]))[0] > 1e6
    # Half the difference has the standard uncertainty 1, the sum 1: their squares add up to the difference's.
    after = known.with_information(np.array([[1.0, -1.0], [-1.0, 1.0]]) / 4)
    assert after.std(np.array([[1.0, -1.0], [1.0, 1.0]])) == pytest.approx([2.0, 1.0])


def test_the_candidate_for_the_wanted_lengths_is_first():
    """Of two candidates, each determines one of two parameters; only the second changes the length."""
    length, known = np.array([[0.0, 1.0]]), CovarianceRoot(np.eye(2))
    one, other = named({"a": [99, 0], "b": [0, 3]})
    best, last = rank_candidates(known, length, [one, other])
    assert (best.candidate, best.before, best.after) == (other, 1.0, pytest.approx(0.5))
    assert (last.candidate, last.gain) == (one, pytest.approx(0.0))
    # By the trace of the covariance, the first is more helpful.
    assert rank_candidates(known, np.eye(2), [one, other])[0].candidate is one


def test_a_candidate_is_advised_if_it_lowers_the_uncertainty_by_a_twentieth():
    (shot,), after = named({"a shot": [1]}), CovarianceRoot(np.eye(1))
    assert Forecast(shot, 0.1, 0.0949, after).advice("lengths over the volume") == (
        "a shot would reduce the standard uncertainty of lengths over the volume from 0.1000 to 0.0949 mm"
    )
    assert Forecast(shot, 0.1, 0.0951, after).advice("lengths").startswith("no single further image would reduce")


def test_the_second_of_two_passes_is_ranked_after_the_first():
    """Two passes determine the same parameter better than a third determines the other: one of each is chosen."""
    known, lengths = CovarianceRoot(np.eye(2)), np.eye(2)
    passes = named({"shift": [99, 0], "long shift": [120, 0], "lift": [0, 50]})
    first = rank_candidates(known, lengths, passes)[0]
    second = rank_candidates(first.known, lengths, [each for each in passes if each is not first.candidate])[0]
    assert (first.candidate.words, second.candidate.words) == ("long shift", "lift")
    assert second.before == first.after
    np.testing.assert_allclose(second.known.covariance(), np.diag([1 / 121, 1 / 51]))
