"""Automatic exposure on drawn images of a linear detector: convergence, and light that it must ignore."""

import numpy as np
import pytest

from uwlts.hardware.rig import find_exposure, measure_brightness
from uwlts.hardware.scan_watch import select_evenly, shows_laser
from uwlts.model.sensor import Sensor

LIT = slice(300, 700)
"""Profile lines with a stripe, of 1280."""


def stripe(sensor: Sensor, dn_per_ms: float, *, lines: slice = LIT, row: float = 500.3) -> np.ndarray:
    """Light (H, W) in DN/ms of a stripe 1.6 px wide between dark margins."""
    light = np.zeros((sensor.camera.height_px, sensor.camera.width_px))
    rows = np.arange(sensor.camera.height_px)
    light[:, lines] = dn_per_ms * np.exp(-0.5 * ((rows - row) / 1.6) ** 2)[:, None]
    return light


class Exposed:
    """Takes images of a light in DN/ms, and counts them."""

    def __init__(self, light: np.ndarray, *, noise_dn: float = 0.7):
        self.light, self.noise_dn, self.count = light, noise_dn, 0
        self.rng = np.random.default_rng(1)

    def __call__(self, exposure_ms: float) -> np.ndarray:
        self.count += 1
        noise = self.rng.normal(0, self.noise_dn, self.light.shape)
        return np.clip(np.rint(exposure_ms * self.light + noise), 0, 255).astype(np.uint8)


# From far too dark to 500 times too bright at the first exposure.
@pytest.mark.parametrize("dn_per_ms", [1.0, 30.0, 200.0, 260.0, 1e4, 1e5])
@pytest.mark.parametrize("light", ["laser", "lamp"])
def test_the_brightest_lines_come_to_the_level(thesis, dn_per_ms, light):
    take = Exposed(stripe(thesis, dn_per_ms))
    exposure_ms = find_exposure(take, sensor=thesis, light=light)
    # The row beside the peak is 0.3 px off it, 2 % lower; the maximum of some noisy pixels exceeds 204 by 2 DN.
    assert exposure_ms * dn_per_ms == pytest.approx(0.8 * 255, rel=0.04)
    assert take.count <= 8


def test_what_is_darker_or_without_stripe_does_not_count(thesis):
    """A tenth of the lines as bright as 200 DN/ms, the others with a stripe a thirtieth of it, or none."""
    light = stripe(thesis, 7.0) + stripe(thesis, 193.0, lines=slice(300, 340))
    assert find_exposure(Exposed(light), sensor=thesis, light="laser") == pytest.approx(204 / 200, rel=0.05)
    seen = measure_brightness(Exposed(light)(1.0), thesis, "laser")
    assert seen.lines == 1280 and 36 <= seen.counted <= 44
    # Daylight on lines without a stripe, brighter than the stripe: smooth, so that no stripe is found in it.
    light = stripe(thesis, 100.0)
    light[:, :200] += 110.0
    assert find_exposure(Exposed(light), sensor=thesis, light="laser") == pytest.approx(204 / 100, rel=0.05)


def test_darkness_has_no_exposure(thesis):
    for light in ("laser", "lamp"):
        dark = Exposed(np.zeros((1024, 1280)), noise_dn=0.0)
        assert find_exposure(dark, sensor=thesis, light=light) is None
    assert find_exposure(Exposed(np.zeros((1024, 1280))), sensor=thesis, light="laser") is None
    faint = Exposed(stripe(thesis, 0.1))
    assert find_exposure(faint, sensor=thesis, light="laser") == thesis.exposure.longest_ms


def test_saturation_on_many_lines_is_distinguished_from_a_reflection(thesis):
    light = stripe(thesis, 150.0)
    glint, much = light.copy(), light.copy()
    glint[498:503, 400:412] = 1000.0
    much[498:503, 400:440] = 1000.0
    assert not measure_brightness(Exposed(glint)(1.0), thesis, "laser").overexposed
    assert measure_brightness(Exposed(much)(1.0), thesis, "laser").overexposed


def test_the_laser_is_distinguished_from_daylight(thesis):
    rows = np.arange(1024)[:, None]
    # A bright bar that daylight shows, as narrow as a stripe, and a step.
    bar = 120.0 * np.exp(-0.5 * ((rows - 700) / 2.0) ** 2) * np.ones((1, 1280)) + 60.0 * (rows > 300)
    noise = 4.0
    unlit = Exposed(bar, noise_dn=noise)
    assert not shows_laser(unlit(1.0), unlit(1.0), thesis, difference=False)
    assert not shows_laser(unlit(1.0), unlit(1.0), thesis, difference=True)
    lit = Exposed(bar + stripe(thesis, 190.0), noise_dn=noise)
    assert shows_laser(lit(1.0), unlit(1.0), thesis, difference=True)
    assert shows_laser(lit(0.3), Exposed(0.05 * bar)(1.0), thesis, difference=True)
    alone, dark = Exposed(stripe(thesis, 60.0)), Exposed(np.zeros((1024, 1280)))
    assert shows_laser(alone(1.0), dark(1.0), thesis, difference=False)
    assert shows_laser(alone(100.0), dark(1.0), thesis, difference=False)
    assert not shows_laser(dark(1.0), dark(1.0), thesis, difference=False)
    # A lamp that is on only while the laser is off does not make a lit image of a dark one.
    assert not shows_laser(dark(1.0), Exposed(150.0 - bar.clip(0, 140))(1.0), thesis, difference=False)


def test_positions_are_spread_over_all():
    assert select_evenly([float(k) for k in range(101)], 5) == [0.0, 25.0, 50.0, 75.0, 100.0]
    assert select_evenly([3.0], 5) == [3.0] and select_evenly([1.0, 2.0, 3.0], 9) == [1.0, 2.0, 3.0]
