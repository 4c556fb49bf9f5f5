"""Random reflectance of surfaces against its stated distribution and spectrum, in numbers and in rendered stripes."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import quad, trapezoid
from scipy.stats import lognorm

from tests.virtual_sensors import altered, clear, plate, scene_of, sensor_at
from twin.backend.arrays import to_jit
from twin.light.renderer import Renderer
from twin.recording.frame_truth import find_true_stripe
from twin.rendering_options import NONE
from twin.scene.objects import Objects, build_objects
from twin.scene.scene_object import Pose
from twin.scene.surfaces import FINISHES, clipped_share, draw_patches, draw_waves
from uwlts.model.sensor import Sensor

FINEST = 10 * math.pi
"""Cut-off of the spectrum times the correlation length, as stated: a wavelength of a fifth of that length."""
ROOT = Path(__file__).resolve().parents[3]
SEEDS = 200
SHAPES: list[dict[str, Any]] = [
    plate(side=60.0),
    {"kind": "sphere", "diameter_mm": 40.0},
    {"kind": "pipe", "diameter_mm": 40.0, "length_mm": 60.0},
    {"kind": "seabed", "width_mm": 60.0, "height_mm": 60.0},
]


def built(*things: dict[str, Any], seed: int = 0) -> Objects:
    return build_objects(scene_of(*things), medium_index=1.3312, wavelength_nm=635.0, seed=seed)


def albedo(objects: Objects, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (N,) and points (N, 3) that are hit by rays along z."""
    origin, along = (mi.Point3f(*(to_jit(c) for c in v.T)) for v in (start, np.tile([0, 0, 1.0], (len(start), 1))))
    si = objects.scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(along)))
    found = objects.albedo(si)
    dr.eval(found, si.p)
    return found.numpy(), np.stack([each.numpy() for each in si.p], axis=1)


def correlation(distance: float) -> float:
    """Autocorrelation of the Gaussian field at a distance in correlation lengths: its spectrum, cut off, transformed.

    Over space, a shell of wave numbers k gives sin(k d) / (k d).
    """
    weight, _ = quad(lambda k: k**2 / (1 + k**2) ** 2, 0, FINEST)
    total, _ = quad(lambda k: k**2 / (1 + k**2) ** 2 * np.sinc(k * distance / np.pi), 0, FINEST, limit=400)
    return total / weight


def covariance(distance: float, mottle: float) -> float:
    """Autocovariance of the log-normal field of mean 1: exp(s^2 c) - 1 for the autocorrelation c of its logarithm."""
    return math.expm1(math.log1p(mottle**2) * correlation(distance))


@pytest.mark.parametrize("lengths", [0.8, (10.0, 0.2, 1.0)], ids=["isotropic", "lay along x"])
def test_a_field_has_its_autocorrelation_along_each_axis(lengths):
    # Waves of independent phases have the autocovariance mean(cos(k r)) over the waves; its standard error is taken
    # from the scatter over the seeds.
    for axis, length in enumerate(np.broadcast_to(lengths, 3)):
        for distance in (0.1, 0.5, 1.0, 2.0):
            each = [
                np.cos(distance * length * draw_waves(np.random.default_rng([k, axis]), lengths)[:, axis]).mean()
                for k in range(SEEDS)
            ]
            error = np.std(each) / math.sqrt(SEEDS)
            # Five standard errors: a false alarm in 2e6 tests.
            assert abs(np.mean(each) - correlation(distance)) < 5 * error
            # The omitted 4 % of the power had no correlation left.
            assert abs(correlation(distance) - math.exp(-distance)) < 0.045


def test_the_lost_part_of_clipped_reflectances_is_that_of_the_density():
    for mean, mottle in ((0.8, 0.1), (0.6, 0.35), (0.3, 1.0)):
        s = math.sqrt(math.log1p(mottle**2))
        shape = {"s": s, "scale": mean * math.exp(-(s**2) / 2)}
        assert lognorm.std(**shape) == pytest.approx(mean * mottle)
        lost, _ = quad(lambda x, shape=shape: (x - 1) * lognorm.pdf(x, **shape), 1, np.inf)
        assert clipped_share(mean, mottle) == pytest.approx(lost / mean, rel=1e-6)
    assert clipped_share(0.9, 0.0) == clipped_share(0.0, 0.5) == 0


