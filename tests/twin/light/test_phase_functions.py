"""Phase functions compared with published values, and sampled directions compared with the functions."""

import math

import drjit as dr
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.special import chdtrc

from tests.virtual_sensors import clear, gauss_legendre
from twin.backend.arrays import Float, Point2f, Vector3f, to_jit, to_numpy
from twin.light.water import NODES, Scattering, node_angles, rotate_about, tabulate_phase_function
from uwlts.model.phase_functions import (
    FournierForand,
    HenyeyGreenstein,
    Molecular,
    PetzoldAverage,
    PhaseFunction,
    Scatterer,
)
from uwlts.model.sensor import Medium

import mitsuba as mi  # isort: skip

MEDIA = {
    "pure": Medium(kind="sea", salinity_g_kg=35.0),
    "coastal": Medium(kind="sea", salinity_g_kg=35.0, water="coastal"),
    "petzold": clear(0.1, 1.0, phase="petzold"),
    "forward": clear(0.1, 1.0, phase="henyey-greenstein", asymmetry=0.99),
    "even": clear(0.1, 1.0, phase="henyey-greenstein", asymmetry=0.0),
    "backward": clear(0.1, 1.0, phase="henyey-greenstein", asymmetry=-0.9),
    "fournier": clear(0.1, 1.0, phase="fournier-forand"),
    "soft": clear(0.1, 1.0, phase="fournier-forand", particle_index=1.021, particle_slope=3.0742),
}


def places(count: int) -> np.ndarray:
    """Values (count,) of log((1 - cos) / (1 + cos)), evenly from 2e-9 forwards to 2e-5 backwards."""
    return np.linspace(math.log(1e-9), math.log(1e5), count)


def one_minus_cosine(place: np.ndarray) -> np.ndarray:
    """1 - cos at values of log((1 - cos) / (1 + cos))."""
    return 2 / (1 + np.exp(-place))


def shares(medium: Medium, edges: np.ndarray) -> np.ndarray:
    """Return the fraction (bins,) of light scattered between angles, by the midpoint rule over values of `phase`."""
    fine = 400
    steps = np.diff(edges)[:, None] / fine
    middle = one_minus_cosine(edges[:-1, None] + steps * (np.arange(fine) + 0.5))
    value = Scattering(medium, 635.0).phase(to_jit(middle)).numpy().astype(float).reshape(middle.shape)
    return (value * math.pi * middle * (2 - middle) * steps).sum(axis=1)


def within(table_of: PhaseFunction, degrees: float) -> float:
    """Return the fraction scattered by less than an angle."""
    table = tabulate_phase_function((Scatterer(1.0, table_of),))
    return float(np.interp(math.log(math.radians(degrees)), np.log(node_angles()), table.cumulative))


def mean_cosine(phase: PhaseFunction) -> float:
    """Return the mean cosine, 1 minus the integral of (1 - cos); small angles do not contribute."""
    table = tabulate_phase_function((Scatterer(1.0, phase),))
    return 1 - float(np.diff(table.cumulative) @ (1 - np.cos(np.sqrt(node_angles()[1:] * node_angles()[:-1]))))


# --- the functions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("asymmetry", [-0.9, -0.4, 0.0, 0.5, 0.924])
def test_henyey_and_greenstein_is_its_series(asymmetry):
    angle = np.radians(np.linspace(0.01, 179.99, 181))
    orders = np.arange(500)
    # The generating function of the Legendre polynomials; the first order left out adds 1001 * 0.924^500 = 7e-15.
    series = np.polynomial.legendre.legval(np.cos(angle), (2 * orders + 1) * asymmetry**orders) / (4 * math.pi)
    found = HenyeyGreenstein(asymmetry).per_sr(angle)
    np.testing.assert_allclose(found, series, rtol=1e-9)


