"""Spread of light in translucent bodies against the stationary diffusion kernel and random walks of photons."""

import math

import numpy as np
import pytest
from scipy.integrate import quad

from twin.scene.surfaces import internal_reflectance, lateral_spread

CASES = [(0.3, 0.7, 1.0), (0.3, 0.5, 1.157), (1.0, 0.12, 1.0), (0.1, 0.9, 1.1)]


def line_spread(offset: np.ndarray, *, decay: float, index: float) -> np.ndarray:
    """Light that leaves per length at offsets (N,) from a lit line, in units of the transport mean free path.

    The stationary flux of a dipole in space (Farrell et al. 1992, Eq. 14), integrated along the line and over the depth
    of the first scattering, which is distributed exponentially.
    """
    inwards = internal_reflectance(index)
    apart = 4 / 3 * (1 + inwards) / (1 - inwards)
    along = np.concatenate([[0.0], np.geomspace(1e-3, 60, 300)])
    # Depths at the middles of 400 intervals of equal light.
    first = -np.log(1 - (np.arange(400) + 0.5) / 400)
    total = np.zeros((len(offset), len(along)))
    for depths in (first, first + apart):
        for depth in depths:
            r = np.sqrt(offset[:, None] ** 2 + along**2 + depth**2)
            total += depth * (decay + 1 / r) * np.exp(-decay * r) / r**2 / (4 * math.pi * len(first))
    return np.asarray(2 * np.trapezoid(total, along, axis=1))


@pytest.mark.parametrize("case", CASES, ids=str)
def test_the_gaussians_are_the_stationary_diffusion_kernel(case):
    path, reflectance, index = case
    spread = lateral_spread(mean_free_path_mm=path, reflectance=reflectance, index=index)
    assert spread.weights.sum() == pytest.approx(1)
    offset = np.geomspace(1e-3, 60, 160)
    offset = np.concatenate([-offset[::-1], [0.0], offset])
    kernel = line_spread(offset, decay=spread.decay, index=index)
    # The light that leaves is what the stated reflectance lets out, for the albedo of this decay.
    inwards = internal_reflectance(index)
    leaving = (1 - spread.decay**2 / 3) * np.trapezoid(kernel, offset)
    assert leaving == pytest.approx(reflectance * (1 - inwards) / (1 - reflectance * inwards), rel=0.01)
    # After a sheet with the standard deviation of one mean free path.
    away = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0])[:, None]
    seen = np.exp(-0.5 * (away - offset) ** 2) / math.sqrt(2 * math.pi)
    expected = np.trapezoid(kernel * seen, offset) / np.trapezoid(kernel, offset)
    variance = 1 + spread.variances_mm2 / path**2
    found = (np.exp(-0.5 * away**2 / variance) / np.sqrt(2 * np.pi * variance)) @ spread.weights
    # As stated for the sum of Gaussians: 2 % of the peak.
    np.testing.assert_allclose(found, expected, rtol=0, atol=0.02 * expected[0])
    assert expected[0] < 0.95 / math.sqrt(2 * math.pi), "the body must widen the stripe, or nothing is tested"


def test_internal_reflectance_is_the_average_of_fresnels_formula():
    for index in (1.1, 1.3, 1.5):

        def reflected(cosine: float, index: float = index) -> float:
            inside = 1 - index**2 * (1 - cosine**2)
            if inside <= 0:
                return 2 * cosine
            outside = math.sqrt(inside)
            across = (index * cosine - outside) / (index * cosine + outside)
            along = (cosine - index * outside) / (cosine + index * outside)
            return (across**2 + along**2) * cosine

        # The fit is said to be good to 2 % of the light.
        assert internal_reflectance(index) == pytest.approx(quad(reflected, 0, 1, limit=200)[0], abs=0.03)
    assert internal_reflectance(1.0) == 0


def walk_photons(*, albedo: float, sine: float, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Exit positions along the tilt (N,) in mean free paths, and weights (N,), of photons scattered isotropically.

    The body fills z > 0, has the index of its surroundings, and is met by a pencil beam at the origin.
    """
    place = np.zeros((count, 3))
    towards = np.tile([sine, 0.0, math.sqrt(1 - sine**2)], (count, 1))
    weight, exits, weights = np.ones(count), [], []
    while len(place):
        place = place + towards * rng.exponential(size=(len(place), 1))
        out = place[:, 2] < 0
        # Back along the path to the surface.
        exits.append(place[out, 0] - towards[out, 0] * place[out, 2] / towards[out, 2])
        weights.append(weight[out])
        weight = weight[~out] * albedo
        place = place[~out]
        kept = weight > 1e-3
        place, weight = place[kept], weight[kept]
        towards = rng.standard_normal((len(place), 3))
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    return np.concatenate(exits), np.concatenate(weights)


@pytest.mark.parametrize("albedo", [0.9, 0.97])
def test_light_shift_and_width_are_those_of_photons(albedo):
    # Reflectance of normal incidence, in the diffusion approximation, for a body of this albedo.
    u = math.sqrt(3 * (1 - albedo))
    reflectance = albedo * (1 + math.exp(-4 / 3 * u)) / (2 + 2 * u)
    spread = lateral_spread(mean_free_path_mm=1.0, reflectance=reflectance, index=1.0)
    count, sine = 60_000, 0.6
    exits, weights = walk_photons(albedo=albedo, sine=0.0, count=count, rng=np.random.default_rng(0))
    # The approximation itself is good to some percent if light is scattered many times; noise is below 1 %.
    assert weights.sum() / count == pytest.approx(reflectance, rel=0.06)
    width = math.sqrt(np.average(exits**2, weights=weights))
    assert math.sqrt(spread.weights @ spread.variances_mm2) == pytest.approx(width, rel=0.10)
    exits, weights = walk_photons(albedo=albedo, sine=sine, count=count, rng=np.random.default_rng(1))
    expected = spread.path_mm * sine / (1 + spread.decay * math.sqrt(1 - sine**2))
    assert np.average(exits, weights=weights) == pytest.approx(expected, rel=0.08)
