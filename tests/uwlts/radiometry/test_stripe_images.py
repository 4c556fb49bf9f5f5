"""Photon transfer and gaps, from drawn images."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from uwlts.errors import CaptureError
from uwlts.model.stripe import CaptureStripes
from uwlts.radiometry.stripe_images import CameraNoise, fill_gaps, measure_noise, measure_stripes
from uwlts.runtime.progress import ignore_progress

GAIN, DARK_DN, BLACK = 0.4, 6.0, 60.0


@dataclass
class DrawnCapture:
    """Repeated images of one stripe with grains, Poisson noise of the light and Gaussian noise of the camera."""

    images: np.ndarray
    stage_mm: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.images)
        self.laser_on = np.ones(count, bool)
        self.exposure_ms = np.ones(count)
        camera = SimpleNamespace(stripe_along="width")
        self.header = SimpleNamespace(saturation_dn=4095, sensor=SimpleNamespace(camera=camera))

    def image(self, number: int) -> np.ndarray:
        return self.images[number]


def drawn(count: int, rng: np.random.Generator) -> DrawnCapture:
    row = np.arange(200)[:, None]
    grains = rng.gamma(20.0, 1 / 20.0, (200, 300))
    electrons = 6000.0 * np.exp(-0.5 * ((row - 100) / 8.0) ** 2) * grains
    light = GAIN * rng.poisson(electrons, (count, 200, 300))
    images = np.rint(BLACK + light + rng.normal(0, DARK_DN, light.shape)).astype(np.uint16)
    return DrawnCapture(images, np.zeros(count))


def noise_of(scan: DrawnCapture) -> CameraNoise:
    found = measure_noise(cast(Any, scan))
    assert found is not None
    return found


def stripes_on(lines: np.ndarray) -> CaptureStripes:
    ones = np.ones(len(lines))
    return CaptureStripes(np.zeros(len(lines), int), lines, 2.0 * lines, ones, ones, lines_by_status={})


def test_photon_transfer_of_repeated_images_with_grains():
    """Grains of a contrast of 0.22 have 300 times the variance of the shot noise, and do not change the result.

    Some 12,000 lit pixels in 6 images give the gain to sqrt(2 / 60,000) = 0.6 %: five times this is 3 %. 40,000 dark
    pixels give the noise to 0.2 %. The foot of the stripe is in the bin of the dark pixels and adds up to 2 %.
    """
    found = noise_of(drawn(6, np.random.default_rng(5)))
    assert abs(found.gain / GAIN - 1) < 0.03
    assert abs(found.gain - GAIN) < 5 * found.gain_std
    assert abs(found.dark_dn / DARK_DN - 1) < 0.02
    assert found.fit.misfit < 1


def test_unsteady_laser_contradicts_the_photon_transfer():
    """Power that changes by 2 % adds (0.02 * 2400)^2 = 2300 to a variance of 960 at the brightest pixels."""
    scan = drawn(6, np.random.default_rng(10))
    power = np.array([0.98, 1.02, 0.98, 1.02, 0.98, 1.02])[:, None, None]
    scan.images = np.rint(BLACK + power * (scan.images - BLACK)).astype(np.uint16)
    assert noise_of(scan).fit.misfit > 1


def test_shot_noise_of_the_halo_is_not_noise_in_the_dark():
    """A halo of 30 electrons on two thirds of the rows adds their shot noise to two thirds of the dark pixels.

    The variance of a pixel in the dark is (6 / 0.4)^2 = 225 electrons; 20 more on average would be 4 % more noise.
    """
    row = np.arange(200)[:, None]
    rng = np.random.default_rng(8)
    electrons = 6000.0 * np.exp(-0.5 * ((row - 130) / 8.0) ** 2) + 30.0 * (row > 66)
    light = GAIN * rng.poisson(np.broadcast_to(electrons, (200, 300)), (6, 200, 300))
    images = np.rint(BLACK + light + rng.normal(0, DARK_DN, light.shape)).astype(np.uint16)
    found = noise_of(DrawnCapture(images, np.zeros(6)))
    assert abs(found.dark_dn / DARK_DN - 1) < 0.015
    assert abs(found.dark_dn - DARK_DN) < 3 * found.dark_std < 0.6


def test_saturated_stripes_are_refused_with_the_reason():
    scan: Any = drawn(2, np.random.default_rng(9))
    scan.images[:] = np.where(scan.images > 500, 4095, scan.images)
    scan.path = SimpleNamespace(name="scan.h5")
    lines, ones = np.tile(np.arange(300), 2), np.ones(600)
    stripes = CaptureStripes(np.repeat([0, 1], 300), lines, np.full(600, 100.0), ones, 18 * ones, lines_by_status={})
    with pytest.raises(CaptureError, match="100 % of the centres are in saturated pieces.*shorter exposure"):
        measure_stripes(scan, stripes, np.ones(600, bool), ignore_progress)


def test_moving_particles_change_neither_gain_nor_noise():
    """Bright discs at other places in each image cover 3 % of it, and change 16 % of the pixels in one of 6 images.

    With them, the median of a variance is the 60th percentile of the others: the limit keeps a few more pixels, which
    adds 2 %. The gain has 0.6 % from its number of pixels.
    """
    rng = np.random.default_rng(7)
    scan = drawn(6, rng)
    v, u = np.mgrid[:200, :300]
    for image in scan.images:
        for place in rng.uniform(0, [200, 300], (16, 2)):
            image[np.hypot(v - place[0], u - place[1]) < 6.0] += 400
    found = noise_of(scan)
    assert abs(found.gain / GAIN - 1) < 0.05
    assert abs(found.dark_dn / DARK_DN - 1) < 0.04


def test_without_repeated_images_there_is_no_noise():
    scan = drawn(2, np.random.default_rng(6))
    scan.stage_mm[:] = [0.0, 1.0]
    assert measure_noise(cast(Any, scan)) is None


def test_short_gaps_are_interpolated_and_long_ones_kept():
    lines = np.array([0, 1, 4, 5, 40, 41])
    filled = fill_gaps(stripes_on(lines))
    assert filled.line.tolist() == [0, 1, 2, 3, 4, 5, 40, 41]
    np.testing.assert_allclose(filled.centre_px, 2.0 * filled.line)