def test_molecules_scatter_by_their_depolarisation_and_as_much_back_as_forth():
    # With the depolarisation d = 0.039, forward / across - 1 is (1 - d) / (1 + d).
    forward, across, backward = Molecular().per_sr(np.radians([1e-6, 90.0, 180.0]))
    assert forward / across - 1 == pytest.approx((1 - 0.039) / (1 + 0.039), abs=1e-4)
    assert forward == pytest.approx(backward)
    assert within(Molecular(), 90.0) == pytest.approx(0.5, abs=1e-6)
    # 3 / (4 pi (3 + k)) at 90 deg with k = 0.925: 0.0608236
    assert across == pytest.approx(0.0608236, abs=1e-7)


# Mobley's own integration of the average particle (1993, as distributed with the code AOMC): deg, share within.
MOBLEY = [
    (0.1, 0.051652874),
    (0.19953, 0.081192419),
    (0.50119, 0.149388985),
    (1.0, 0.231175822),
    (1.9953, 0.339426842),
    (5.0119, 0.516141642),
    (10.0, 0.665573029),
    (20.0, 0.812516491),
    (30.0, 0.881198952),
    (45.0, 0.932334078),
    (60.0, 0.958533073),
    (90.0, 0.981907707),
    (120.0, 0.992146354),
    (150.0, 0.997761819),
]


def test_petzolds_average_is_mobleys():
    found = [within(PetzoldAverage(), degrees) for degrees, _ in MOBLEY]
    # The integral depends on the interpolation between the angles: power laws, as here, and straight lines differ by
    # 0.4 % of the part between 5 and 15 deg, where the spacing of the angles is largest.
    assert found == pytest.approx([share for _, share in MOBLEY], abs=0.003)
    shares_found = [within(PetzoldAverage(), degrees) for degrees in (0.1, 1.0, 5.0, 10.0)]
    assert [round(100 * share) for share in shares_found] == [5, 23, 52, 67]
    assert 1 - within(PetzoldAverage(), 90.0) == pytest.approx(0.0183, abs=0.5e-4)
    assert mean_cosine(PetzoldAverage()) == pytest.approx(0.924, abs=0.5e-3)


def test_petzolds_average_has_the_values_of_the_table_and_its_forward_slope():
    table = tabulate_phase_function((Scatterer(1.0, PetzoldAverage()),))
    per_solid_angle = np.exp(table.log_density) / (math.pi * np.sin(node_angles()) ** 2)
    found = np.exp(
        np.interp(np.log(np.radians([0.1, 1.0, 10.0, 90.0])), np.log(node_angles()), np.log(per_solid_angle))
    )
    # The table's own integral is 0.9937, so that everything is raised by 0.6 %, evenly.
    np.testing.assert_allclose(found / [1772, 71.81, 1.156, 0.004305], 1.0063, rtol=5e-4)
    low, high = np.searchsorted(node_angles(), [1e-4, 1e-3])
    slope = math.log(per_solid_angle[high] / per_solid_angle[low]) / math.log(node_angles()[high] / node_angles()[low])
    assert slope == pytest.approx(-1.346, abs=1e-6)


# Ocean Optics Web Book: index, slope, share scattered backwards as printed; the last is Petzold's average.
FOURNIER_FORAND = [
    (1.021, 3.0742, 0.0001, 0.05),
    (1.04, 3.201, 0.001, 0.01),
    (1.08, 3.483, 0.01, 0.005),
    (1.175, 4.065, 0.1, 0.005),
    (1.15, 4.874, 0.4, 0.005),
    (1.10, 3.5835, 0.0183, 0.005),
]


