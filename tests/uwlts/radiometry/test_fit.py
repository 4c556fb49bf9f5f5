"""Fit of each part of the images: drawn light with and without what the model does not contain."""

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import uwlts
from uwlts.model.phase_functions import FournierForand, HenyeyGreenstein, PetzoldAverage, PhaseFunction
from uwlts.radiometry.fit import _NAMES, _OTHER_PHASES, _bound_natural_absorption, _Evidence
from uwlts.radiometry.followed_sensor import follow_sensor
from uwlts.radiometry.result import format_value
from uwlts.radiometry.stripe_images import BLOCKS, GROUP_LINES, TAIL_PX, StripeImages
from uwlts.radiometry.stripe_light import STEP_PX, HaloKernel

NODES = np.array([0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.6, 1.0, 2.0, 6.0])
B, C, BACKGROUND, WIDTH, GROUPS = 0.3, 0.9, 70.0, 21, 400
GRAIN, NOISE_DN = 0.1, 0.3
NATURAL = (0.301, 1.399)
"""Absorption of pure water at 635 nm (Pope and Fry), and with 39/m of colour at 380 nm, less by exp(-0.014 / nm)."""
PATHS = ((320.0, 0.4), (420.0, 0.5))


PETZOLD = PetzoldAverage()


@cache
def halos(phase: PhaseFunction) -> tuple[np.ndarray, np.ndarray]:
    """Return tails (nodes, TAIL_PX) and light within the width (nodes,) of the halos of a phase function."""
    kernel = HaloKernel(phase.per_sr, PATHS)
    middle, step = int(np.argmin(np.abs(kernel.place_px))), round(1 / STEP_PX)
    rows = np.array([kernel.profile(1e-3 * b, sigma_px=1.0) for b in NODES])
    reach = round(0.5 * WIDTH / STEP_PX)
    within = STEP_PX * rows[:, middle - reach : middle + reach + 1].sum(axis=1)
    return rows[:, middle + step :: step][:, :TAIL_PX], within


def draw(rng: np.random.Generator, phase: PhaseFunction = PETZOLD, known: PhaseFunction = PETZOLD) -> _Evidence:
    """Draw what the images of an inclined wall show: 20 images with 20 groups of lines each, and grains."""
    block = np.arange(GROUPS) * BLOCKS // GROUPS
    fan, paths = np.tile(np.linspace(-0.8, 0.8, 20), 20), np.repeat(np.linspace(620.0, 880.0, 20), 20)
    tails, within = ([CubicSpline(NODES, each)] * 2 for each in halos(phase))
    model = np.full(GROUPS, 8000.0)
    grains = rng.normal(1.0, GRAIN / math.sqrt(GROUP_LINES), GROUPS)
    stripe = model * np.exp(-1e-3 * C * paths) * grains
    of_block = np.bincount(block, stripe) / np.bincount(block)
    halo = of_block[:, None] * tails[0](B)
    fine_px = np.arange(-10.0, 10.1, 0.25)
    images = StripeImages(
        light=stripe * float(within[0](B)) + WIDTH * BACKGROUND,
        of_group=np.empty(0, int),
        block=block,
        exposure_ms=np.ones(GROUPS),
        width=WIDTH,
        fine_px=fine_px,
        fine=np.tile(np.exp(-0.5 * (fine_px / 2) ** 2), (BLOCKS, 1)),
        tail=BACKGROUND + halo + rng.normal(0.0, NOISE_DN, halo.shape),
        tail_count=np.full((BLOCKS, TAIL_PX), 600),
        grain=np.tile(GRAIN**2 * np.eye(1, 9), (BLOCKS, 1)),
        peak_dn=2000.0,
    )
    fitted = [np.repeat(each[None], BLOCKS, axis=0) for each in halos(known)]
    return _Evidence(
        images=images, sheet_per_px=np.ones(BLOCKS), blur_var=np.zeros(BLOCKS), model=model, fan=fan, paths=paths,
        distance_mm=400.0, path_mm=750.0, dark_e=0.0,
        tails=CubicSpline(NODES, fitted[0], axis=1), within=CubicSpline(NODES, fitted[1], axis=1),
    )  # fmt: skip


def misfits(evidence: _Evidence) -> list[float]:
    """Return the misfits of light, halo, background and water; the estimates have 5 % and 0.05."""
    whole = evidence.estimate(np.ones(BLOCKS, bool))
    std = np.hypot(0.05 * whole, 0.05)
    return [part.misfit for part in evidence.judge(whole, np.diag(std**2), NATURAL)]


def add_light(evidence: _Evidence, tail: np.ndarray, stripe: np.ndarray | float = 1.0) -> _Evidence:
    """Add light (BLOCKS, TAIL_PX) beside the stripe, and multiply that of the stripe (GROUPS,) by a factor."""
    images = evidence.images
    above = (images.light - WIDTH * BACKGROUND) * stripe
    return replace(evidence, images=replace(images, light=above + WIDTH * BACKGROUND, tail=images.tail + tail))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_is_assumed_fits(seed):
    """All misfits are below 1, also with a laser whose power varies along the fan by 5 %."""
    evidence = draw(np.random.default_rng(seed))
    assert max(misfits(evidence)) < 0.8
    assert misfits(add_light(evidence, np.zeros(()), 1 + 0.05 * np.sin(12 * evidence.fan)))[0] < 0.8