@pytest.mark.parametrize("thing", SHAPES, ids=lambda thing: str(thing["kind"]))
def test_the_reflectance_is_fixed_to_the_object_whatever_its_shape_and_pose(thing):
    mottled = thing | {"reflectance": 0.4, "mottle": 0.3, "mottle_mm": (4.0, 1.0, 2.0)}
    pose = {"position_mm": (3.0, -2.0, 5.0), "rotation_deg": (12.0, -8.0, 20.0)}
    start = np.column_stack([np.random.default_rng(0).uniform(-8, 8, (200, 2)), np.full(200, -60.0)])
    matrix = Pose(**pose).matrix()
    values, points = albedo(built(mottled | pose, seed=3), start)
    # The waves of the object's own frame, as drawn for the first object of the scene.
    waves = draw_waves(np.random.default_rng([3, 0, 11, 0]), (4.0, 1.0, 2.0))
    own = (points - matrix[:3, 3]) @ matrix[:3, :3]
    field = math.sqrt(2 / len(waves)) * np.cos(own @ waves[:, :3].T + waves[:, 3]).sum(axis=1)
    s = math.sqrt(math.log1p(0.3**2))
    expected = 0.4 * np.exp(s * field - s**2 / 2)
    # Positions in single precision, 1e-5 mm, times wave numbers of 31 per mm.
    np.testing.assert_allclose(values, np.minimum(expected, 1), rtol=2e-3)
    assert np.std(values) > 0.05


def test_mean_and_scatter_of_the_reflectance_are_as_stated():
    grid = np.stack(np.meshgrid(np.arange(-24, 25, 6.0), np.arange(-24, 25, 6.0), [-10.0]), axis=-1).reshape(-1, 3)
    thing = plate(side=60.0) | {"finish": "rusted-steel", "reflectance": None}
    row = FINISHES["rusted-steel"]
    values = np.stack([albedo(built(thing, seed=k), grid)[0] for k in range(40)]) / row.reflectance
    means, squares = values.mean(axis=1), ((values - 1) ** 2).mean(axis=1)
    for found, expected in ((means, 1.0), (squares, row.mottle**2)):
        assert abs(found.mean() - expected) < 5 * found.std() / math.sqrt(len(found))


def test_equal_seeds_give_equal_surfaces_and_objects_differ():
    two = [plate(side=20.0, x=x) | {"finish": "concrete", "reflectance": 0.35} for x in (-20.0, 20.0)]
    start = np.stack(np.meshgrid(np.arange(-5, 6, 1.0), np.arange(-5, 6, 1.0), [-10.0]), axis=-1).reshape(-1, 3)
    left, right = start + (-20.0, 0, 0), start + (20.0, 0, 0)
    first, again, other = built(*two, seed=1), built(*two, seed=1), built(*two, seed=2)
    np.testing.assert_array_equal(albedo(first, left)[0], albedo(again, left)[0])
    assert abs(np.corrcoef(albedo(first, left)[0], albedo(other, left)[0])[0, 1]) < 0.5
    assert abs(np.corrcoef(albedo(first, left)[0], albedo(first, right)[0])[0, 1]) < 0.5


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_patches_cover_their_share_in_pieces_of_their_length(share):
    length, way = 3.0, np.arange(0, 400, 0.02)
    covered, pieces = [], []
    for seed in range(60):
        waves, level = draw_patches(np.random.default_rng(seed), share=share, length_mm=length)
        field = np.zeros_like(way)
        for k, phase in waves[:, [0, 3]]:
            field += math.sqrt(2 / len(waves)) * np.cos(k * way + phase)
        inside = field > level
        covered.append(inside.mean())
        pieces.append(np.count_nonzero(inside[1:] & ~inside[:-1]))
    for found, expected in ((covered, share), (pieces, share * np.ptp(way) / length)):
        # A sum of 64 waves is normal to 1 % of the share at these levels.
        assert abs(np.mean(found) - expected) < 5 * np.std(found) / math.sqrt(len(found)) + 0.02 * expected
        assert np.std(found) / math.sqrt(len(found)) < 0.05 * expected