@pytest.mark.parametrize(("index", "slope", "share", "accuracy"), FOURNIER_FORAND)
def test_fournier_and_forand_scatters_back_as_much_as_published(index, slope, share, accuracy):
    phase = FournierForand(index, slope)
    back = 1 - within(phase, 90.0)
    # Printed with one or three digits, for an index printed to 0.001: at 1.021 that is 5 % of index - 1.
    assert back == pytest.approx(share, rel=accuracy)
    # The angles' integral, from the pole's share on, against the whole, which is 1 in closed form.
    nodes, weights = gauss_legendre(math.log(1e-3), math.log(math.pi), 400)
    angle = np.exp(nodes)
    beyond = 2 * math.pi * weights @ (phase.per_sr(angle) * np.sin(angle) * angle)
    # The table's logarithm is linear over 0.0088 with second derivatives below 1: 1e-5.
    assert 1 - within(phase, math.degrees(1e-3)) == pytest.approx(beyond, rel=3e-5)


@settings(deadline=None, max_examples=60)
@given(index=st.floats(1.001, 1.499), slope=st.floats(3.001, 4.999))
def test_fournier_and_forand_is_positive_and_smooth(index, slope):
    # The formula is 0 / 0 where sin^2(angle / 2) is 3 (index - 1)^2 / 4, about which it must stay smooth.
    middle = 2 * math.asin(math.sqrt(3) * (index - 1) / 2)
    angle = middle * np.exp(np.linspace(-0.2, 0.2, 401))
    value = np.log(FournierForand(index, slope).per_sr(angle))
    assert np.isfinite(value).all()
    # Steps of 0.001 of a function of slope and curvature below 10: 1e-5, less the rounding.
    assert np.abs(np.diff(value, 2)).max() < 1e-5
    everywhere = FournierForand(index, slope).per_sr(node_angles())
    assert (everywhere > 0).all()


def test_what_is_least_forward_is_close_to_petzold():
    # Fournier and Forand's (1.10, 3.5835) is known as the average particle's equivalent: the same to 30 % over six
    # orders of magnitude, while Henyey and Greenstein's, of the same mean cosine, is three times too low at 1 deg.
    angle = np.radians(np.geomspace(0.2, 150, 100))
    petzold = PetzoldAverage().per_sr(angle)
    ratio = FournierForand(1.10, 3.5835).per_sr(angle) / petzold
    assert 0.65 < ratio.min() < ratio.max() < 1.35
    degree = np.radians([1.0])
    blunt = HenyeyGreenstein(0.924).per_sr(degree) / PetzoldAverage().per_sr(degree)
    assert blunt[0] == pytest.approx(0.34, abs=0.01)


# --- what the renderer evaluates --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MEDIA)
def test_what_is_evaluated_integrates_to_one(name):
    medium = MEDIA[name]
    scattering = Scattering(medium, 635.0)
    edges = places(400)
    total = shares(medium, edges).sum()
    ends = one_minus_cosine(edges[[0, -1]])
    table = tabulate_phase_function(medium.scatterers(635.0))
    outside = np.interp(math.log(ends[0]), np.log(1 - np.cos(node_angles())), table.cumulative)
    outside += 2 * math.pi * (2 - ends[1]) * scattering.phase(mi.Float(2.0)).numpy()[0]
    # 32 bits leave 1e-6 of the logarithm, and the pole's share is read between nodes.
    assert total + outside == pytest.approx(1.0, abs=2e-5)
    assert scattering.coefficient == medium.scattering_per_mm(635.0)
    assert scattering.extinction == pytest.approx(medium.extinction_per_mm(635.0), rel=1e-12)
    assert scattering.absorption == medium.absorption_per_mm(635.0)