def test_what_is_not_assumed_does_not_fit():
    """Mottle is in the light along the stripe, light from within the surface beside it, daylight in the background."""
    rng = np.random.default_rng(4)
    evidence, none = draw(rng), np.zeros(())
    mottle = np.repeat(1 + 0.2 * rng.uniform(-1, 1, GROUPS // 4), 4)
    light, *others = misfits(add_light(evidence, none, mottle))
    assert light > 1 > max(others)
    place = np.arange(1.0, TAIL_PX + 1)
    light, halo, background, _ = misfits(add_light(evidence, np.tile(100 * np.exp(-place / 8), (BLOCKS, 1))))
    assert halo > 1 > max(light, background)
    # Light that reaches farther falls like a halo, but more of it than the attenuation allows.
    *others, water = misfits(add_light(evidence, np.tile(100 * np.exp(-place / 30), (BLOCKS, 1))))
    assert water > 1 > max(others)
    light, _, background, _ = misfits(add_light(evidence, rng.normal(0.0, 1.5, (BLOCKS, 1))))
    assert background > 1 > light


def test_a_halo_of_another_form_leaves_the_attenuation_open():
    """Strong daylight fell into the halo, and the attenuation was 50 % too large."""
    evidence = draw(np.random.default_rng(5))
    other = add_light(evidence, np.tile(100 * np.exp(-np.arange(1.0, TAIL_PX + 1) / 8), (BLOCKS, 1)))
    for seen, open_values in ((evidence, set()), (other, {"attenuation_per_m", "scattering_per_m"})):
        whole = seen.estimate(np.ones(BLOCKS, bool))
        parts = seen.judge(whole, np.diag(np.hypot(0.05 * whole, 0.05) ** 2), NATURAL)
        found = {name for part in parts if part.misfit > 1 for name in part.names}
        assert found >= open_values and bool(found) is bool(open_values)


def test_a_reflectance_with_the_path_shows_if_no_natural_water_absorbs_so_much():
    """The light doubles or halves over the 260 mm of path: the attenuation changes by ln 2 / 0.26 m = 2.7/m."""
    sensor = uwlts.load_sensor("thesis-small")
    headers: list[Any] = [SimpleNamespace(sensor=sensor, medium=sensor.medium(name)) for name in ("water", "air")]
    water, air = map(_bound_natural_absorption, headers)
    assert water == pytest.approx(NATURAL, abs=2e-3) and air == (0.0, math.inf)
    evidence = draw(np.random.default_rng(6))
    doubled = 2 ** ((evidence.paths - 750) / 260)
    for change in (doubled, 1 / doubled):
        light, *_, absorption = misfits(add_light(evidence, np.zeros(()), change))
        assert absorption > 1 > light


def test_another_phase_function_is_not_noticed_from_the_halo():
    """Henyey-Greenstein's g = 0.9 has nearly the halo of more of Petzold's particles: it is listed as not separable."""
    evidence = draw(np.random.default_rng(5), HenyeyGreenstein(0.9))
    found = evidence.estimate(np.ones(BLOCKS, bool))[_NAMES.index("scattering_per_m")]
    assert found > 1.08 * B
    assert max(misfits(evidence)) < 1


@pytest.mark.slow
def test_the_uncertainty_contains_another_phase_function():
    """Scattering, attenuation and background of drawn phase functions, fitted as Petzold's average particle."""
    rng = np.random.default_rng(7)
    drawn: list[PhaseFunction] = [HenyeyGreenstein(g) for g in rng.uniform(0.85, 0.95, 3)]
    drawn += [FournierForand(1.01 + 0.1542 * (slope - 3), slope) for slope in rng.uniform(3.3, 3.9, 3)]
    truth = {"scattering_per_m": B, "attenuation_per_m": C, "background_dn": BACKGROUND}
    places = [_NAMES.index(name) for name in truth]
    alone, stated = [], []
    for number, phase in enumerate(drawn):
        evidence = draw(np.random.default_rng(number), phase)
        others = [draw(np.random.default_rng(number), phase, other) for other in _OTHER_PHASES]
        whole, covariance = evidence.estimate_with_covariance()
        for found, more in ((alone, 0.0), (stated, evidence.spread(whole, others))):
            found.append((whole[places] - [*truth.values()]) / np.sqrt(np.diag(covariance + more))[places])
    # Six drawn ones: at most two and a half standard uncertainties, and more than that without the others.
    assert np.abs(stated).max() < 2.5 < np.abs(alone).max() / 2
    assert 0.3 < np.sqrt(np.mean(np.square(stated))) < 1.3


def test_description_keeps_what_is_not_determined():
    sensor = uwlts.load_sensor("thesis-small")
    header: Any = SimpleNamespace(sensor=sensor, medium=sensor.medium("water"), medium_name="water")
    known = uwlts.nominal("thesis-small", medium="water")
    given: Any = {
        "reflectance": 0.8, "sheet_distance_mm": 400.0, "attenuation_per_m": 0.9, "dark_e": 0.0, "exposure_ms": 2.0
    }  # fmt: skip
    kept = follow_sensor(header, known, {}, **given)
    assert kept.medium("water") == sensor.medium("water")
    assert kept.detector == sensor.detector
    assert (kept.laser.power_mw, kept.laser.waist_radius_mm) == (sensor.laser.power_mw, sensor.laser.waist_radius_mm)
    water = follow_sensor(header, known, {"attenuation_per_m": 0.9}, **given).medium("water")
    assert water.extinction_per_mm(sensor.laser.wavelength_nm) == pytest.approx(0.9e-3)
    described = sensor.medium("water").scattering_per_mm(sensor.laser.wavelength_nm)
    assert water.scattering_per_m == pytest.approx(1e3 * described)


def test_values_have_the_digits_of_their_uncertainty():
    assert format_value(0.83214, 0.0143) == "0.832 ± 0.014"
    assert format_value(1234.5, 25.0) == "1234 ± 25"
    assert format_value(1.0, 0.0) == "1"
