"""Latency between camera and stage from drawn passes in both directions, with its stated uncertainty."""

import numpy as np
import pytest

from uwlts.errors import EvaluationError
from uwlts.reconstruction.latency import measure_latency

SPEED = 20.0  # mm/s
POSITIONS = np.arange(-30.0, 30.0, 0.5)
LINES = np.arange(120)
GRAIN = 4
"""Neighbouring lines with the same error, as in speckle."""


def waves(position: np.ndarray) -> np.ndarray:
    """Return stripe centres (N, L), px, of a surface of waves at positions (N,)."""
    return 500 + 30 * np.sin(position[:, None] / 9 + LINES / 70) + 0.1 * LINES


def passes(rng: np.random.Generator, *, latency_s: float, noise_px: float):
    """Draw centres, reported positions and signed speeds of a forward and a backward pass."""
    reported = np.concatenate([POSITIONS, POSITIONS[::-1]])
    speed = np.repeat([SPEED, -SPEED], len(POSITIONS))
    noise = np.repeat(rng.normal(0, noise_px, (len(reported), len(LINES) // GRAIN)), GRAIN, axis=1)
    return waves(reported + speed * latency_s) + noise, reported, speed


@pytest.mark.parametrize("latency_s", [0.013, -0.21])
def test_latency_of_passes_without_noise(latency_s):
    """Cubic interpolation of waves of 56 mm length, with frames 0.5 mm apart, is exact to microseconds."""
    found, _ = measure_latency(*passes(np.random.default_rng(0), latency_s=latency_s, noise_px=0.0))
    assert found == pytest.approx(latency_s, abs=2e-6)


def test_stated_uncertainty_of_the_latency_is_that_of_draws():
    """The rms of 30 errors, divided by the stated uncertainty, is known to 13 %; errors have no common part."""
    errors, stated = [], []
    for seed in range(30):
        found, std = measure_latency(*passes(np.random.default_rng(seed), latency_s=0.02, noise_px=0.2))
        errors.append(found - 0.02)
        stated.append(std)
    assert 0.7 < np.sqrt(np.mean(np.square(errors))) / np.mean(stated) < 1.4
    assert abs(np.mean(errors)) < 4 * np.mean(stated) / np.sqrt(30)


def test_one_pass_or_a_flat_surface_tells_no_latency():
    centres, reported, speed = passes(np.random.default_rng(0), latency_s=0.02, noise_px=0.1)
    one = speed > 0
    with pytest.raises(EvaluationError, match="0 of the backward pass"):
        measure_latency(centres[one], reported[one], speed[one])
    with pytest.raises(EvaluationError, match="relief"):
        measure_latency(np.full_like(centres, 500.0), reported, speed)