@pytest.mark.parametrize("name", MEDIA)
def test_what_is_evaluated_is_the_mixture_of_the_functions(name):
    medium = MEDIA[name]
    one_minus = one_minus_cosine(places(3000))
    found = Scattering(medium, 635.0).phase(to_jit(one_minus)).numpy()
    angle = 2 * np.arcsin(np.sqrt(np.float32(one_minus).astype(float) / 2))
    parts = medium.scatterers(635.0)
    # Petzold's own integral is 0.993723 by the trapezoidal rule over the logarithm of the angle, with 1e6 steps, and
    # its forward power in closed form.
    whole = {PetzoldAverage(): petzold_integral()}
    expected = sum(p.coefficient_per_mm * p.phase.per_sr(angle) / whole.get(p.phase, 1.0) for p in parts)
    expected /= sum(p.coefficient_per_mm for p in parts)
    # Within a cell of 0.0088 a curvature of 0.5 leaves 5e-6; one of Petzold's corners, where the slope changes by 0.25
    # at most, leaves a quarter of the cell times that, 5.5e-4. 32 bits leave 1e-6 of the logarithm.
    np.testing.assert_allclose(found, expected, rtol=6e-4)
    assert np.median(np.abs(found / expected - 1)) < 2e-5


def petzold_integral() -> float:
    """The integral of the average particle's function over all directions before it is normalised."""
    start = math.radians(0.1)
    log_angle = np.linspace(math.log(start), math.log(math.pi) - 1e-12, 10**6)
    value = PetzoldAverage().per_sr(np.exp(log_angle)) * np.sin(np.exp(log_angle)) * np.exp(log_angle)
    return 2 * math.pi * (np.trapezoid(value, log_angle) + 1772 * start**2 / (2 - 1.346))


def test_share_scattered_backwards_is_that_of_the_mixture():
    medium = MEDIA["coastal"]
    molecules, particles = (part.coefficient_per_mm for part in medium.scatterers(635.0))
    expected = (0.5 * molecules + 0.0183 * particles) / (molecules + particles)
    assert Scattering(medium, 635.0).backward_share == pytest.approx(expected, abs=0.5e-4)
    assert Scattering(MEDIA["pure"], 635.0).backward_share == pytest.approx(0.5, abs=1e-6)


def test_ends_and_nonsense_stay_within_the_table():
    scattering = Scattering(MEDIA["petzold"], 635.0)
    values = scattering.phase(mi.Float([0.0, 1e-30, 2.0, 2.1])).numpy()
    assert (values > 0).all()
    assert values[0] == values[1] > 1e5
    assert values[2] == values[3] < 0.004
    # A ray without a hit may have any argument; its result is not used, but must not read beyond the table.
    scattering.phase(mi.Float([math.nan, math.inf, -math.inf, -1.0])).numpy()


def test_a_medium_that_does_not_scatter_has_no_coefficient():
    scattering = Scattering(Medium(kind="air"), 635.0)
    assert (scattering.coefficient, scattering.absorption, scattering.extinction) == (0.0, 0.0, 0.0)


# --- what is drawn ----------------------------------------------------------------------------------------------------


def directions_after(scattering: Scattering, direction: Vector3f, u: Point2f) -> tuple[Vector3f, Float]:
    """Return directions after scattering, sampled as in random walks, and their densities in 1/sr."""
    after = rotate_about(direction, scattering.angles.heights(u.x), u.y)
    return after, scattering.phase(0.5 * dr.squared_norm(after - direction))


