"""The profile fit: unbiased, near the Cramer-Rao bound in shot and read noise, least noisy method in speckle."""

import math
from typing import get_args

import numpy as np
import pytest

from tests.uwlts.stripe.test_stripe import LENGTH, gaussian, grey, phases, position_bound
from uwlts.cli.command_options import MethodName
from uwlts.stripe import StripeOptions, StripeStatus, extract_stripe, method_names

FIT = "profile-fit"


def centres(image, method=FIT):
    found = extract_stripe(image, stripe_along="height", options=StripeOptions(method=method, end_lines=0))
    assert (found.status == StripeStatus.OK).mean() > 0.99
    return found.centre_px


def test_it_is_the_default_and_the_command_knows_all_methods():
    assert StripeOptions().method == "profile-fit"
    assert get_args(MethodName) == method_names()


@pytest.mark.parametrize(
    ("sigma", "limit"), [(0.45, 0.004), (0.64, 0.001), (1.0, 0.001), (1.7, 0.001), (3.0, 0.002), (4.0, 0.008)]
)
@pytest.mark.parametrize("slope", [-0.1, 0.0, 0.1])
def test_unbiased_over_phase_width_and_background(sigma, limit, slope):
    centre = phases(128)
    profile = gaussian(centre, sigma=sigma, amplitude=150) + 30 + slope * np.arange(LENGTH)
    error = centres(profile.astype(np.float32)) - centre
    # Sigma 0.45: without the mean of the Gaussian over the pixel, the error would be 0.008 px. Sigma 4: the
    # flanks hold a few thousandths of the stripe, unevenly by the phase. A slope b left in would shift by
    # 2^1.5 b s^2 / A, 0.008 px at sigma 2; the width found from tilted half heights leaves up to a tenth part more,
    # as for the zero crossing, growing with s^2.
    tilt = 2**1.5 * abs(slope) * sigma**2 / 150
    assert np.abs(error).max() < limit + 0.6 * tilt
    assert abs(error.mean()) < 0.0003 + 0.5 * tilt


@pytest.mark.parametrize(("sigma", "over"), [(1.0, 1.5), (2.0, 2.0), (2.0, 5.0), (3.0, 4.0)])
def test_saturation(sigma, over):
    centre = phases(128)
    image = grey(gaussian(centre, sigma=sigma, amplitude=255 * over) + 20)
    assert (np.count_nonzero(image == 255, axis=1) >= 2).mean() > 0.5
    error = centres(image) - centre
    # The flanks determine the position of a clipped stripe: half the largest error of the zero crossing (0.06 px).
    assert np.abs(error).max() < 0.03
    assert abs(error.mean()) < 0.001


# Efficiency: the bound's variance over the centre's, measured 0.75 to 0.95 in shot and read noise and 0.66 to 0.79 in
# white noise; the flanks that stand for the unknown background cost wide stripes most. Less five standard errors of a
# variance of 3000 samples, 5 sqrt(2 / 3000) = 13 %.
@pytest.mark.parametrize(
    ("sigma", "shot", "white"), [(0.7, 0.8, 0.55), (1.0, 0.8, 0.65), (2.0, 0.73, 0.67), (4.0, 0.64, 0.58)]
)
@pytest.mark.parametrize(("amplitude", "read", "gain"), [(200, 0.6, 0.0255), (200, 0.6, 0.1), (150, 2.0, 0.0)])
def test_near_the_cramer_rao_bound(sigma, shot, white, amplitude, read, gain):
    rng = np.random.default_rng(1)
    centre = LENGTH / 2 + rng.uniform(-0.5, 0.5, 3000)
    profile = gaussian(centre, sigma=sigma, amplitude=amplitude)
    noise = np.sqrt(read**2 + gain * profile) * rng.standard_normal(profile.shape)
    error = centres((profile + 20 + noise).astype(np.float32)) - centre
    efficiency = position_bound(sigma=sigma, amplitude=amplitude, noise=read, gain=gain) ** 2 / error.var()
    assert (shot if gain else white) < efficiency < 1.15
    assert abs(error.mean()) < 5 * error.std() / math.sqrt(3000)


def speckled(centre, *, sigma, contrast, rng):
    """Return grey values with gamma-distributed factors of mean 1 per pixel, shot and read noise."""
    profile = gaussian(centre, sigma=sigma, amplitude=120)
    light = profile * rng.gamma(contrast**-2, contrast**2, profile.shape)
    return grey(light + 5 + np.sqrt(0.4 + 0.0255 * light) * rng.standard_normal(light.shape))


# In noise of contrast C alone a Gaussian's position has the information sum (u / (C s))^2 over the pixels used. With
# all within U sigma, the standard deviation is C sqrt(s) sqrt(3 / (2 U^3)): 0.31 C sqrt(s) at U = 2.5. The centre of
# mass to 2.25 sigma has 0.37 of it at best, the zero crossing 0.63: its sums are those of u^2 exp(-2 u^2) and
# exp(-u^2) (1 - u^2).
@pytest.mark.parametrize("sigma", [1.5, 3.0])
@pytest.mark.parametrize("contrast", [0.2, 0.4])
def test_least_noise_in_speckle(sigma, contrast):
    rng = np.random.default_rng(2)
    centre = LENGTH / 2 + rng.uniform(-0.5, 0.5, 4000)
    image = speckled(centre, sigma=sigma, contrast=contrast, rng=rng)
    error = {method: centres(image, method) - centre for method in method_names()}
    # Strong speckle tears a line in a thousand into two stripes, which are ambiguous for every method.
    found = np.isfinite(error[FIT])
    error = {method: values[found] for method, values in error.items()}
    spread = {method: values.std() for method, values in error.items()}
    scale = contrast * math.sqrt(sigma)
    # The limit for U = 3, which no pixel beyond can lower much, and one third above the value for U = 2.5.
    assert 0.23 * scale < spread[FIT] < 0.41 * scale
    assert spread[FIT] < 0.6 * spread["zero-crossing"]
    assert spread[FIT] < 0.8 * spread["centre-of-mass"]
    assert abs(error[FIT].mean()) < 5 * error[FIT].std() / math.sqrt(4000)


@pytest.mark.parametrize("method", method_names())
def test_one_line_alone(method):
    rng = np.random.default_rng(3)
    for centre in (57.3, 60.0, 62.8):
        image = speckled([centre], sigma=2, contrast=0.3, rng=rng)
        options = StripeOptions(method=method, end_lines=0)
        found = extract_stripe(image, stripe_along="height", options=options)
        # Five times 0.7 C sqrt(s).
        assert abs(found.centre_px[0] - centre) < 5 * 0.7 * 0.3 * math.sqrt(2)


def test_a_symmetric_halo_moves_nothing_and_a_one_sided_one_no_more_than_other_methods():
    centre = phases(128)
    u = np.arange(LENGTH) - centre[:, None]
    stripe = gaussian(centre, sigma=1.5, amplitude=150) + 20
    both = (stripe + 15 * np.exp(-0.5 * (u / 10) ** 2)).astype(np.float32)
    assert np.abs(centres(both) - centre).max() < 0.008
    one = (stripe + 4.5 * np.exp(-np.abs(u) / 5) * (u > 0)).astype(np.float32)
    fit, crossing = (np.mean(centres(one, method) - centre) for method in (FIT, "zero-crossing"))
    # 3 % of the height on one side only; the wings count more in the fit, but its floor holds 2 % of the height.
    assert 0.01 < crossing < fit * 1.2
    assert fit < 1.2 * crossing