def test_patches_have_their_own_reflectance_and_interrupt_the_stripe(thesis: Sensor):
    sensor = altered(thesis, {"camera": {"width_px": 600, "height_px": 96}})
    grown = plate() | {"reflectance": 0.5, "patch_share": 0.3, "patch_length_mm": 6.0, "patch_reflectance": 0.0}
    start = np.column_stack([np.random.default_rng(0).uniform(-25, 25, (400, 2)), np.full(400, -10.0)])
    found, _ = albedo(built(grown, seed=2), start)
    assert set(np.unique(found.round(5))) == {0.0, 0.5}
    whole, gaps = (
        Renderer(sensor, clear(), scene_of(thing), effects=NONE, seed=2) for thing in (plate(reflectance=0.5), grown)
    )
    light = [each.laser_frame(sensor_at(), spp=16).irradiance().sum(axis=0) for each in (whole, gaps)]
    share = light[1] / light[0]
    # The stripe is 1 to 2 px wide, so that most lines are within a patch or beside one.
    assert 0.05 < (share < 0.01).mean() < 0.6
    assert (share > 0.99).mean() > 0.3
    assert ((share > 0.05) & (share < 0.95)).mean() < 0.15
    # Lines without light have no true centre; the centre of the others is that of the sheet.
    truths = [find_true_stripe(each, sensor_at()) for each in (whole, gaps)]
    lost = np.isnan(truths[1].centre_px)
    assert lost[share < 0.01].mean() > 0.95
    assert not lost[share > 0.99].any()
    np.testing.assert_allclose(truths[1].centre_px[~lost], truths[0].centre_px[~lost], atol=1e-4)


@pytest.mark.parametrize("finish", FINISHES)
def test_every_finish_is_physical(finish):
    (thing,) = scene_of(plate() | {"reflectance": None, "finish": finish}).objects
    own = thing.finish_properties()
    assert own == FINISHES[finish]
    assert clipped_share(own.reflectance, own.mottle) < 0.01


def test_the_documented_table_of_finishes_is_the_one_that_is_rendered():
    page = (ROOT / "docs" / "explanation" / "light.md").read_text(encoding="utf-8")
    documented = {}
    for line in page[page.index("| `finish` | reflection") :].split("\n\n")[0].splitlines()[2:]:
        name, reflection, *numbers = (cell.strip() for cell in line.strip("|").split(" | "))
        documented[name.strip("`")] = reflection, *(numbers[k] for k in (0, 2, 3)), numbers[5].strip("| ")
    for name, row in FINISHES.items():
        reflection, reflectance, roughness, mottle, others = documented.pop(name)
        found = reflection, float(reflectance), float(roughness), float(mottle or 0)
        assert found == (row.reflection, row.reflectance, row.roughness_um, row.mottle)
        for key in ("mean_free_path_mm", "patch_share"):
            value = getattr(row, key)
            assert (f"`{key}` {value:g}" in others) == (value > 0)
    assert not documented


def filtered_covariance(lag_mm: float, *, sigma_mm: float, pixel_mm: float, length_mm: float, mottle: float) -> float:
    """Autocovariance of a stripe's light along it: the field's, averaged over two Gaussian sheets and two pixels."""
    table = np.concatenate([np.linspace(0, 4, 60), np.linspace(4.2, 12, 30)])
    values = np.array([covariance(d, mottle) for d in table])
    across = np.linspace(-8, 8, 321) * sigma_mm
    along = np.linspace(-pixel_mm, pixel_mm, 41)
    distance = np.hypot(across[:, None], along + lag_mm) / length_mm
    weight = np.exp(-(across**2) / (4 * sigma_mm**2))[:, None] * (pixel_mm - np.abs(along))
    found = np.interp(distance, table, values, right=0.0)
    total = trapezoid(trapezoid(weight * found, along), across) / trapezoid(trapezoid(weight, along), across)
    return float(total)


