"""Drawn scans of spheres measured as in the thesis's campaigns: stripes by sphere, figures, reported failures."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.drawn_stripes import (
    RADIUS_MM,
    SENSOR,
    SPACING_MM,
    SPHERES,
    STAGE_MM,
    sphere_profiles,
    stripe_image,
    write,
)
from uwlts.errors import EvaluationError
from uwlts.evaluation.evaluate import evaluate
from uwlts.optics.nominal import nominal_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import read_cloud
from uwlts.thesis.campaign_folder import ScanFile
from uwlts.thesis.measurements import METHODS, _figures, _line_length, _range_within, measure_scan
from uwlts.thesis.sphere_spacing import sphere_scan

EXACT = nominal_calibration(SENSOR)


@pytest.fixture(scope="module")
def spheres(tmp_path_factory):
    """A scan of two spheres at the stand-off in water."""
    images = [
        stripe_image(profile, np.random.default_rng(number)) for number, profile in enumerate(sphere_profiles(15.0))
    ]
    path = tmp_path_factory.mktemp("scan") / "spheres-standoff-water.h5"
    return write(path, images, stage_mm=STAGE_MM, artefact=SPHERES)


def test_stripes_are_sorted_by_sphere(spheres):
    with Capture(spheres) as capture:
        scan = sphere_scan(capture, EXACT, placement="standoff")
    assert (scan.placement, scan.spacing_mm) == ("standoff", SPACING_MM)
    np.testing.assert_array_equal(np.unique(scan.stage_mm), STAGE_MM)
    checked = 0
    for x, profile in zip(STAGE_MM, sphere_profiles(15.0), strict=True):
        for number, pixels in enumerate(profile):
            own = scan.pixels[(scan.stage_mm == x) & (scan.sphere == number)]
            order = np.argsort(pixels[:, 0])
            apart = own[:, 1] - np.interp(own[:, 0], pixels[order, 0], pixels[order, 1])
            # Noise of 1 of 180 grey levels moves a centre by some 0.01 px; a stripe on the other sphere is far away.
            assert len(own) > 50 and np.abs(apart).max() < 0.1
            assert pixels[:, 0].min() <= own[:, 0].min() and own[:, 0].max() <= pixels[:, 0].max()
            checked += len(own)
    assert checked == len(scan.pixels) == len(scan.sphere) == len(scan.stage_mm)
    points = np.concatenate([[RADIUS_MM * np.array([math.cos(a), math.sin(a), b])] for a in range(6) for b in (0, 0.3)])
    apart = np.concatenate([points, points + [0.0, SPACING_MM + 0.25, 0.0]])
    labels = replace(scan, sphere=np.repeat([0, 1], len(points)))
    assert labels.spacing_error(apart) == pytest.approx(0.25, abs=1e-8)


def test_a_scan_without_its_spheres_is_refused(tmp_path):
    plane = np.column_stack([np.arange(20, 600), np.full(580, 250.0)])
    path = write(
        tmp_path / "plane.h5",
        [stripe_image([plane], np.random.default_rng(0))] * 3,
        stage_mm=[0.0, 1.0, 2.0],
        artefact=SPHERES,
    )
    with Capture(path) as capture, pytest.raises(EvaluationError):
        sphere_scan(capture, EXACT, placement="here")


def test_a_scan_is_measured_by_every_method_and_either_processing(spheres, tmp_path):
    wrong = EXACT.model_copy(update={"camera": EXACT.camera.model_copy(update={"width_px": 1280})})
    methods = METHODS["water"]
    calibrations = {(method, "water"): EXACT for method in methods} | {(methods[-1], "water"): wrong}
    found = measure_scan(ScanFile(spheres, "spheres", "standoff", "water"), calibrations, clouds=tmp_path)
    assert [(m.method, m.processing) for m in found] == [
        *((method, "ours") for method in methods),
        *((method, "thesis") for method in methods),
        ("proposed", "thesis, mean of 5x5"),
        ("proposed", "thesis, fit over 3 px"),
        ("proposed", "thesis, fit over 7 px"),
    ]
    for m in found:
        assert (m.thing, m.placement, m.medium) == ("spheres", "standoff", "water")
        if m.method == methods[-1]:
            assert m.figures_mm == {} and m.points == 0
            assert "1280" in m.failure
            continue
        assert m.failure is None and m.points > 1000
        # The centre of a cap is known to some 5 standard deviations over the root of its 1700 points; for two of them
        # 0.17 standard deviations, 3 times. A mean over five columns lowers a stripe that is bent by 1 px in 10 px, as
        # these are at their sides, by a hundredth of a pixel; a pixel is 0.4 mm here.
        assert abs(m.figures_mm["SSE"]) < 0.5 * m.figures_mm["STD"] + 0.004
        assert 2 * m.figures_mm["STD"] < m.figures_mm["PE"] <= m.figures_mm["PE of all points"]
        # The stripe spans both spheres' visible caps: the spacing and twice the radius times the sine of 1.1 rad, less
        # at the outer profiles; the ends of the stripe are left out.
        assert SPACING_MM < m.figures_mm["line length"] < SPACING_MM + 2 * RADIUS_MM * math.sin(1.1)
    by = {(m.method, m.processing): m.figures_mm["STD"] for m in found if m.failure is None}
    # Noise of 1 in 180 grey levels moves our centres by 0.01 px at most, 0.005 mm. LabVIEW's filter takes the flanks of
    # a stripe this narrow for noise, pixel by pixel, which a plain mean does not.
    for method in methods[:-1]:
        assert 0 < by[method, "ours"] < 0.005
        assert by[method, "thesis"] > 5 * by[method, "ours"]
    assert by["proposed", "thesis, mean of 5x5"] < 0.2 * by["proposed", "thesis"]
    assert list(tmp_path.iterdir()) == []


def test_clouds_of_free_forms_are_kept(spheres, tmp_path):
    calibrations = {(method, "water"): EXACT for method in METHODS["water"]}
    found = measure_scan(ScanFile(spheres, "head", "standoff", "water"), calibrations, clouds=tmp_path)
    assert len(found) == 2 * len(METHODS["water"])
    kept = sorted(path.name for path in tmp_path.iterdir())
    names = sorted(f"spheres-standoff-water-{method.replace(' ', '-')}.ply" for method in METHODS["water"])
    assert kept == names
    cloud = read_cloud(tmp_path / names[0])
    assert np.isfinite(cloud.deviation_mm).sum() > 1000


def test_ranges_leave_out_three_in_a_thousand_of_those_evaluated():
    values = np.linspace(-1.0, 1.0, 1000)
    values[[100, 500, 900]] = (7.0, -8.0, 9.0)
    # Three of a thousand: the strays. With NaN for points not evaluated it is three of those that were.
    assert _range_within(np.append(values, np.full(5000, np.nan))) == pytest.approx(2.0)
    assert _range_within(values[:999]) == pytest.approx(7.0 - values[0])
    assert _range_within(np.array([0.5, -0.25])) == 0.75


def test_the_line_length_is_that_of_the_usual_profile():
    y = np.concatenate([np.linspace(-40, 40, 9), np.linspace(-41, 41, 9), np.linspace(0, 1, 9)])
    cloud = PointCloud(
        points_mm=np.column_stack([0 * y, y, 0 * y]),
        intensity=np.ones(27),
        frame=np.repeat([0, 3, 7], 9),
        line=np.arange(27),
        metadata={},
    )
    assert _line_length(cloud) == pytest.approx(80.0)


def test_figures_of_a_plane_stand_beside_those_of_all_points():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-50, 50, (40000, 2)), rng.normal(0, 0.05, 40000)])
    cloud = PointCloud(
        points_mm=points,
        intensity=np.ones(40000),
        frame=np.repeat(np.arange(40), 1000),
        line=np.arange(40000),
        metadata={},
    )
    figures = _figures(evaluate(cloud, {"kind": "plane"}))
    # Of 40,000 normal numbers, the largest exceed 4 standard deviations; without 0.3 % of them, 2.97.
    assert figures["STD"] == pytest.approx(0.05, rel=0.05)
    assert figures["RE"] == pytest.approx(2 * 2.97 * 0.05, rel=0.05)
    assert figures["RE of all points"] > 1.1 * figures["RE"]
    assert "std to the true surface" not in figures