def drawn(medium: Medium, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Direction (3,) before, directions (count, 3) after scattering and their densities (count,) in 1/sr."""
    rng = np.random.default_rng(20)
    before = rng.normal(size=3)
    before = np.float32(before / np.linalg.norm(before))
    u = mi.Point2f(*(to_jit(rng.random(count)) for _ in range(2)))
    after, density = directions_after(Scattering(medium, 635.0), mi.Vector3f(*map(float, before)), u)
    return before.astype(float), to_numpy(after).astype(float), density.numpy()


def place_between(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """log((1 - cos) / (1 + cos)) of the angle between unit directions, good at both ends."""
    near, far = ((after - before) ** 2).sum(axis=1), ((after + before) ** 2).sum(axis=1)
    return np.log(np.maximum(near, 1e-30) / np.maximum(far, 1e-30))


@pytest.mark.parametrize("name", MEDIA)
def test_directions_are_drawn_as_the_phase_function_says(name):
    medium, count = MEDIA[name], 10**6
    before, after, density = drawn(medium, count)
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), 1.0, atol=3e-7)
    edges = places(101)
    expected = count * shares(medium, edges)
    found, _ = np.histogram(place_between(before, after), edges)
    # Bins with too few for the Gaussian limit are left out as one, with everything beyond the ends.
    kept = expected > 50
    assert kept.sum() > 10
    rest, rest_expected = count - found[kept].sum(), count - expected[kept].sum()
    chi2 = ((found - expected)[kept] ** 2 / expected[kept]).sum() + (rest - rest_expected) ** 2 / max(
        rest_expected, 1.0
    )
    # One of 1e4 good samplers fails; the seed is fixed. Errors of 1e-4 in every bin would add 0.01.
    assert chdtrc(kept.sum(), chi2) > 1e-4
    # The density goes with the direction, as far as 32 bits of the direction let one find the angle again.
    one_minus = ((after - before) ** 2).sum(axis=1) / 2
    far = (one_minus > 1e-6) & (one_minus < 1.99)
    again = Scattering(medium, 635.0).phase(to_jit(one_minus)).numpy()
    assert far.sum() > 0.2 * count
    np.testing.assert_allclose(again[far], density[far], rtol=5e-4)


@pytest.mark.parametrize("name", ["coastal", "backward"])
def test_directions_are_even_about_the_axis(name):
    before, after, _ = drawn(MEDIA[name], 10**6)
    axis = np.linalg.svd(before[None])[2]
    azimuth = np.arctan2(after @ axis[1], after @ axis[2])
    found, _ = np.histogram(azimuth, np.linspace(-math.pi, math.pi, 73))
    expected = len(after) / 72
    assert chdtrc(71, ((found - expected) ** 2 / expected).sum()) > 1e-4


@pytest.mark.parametrize("name", MEDIA)
def test_angles_grow_with_the_number_from_which_they_are_drawn(name):
    u = np.linspace(0, 1 - 2**-24, 200_001)
    numbers = mi.Point2f(to_jit(u), 0.3)
    after, density = directions_after(Scattering(MEDIA[name], 635.0), mi.Vector3f(0.0, 0.0, 1.0), numbers)
    directions = to_numpy(after).astype(float)
    assert np.isfinite(directions).all()
    assert (density.numpy() > 0).all()
    place = place_between(np.array([0.0, 0.0, 1.0]), directions)[1:]
    # 32 bits of the direction hold angles to 1e-7 rad, within 1e-2 of the smallest of 1.4e-5 rad.
    assert np.diff(place[place > math.log(1e-10)]).min() > -0.02
    assert place.max() - place.min() > 5


def test_another_water_needs_no_new_kernel():
    def use(medium: Medium) -> None:
        scattering = Scattering(medium, 635.0)
        u = mi.Point2f(to_jit(np.linspace(0, 0.99, 1234)), to_jit(np.linspace(0, 0.99, 1234)))
        after, density = directions_after(scattering, mi.Vector3f(0.0, 0.6, 0.8), u)
        dr.eval(after, density, scattering.phase(u.x))

    use(MEDIA["petzold"])
    dr.kernel_history()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for medium in (*MEDIA.values(), Medium(kind="air")):
            use(medium)
        launched = dr.kernel_history((dr.KernelType.JIT,))
    assert len(launched) >= len(MEDIA)
    assert all(kernel["cache_hit"] and not kernel["cache_disk"] for kernel in launched)


def test_the_table_is_as_fine_as_its_users_believe():
    assert NODES == len(node_angles()) == 4096
    assert node_angles()[0] == pytest.approx(math.sqrt(2e-10), rel=1e-6)
    assert math.pi - node_angles()[-1] == pytest.approx(math.sqrt(2 * 2**-17), rel=1e-3)
