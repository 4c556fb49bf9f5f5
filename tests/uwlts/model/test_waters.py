"""Named waters and turbidity compared with their sources, and permitted descriptions."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from uwlts.errors import RangeError
from uwlts.model import media
from uwlts.model.phase_functions import (
    KINDS,
    FournierForand,
    HenyeyGreenstein,
    Molecular,
    PetzoldAverage,
    PhaseFunction,
    Scatterer,
)
from uwlts.model.sensor import Medium

NODES_NM = (400, 425, 450, 475, 500, 525, 550, 575, 600, 625, 650, 675, 700)


def sea(**changes: object) -> Medium:
    """Sea water of 35 g/kg at 20 degC."""
    return Medium.model_validate({"kind": "sea", "salinity_g_kg": 35.0} | changes)


def per_metre(medium: Medium, wavelength_nm: float) -> tuple[float, float]:
    """Absorption and scattering in 1/m."""
    return 1e3 * medium.absorption_per_mm(wavelength_nm), 1e3 * medium.scattering_per_mm(wavelength_nm)


# Petzold 1972, summary pages of AUTEC 8, HAOCE 11 and NUC 2040, 530 nm: a and b in 1/m.
@pytest.mark.parametrize(
    ("water", "a", "b"), [("clear", 0.114, 0.037), ("coastal", 0.179, 0.219), ("harbour", 0.366, 1.824)]
)
def test_stations_are_as_petzold_measured_them(water, a, b):
    assert per_metre(sea(water=water), 530.0) == pytest.approx((a, b), rel=1e-12)


# Ranges at 635 nm from stations at 514 or 530 nm, for exponents from 0.3 to 1.7 and slopes from 0.011 to 0.018 / nm.
@pytest.mark.parametrize(
    ("water", "a", "b"),
    [
        ("clear", (0.31, 0.33), (0.025, 0.036)),
        ("coastal", (0.32, 0.35), (0.15, 0.21)),
        ("harbour", (0.34, 0.41), (1.3, 1.75)),
    ],
)
def test_red_stations_lie_between_the_curves_of_other_exponents(water, a, b):
    absorption, scattering = per_metre(sea(water=water), 635.0)
    assert a[0] < absorption < a[1]
    assert b[0] < scattering < b[1]


# Solonenko and Mobley 2015, Tables 4 to 8: a at 400, 500, 600 and 700 nm (3C's last and 5C's last two filled in), b at
# 500 nm.
JERLOV = {
    "I": (0.022, 0.026, 0.228, 0.582, 0.00249),
    "IB": (0.0331, 0.0287, 0.2278, 0.582, 0.0597),
    "II": (0.0355, 0.0288, 0.228, 0.582, 0.421),
    "III": (0.0615, 0.0358, 0.229, 0.583, 1.152),
    "1C": (0.227, 0.064, 0.236, 0.586, 0.429),
    "3C": (0.388, 0.081, 0.239, 0.592, 1.25),
    "5C": (0.660, 0.151, 0.259, 0.598, 1.56),
    "7C": (1.03, 0.290, 0.301, 0.621, 2.76),
    "9C": (1.613, 0.543, 0.390, 0.651, 3.67),
}


@pytest.mark.parametrize("name", JERLOV)
def test_jerlov_types_are_as_solonenko_and_mobley_print_them(name):
    medium = sea(water=f"jerlov-{name}")
    *absorption, scattering = JERLOV[name]
    found = [per_metre(medium, wavelength)[0] for wavelength in (400, 500, 600, 700)]
    assert found == pytest.approx(absorption, rel=1e-12)
    # The molecules scatter 0.0025473 /m after Zhang, 0.0022224 /m after Haltrin, whom the tables follow.
    assert per_metre(medium, 500.0)[1] == pytest.approx(scattering + 0.0025473 - 0.0022224, abs=1e-6)


# Table 3: small and large particles in g/m3. Printed for type I they contradict its column of b.
TABLE_3 = {
    "IB": (0.03, 0.083),
    "II": (0.401, 0.011),
    "III": (1.1, 0.006),
    "1C": (0.402, 0.004),
    "3C": (1.21, 0.005),
    "5C": (1.50, 0.022),
    "7C": (2.64, 0.067),
    "9C": (3.54, 0.016),
}


@pytest.mark.parametrize("name", TABLE_3)
def test_every_row_of_a_types_scattering_follows_the_authors_model(name):
    small, large = TABLE_3[name]
    wavelengths = np.array(NODES_NM, float)
    found = np.array([media.WATERS[f"jerlov-{name}"].particles(w).scattering_per_m for w in wavelengths])
    # Eq. 8 less the molecules. The amount is met to 2.4 % in the worst case, 1C. The wavelengths' rounding to three
    # digits, 0.5 % at 1.06 /m, is what a misread digit would stand out of.
    model = small * 1.513 * (400 / wavelengths) ** 1.7 + large * 0.3411 * (400 / wavelengths) ** 0.3
    ratio = found / model
    assert ratio.mean() == pytest.approx(1.0, abs=0.025)
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.006)


# Williamson and Hollins 2022 at 635 nm, from measurements.
MEASURED = {
    "IB": (0.306, 0.115),
    "II": (0.309, 0.166),
    "III": (0.321, 0.273),
    "1C": (0.329, 0.408),
    "3C": (0.350, 0.617),
    "5C": (0.373, 1.14),
}


@pytest.mark.parametrize("name", MEASURED)
def test_jerlov_types_agree_with_measurements_as_far_as_is_known(name):
    a, b = per_metre(sea(water=f"jerlov-{name}"), 635.0)
    assert a == pytest.approx(MEASURED[name][0], rel=0.10)
    assert 1 / 2.9 < b / MEASURED[name][1] < 2.9


@pytest.mark.parametrize("water", media.WATERS)
def test_every_water_absorbs_and_scatters_over_the_whole_range(water):
    wavelengths = np.linspace(400, 700, 121)
    for kind in ({"kind": "fresh"}, {"kind": "sea", "salinity_g_kg": 35.0}):
        pure, medium = (Medium(**kind, water=name) for name in ("pure", water))
        a0, b0 = np.array([per_metre(pure, w) for w in wavelengths]).T
        a, b = np.array([per_metre(medium, w) for w in wavelengths]).T
        # The tables' pure water is up to 7 % clearer than ours at 700 nm, and nowhere else so far from it.
        assert (a >= 0.93 * a0).all()
        assert (b >= b0).all()
        assert water == "pure" or b[0] > b0[0]
        # Molecules scatter as the power -4.2, steeper at the start of the table's straight pieces, large particles as
        # -0.3: a row missing or out of order stands out.
        slope = np.diff(np.log(b)) / np.diff(np.log(wavelengths))
        assert ((slope > -4.6) & (slope < -0.25)).all()


def test_water_without_a_name_is_pure():
    for wavelength in (400.0, 635.0, 700.0):
        assert per_metre(sea(water="pure"), wavelength) == per_metre(sea(), wavelength)
        assert per_metre(sea(turbidity=0.0), wavelength) == per_metre(sea(), wavelength)
    assert sea(water="pure").scatterers(635.0) == sea().scatterers(635.0)


@pytest.mark.parametrize(("turbidity", "water"), [(0, "pure"), (1, "clear"), (2, "coastal"), (3, "harbour")])
@pytest.mark.parametrize("wavelength", [400.0, 532.0, 635.0, 700.0])
def test_turbidity_passes_through_the_named_waters(turbidity, water, wavelength):
    expected = per_metre(sea(water=water), wavelength)
    assert per_metre(sea(turbidity=turbidity), wavelength) == pytest.approx(expected, rel=1e-12)


@settings(deadline=None)
@given(turbidity=st.floats(0, 3), step=st.floats(1e-6, 0.5), wavelength=st.floats(400, 700))
def test_turbidity_rises_without_a_jump(turbidity, step, wavelength):
    more = min(turbidity + step, 3.0)
    clearer, cloudier = (per_metre(sea(turbidity=t), wavelength) for t in (turbidity, more))
    for low, high, full in zip(clearer, cloudier, per_metre(sea(water="harbour"), wavelength), strict=True):
        # The steepest part ends at the harbour: ln(1.822 / 0.217) = 2.13 times the value there per unit.
        assert -1e-15 <= high - low <= 2.2 * full * (more - turbidity) + 1e-15


def test_turbidity_has_equal_factors_above_clear_water():
    values = [media.particles_at(t, wavelength_nm=635.0).scattering_per_m for t in np.arange(2.0, 3.01, 0.125)]
    ratios = [later / earlier for earlier, later in pairwise(values)]
    assert ratios == pytest.approx([ratios[0]] * 8, rel=1e-12)


def test_molecules_scatter_as_molecules_and_particles_as_the_phase_says():
    molecules, particles = sea(water="coastal").scatterers(635.0)
    assert molecules == Scatterer(pytest.approx(0.937e-6, rel=1e-3), Molecular())
    assert particles.phase == PetzoldAverage()
    named = {
        "molecular": Molecular(),
        "henyey-greenstein": HenyeyGreenstein(0.924),
        "petzold": PetzoldAverage(),
        "fournier-forand": FournierForand(1.10, 3.5835),
    }
    for phase, expected in named.items():
        medium = sea(turbidity=1.5, phase=phase)
        assert [part.phase for part in medium.scatterers(635.0)] == [Molecular(), expected]
        free = sea(water="harbour", scattering_per_m=2.0, phase=phase)
        assert free.scatterers(635.0) == (Scatterer(2e-3, expected),)


def test_given_coefficients_replace_those_of_the_named_water():
    medium = sea(water="harbour", absorption_per_m=0.5)
    assert per_metre(medium, 635.0) == (0.5, per_metre(sea(water="harbour"), 635.0)[1])
    medium = sea(turbidity=3.0, scattering_per_m=0.25)
    assert per_metre(medium, 635.0) == (per_metre(sea(turbidity=3.0), 635.0)[0], 0.25)
    assert medium.scatterers(635.0) == (Scatterer(0.25e-3, PetzoldAverage()),)
    assert sea(water="harbour", scattering_per_m=0.0).scatterers(635.0) == ()


def test_a_custom_medium_scatters_only_if_described_so():
    assert Medium(kind="custom", index=1.4).scatterers(635.0) == ()
    assert Medium(kind="air").scatterers(635.0) == ()
    named = Medium(kind="custom", index=1.34, water="coastal")
    assert per_metre(named, 635.0) == pytest.approx(per_metre(Medium(kind="fresh", water="coastal"), 635.0))


@pytest.mark.parametrize(
    "stored",
    [
        {"kind": "fresh", "temperature_c": 25.0},
        {"kind": "custom", "index": 1.33, "absorption_per_m": 0.1, "scattering_per_m": 2.0, "phase": "molecular"},
        {"kind": "sea", "salinity_g_kg": 35.0, "phase": "henyey-greenstein", "asymmetry": 0.9, "scattering_per_m": 1.0},
    ],
)
def test_media_stored_before_there_were_named_waters_mean_the_same(stored):
    medium = Medium.model_validate(stored)
    assert len(medium.scatterers(635.0)) == 1
    kind = HenyeyGreenstein if stored.get("phase") == "henyey-greenstein" else Molecular
    assert isinstance(medium.scatterers(635.0)[0].phase, kind)


@settings(deadline=None)
@given(
    which=st.one_of(
        st.fixed_dictionaries({"water": st.sampled_from(list(media.WATERS))}),
        st.fixed_dictionaries({"turbidity": st.floats(0, 3)}),
    ),
    share=st.none() | st.floats(1e-4, 0.1),
)
def test_media_survive_storage(which, share):
    medium = sea(**which, phase="fournier-forand", backscatter_share=share)
    again = Medium.model_validate_json(medium.model_dump_json())
    assert again == medium
    assert again.scatterers(635.0) == medium.scatterers(635.0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"water": "muddy"}, "jerlov-9C"),
        ({"water": "coastal", "turbidity": 1.0}, "not both"),
        ({"turbidity": 3.1}, "turbidity"),
        ({"turbidity": -0.1}, "turbidity"),
        ({"turbidity": math.nan}, "turbidity"),
        ({"kind": "air", "salinity_g_kg": 0.0, "water": "clear"}, "air"),
        ({"kind": "air", "salinity_g_kg": 0.0, "turbidity": 0.0}, "air"),
        ({"phase": "rayleigh"}, "phase"),
        ({"particle_index": 1.0}, "particle_index"),
        ({"particle_slope": 3.0}, "particle_slope"),
        ({"backscatter_share": 0.2}, "backscatter_share"),
    ],
)
def test_contradictory_entries_are_refused(wrong, message):
    with pytest.raises(ValidationError, match=message):
        sea(**wrong)


@pytest.mark.parametrize("wavelength", [399.9, 700.1, math.nan, math.inf])
@pytest.mark.parametrize("water", [name for name in media.WATERS if name != "pure"])
def test_waters_are_refused_outside_their_wavelengths(water, wavelength):
    with pytest.raises(RangeError, match="wavelength_nm"):
        media.WATERS[water].particles(wavelength)


def test_shares_scattered_backwards_are_checked_where_they_are_used():
    for share in (0.9e-4, 0.11, math.nan):
        with pytest.raises(RangeError, match="backscatter_share"):
            FournierForand.of_backscatter(share)


# Ocean Optics Web Book, page on the Fournier-Forand function: index, slope and backscatter fraction.
@pytest.mark.parametrize(
    ("index", "slope", "share"),
    [(1.021, 3.0742, 1e-4), (1.04, 3.201, 1e-3), (1.08, 3.483, 0.01), (1.10, 3.5835, 0.0183), (1.175, 4.065, 0.1)],
)
def test_particles_follow_from_the_share_scattered_backwards(index, slope, share):
    found = FournierForand.of_backscatter(share)
    # The published indices have two or three decimals; the linear relation differs from them by at most 0.003. Index
    # errors are slope errors times 0.1542.
    assert found.index == pytest.approx(index, abs=0.003)
    assert found.slope == pytest.approx(slope, abs=0.003 / 0.1542)


@dataclass(frozen=True)
class Even(PhaseFunction):
    """Isotropic scattering, optionally with a part of it left out."""

    name = "even"
    sentence = "the same in all directions"

    left_out: float = 0.0

    def per_sr(self, angle: np.ndarray) -> np.ndarray:
        """1 / (4 pi) of what is scattered."""
        return np.full_like(angle, (1 - self.left_out) / (4 * math.pi))


def test_a_new_phase_function_is_one_class_in_the_list_of_kinds(monkeypatch):
    monkeypatch.setitem(KINDS, "even", Even)
    by_name = Medium.model_validate({"kind": "custom", "index": 1.3, "scattering_per_m": 1.0, "phase": "even"})
    assert by_name.scatterers(635.0) == (Scatterer(1e-3, Even()),)
    table = {"kind": "even", "left_out": 0.5}
    by_table = Medium.model_validate({"kind": "custom", "index": 1.3, "scattering_per_m": 1.0, "phase": table})
    assert by_table.scatterers(635.0) == (Scatterer(1e-3, Even(0.5)),)
    assert Medium.model_validate_json(by_table.model_dump_json()) == by_table


@pytest.mark.parametrize(
    ("phase", "message"),
    [
        ({"kind": "rayleigh"}, "known are molecular"),
        ({"kind": "henyey-greenstein", "asymmetry": 1.5}, "asymmetry"),
        ({"kind": "henyey-greenstein", "slope": 1.5}, "slope"),
    ],
)
def test_a_phase_function_in_a_table_is_checked(phase, message):
    with pytest.raises(ValidationError, match=message):
        sea(phase=phase)