def test_the_rendered_stripe_has_the_spectrum_filtered_by_the_sheet(thesis: Sensor):
    mottle, length = 0.3, 0.8
    sensor = altered(thesis, {"camera": {"width_px": 400, "height_px": 96}})
    thing = plate() | {"reflectance": 0.3, "mottle": mottle, "mottle_mm": length}
    lags, found = (0, 1, 2, 5, 10, 20), []
    plain = Renderer(sensor, clear(), scene_of(plate(reflectance=0.3)), effects=NONE)
    even = plain.laser_frame(sensor_at(), spp=16).irradiance().sum(axis=0)
    light = plain.sheet.evaluate(mi.Point3f(0.0, 0.0, 0.0))
    sigma = float(light.sigma_mm[0])
    bundle = plain.view.trace_bundle(mi.Float([199.0, 200.0]), mi.Float([47.5, 47.5]))
    at_plate = bundle.origin + bundle.direction * (-bundle.origin.z / bundle.direction.z)
    pixel = float(np.ptp(at_plate.y.numpy()))
    for seed in range(30):
        renderer = Renderer(sensor, clear(), scene_of(thing), effects=NONE, seed=seed)
        ratio = renderer.laser_frame(sensor_at(), spp=16).irradiance().sum(axis=0) / even - 1
        found.append([np.mean(ratio[: len(ratio) - k] * ratio[k:]) for k in lags])
    optics = {"sigma_mm": sigma, "pixel_mm": pixel, "length_mm": length, "mottle": mottle}
    expected = np.array([filtered_covariance(k * pixel, **optics) for k in lags])
    error = np.std(found, axis=0) / math.sqrt(len(found))
    # Five standard errors, and 2 % of the variance for 16 samples per pixel.
    assert (np.abs(np.mean(found, axis=0) - expected) < 5 * error + 0.02 * expected[0]).all()
    assert expected[0] < 0.9 * mottle**2, "the sheet must average the texture, or nothing is tested"
    assert error[0] < 0.1 * expected[0]


def test_a_rounded_edge_of_steel_glints_where_its_normal_bisects_light_and_view(thesis: Sensor):
    sensor = altered(thesis, {"camera": {"width_px": 64, "height_px": 160}})
    steel = {"kind": "block", "size_mm": (40.0, 40.0, 20.0), "position_mm": (0.0, 0.0, 10.0), "edge_radius_mm": 3.0}
    steel |= {"finish": "metal", "alpha": 0.1}
    renderer = Renderer(sensor, clear(), scene_of(steel), effects=replace(NONE, gloss=True))
    bundle = renderer.view.trace_bundle(mi.Float(31.5), mi.Float(79.5))
    seen = np.array([float(each[0]) for each in bundle.direction])
    half = -seen - (0.0, 0.0, 1.0)
    half /= np.linalg.norm(half)
    # The arc's centre is 17 mm from the middle, on the side to which the bisector leans.
    side = np.sign(half[0])
    glint = side * 17.0 + 3.0 * half[0]
    places = side * np.arange(12.0, 19.5, 0.15)
    light = np.array([renderer.laser_frame(sensor_at(x=x), spp=16).irradiance().max() for x in places])
    # Facets are 3.75 degrees wide, 0.2 mm here.
    assert abs(places[np.argmax(light)] - glint) < 0.3
    flat = light[np.abs(places) < 16.5]
    assert light.max() > 3 * flat.max()
    np.testing.assert_allclose(flat, flat.mean(), rtol=0.05)
    # The truth follows the rounding: the true surface point is on the arc.
    truth = find_true_stripe(renderer, sensor_at(x=glint))
    points = truth.point_mm[np.isfinite(truth.centre_px)]
    away = np.hypot(points[:, 0] - side * 17.0, points[:, 2] - 3.0)
    assert len(points) > 30
    np.testing.assert_allclose(away, 3.0, atol=2e-3)
