"""Parameters of designs as arrays: pose, adjustments to the stand-off, and many designs at once."""

import math

import numpy as np
import pytest

from tests.virtual_sensors import altered
from twin.design.figures_of_merit import FIGURES, compute_figures, predict_scatter
from twin.design.sensor_arrays import adjust_to_standoff, extract_parameters
from uwlts.model.placement import camera_from_object, laser_pose, view_of_sheet
from uwlts.model.sensor import Sensor
from uwlts.optics.design import standoff_mm

TILTED = {"camera": {"window": {"tilt_x_deg": 8.0, "tilt_y_deg": -5.0}}}

OBLONG = {"camera": {"pixel_aspect": 1.05}}
RATIONAL = {"camera": {"distortion": {"p1": 0.004, "k3": 0.05, "k4": 0.6, "k5": -0.2, "k6": 0.3}}}


def numbers(sensor: Sensor, medium: str = "water"):
    return extract_parameters([sensor], [sensor.media[medium]])


@pytest.mark.parametrize("changes", [{}, TILTED, {"camera": {"stripe_along": "height"}}, {"laser": {"roll_deg": 12.0}}])
def test_the_pose_is_that_of_the_placement(thesis, changes):
    sensor = altered(thesis, changes)
    found, expected = numbers(sensor).pose(np), laser_pose(sensor)
    for ours, theirs in (
        (found.origin, expected.origin_mm),
        (found.axis, expected.axis),
        (found.fan, expected.fan),
        (found.normal, expected.normal),
    ):
        np.testing.assert_allclose(np.ravel(ours), theirs, atol=1e-12 * max(1, np.abs(theirs).max()))
    assert standoff_mm(found).item() == pytest.approx(camera_from_object(sensor)[2, 3], rel=1e-12)


@pytest.mark.parametrize(("along", "shorter"), [("width", 1.0), ("height", 1.05)])
def test_the_line_of_pixels_that_are_not_square(thesis, along, shorter):
    square = altered(thesis, {"camera": {"stripe_along": along}, "volume": {"near_mm": 300.0, "far_mm": 350.0}})
    oblong = altered(square, OBLONG)
    lengths = [
        compute_figures(numbers(s), reflectance=0.5, water_depth_m=100.0)[0].line_mm.item() for s in (square, oblong)
    ]
    views = [view_of_sheet(s, s.media["water"]).line_length_mm for s in (square, oblong)]
    # Snell's law converts slopes, at most 0.3, to angles.
    assert lengths[0] / lengths[1] == pytest.approx(shorter, rel=5e-3)
    assert views[0] / views[1] == pytest.approx(shorter, rel=5e-3)


def test_designs_are_judged_alike_alone_and_together(thesis, thesis_as_built):
    height = altered(thesis, {"camera": {"stripe_along": "height"}})
    tabulated = altered(thesis, {"laser": {"fan_profile": ((-20.0, 0.2), (0.0, 1.0), (22.0, 0.5))}})
    powell = altered(thesis, {"laser": {"fan_profile": "powell"}})
    sensors = [thesis, thesis_as_built, height, tabulated, powell]
    media = [sensor.media["water"] for sensor in sensors]
    together, reasons = compute_figures(extract_parameters(sensors, media), reflectance=0.5, water_depth_m=10.0)
    assert reasons == [""] * len(sensors)
    for place, (sensor, medium) in enumerate(zip(sensors, media, strict=True)):
        alone, _ = compute_figures(extract_parameters([sensor], [medium]), reflectance=0.5, water_depth_m=10.0)
        for name in FIGURES:
            np.testing.assert_allclose(getattr(together, name)[place], getattr(alone, name)[0], rtol=1e-12)


def test_a_laser_placed_by_its_axis_is_the_same_sensor(thesis):
    pose = laser_pose(thesis)
    placed = altered(
        thesis,
        {
            "laser": {
                "baseline_mm": None,
                "triangulation_angle_deg": None,
                "origin_mm": tuple(pose.origin_mm),
                "axis": tuple(pose.axis),
            }
        },
    )
    ours, _ = compute_figures(numbers(placed), reflectance=0.5, water_depth_m=10.0)
    theirs, _ = compute_figures(numbers(thesis), reflectance=0.5, water_depth_m=10.0)
    for name in FIGURES:
        np.testing.assert_allclose(getattr(ours, name), getattr(theirs, name), rtol=1e-9, equal_nan=True)


def test_what_follows_the_standoff(thesis):
    wide = altered(thesis, {"laser": {"baseline_mm": 300.0}})
    p = adjust_to_standoff(np, numbers(wide), ("focus", "waist", "volume"))
    standoff = camera_from_object(wide)[2, 3]
    window, index = wide.camera.window, wide.media["water"].refractive_index(635.0)
    outside = standoff - window.distance_mm - window.thickness_mm
    apparent = window.distance_mm + window.thickness_mm / 1.52 + outside / index
    assert p.focus_mm.item() == pytest.approx(apparent, rel=1e-9)
    assert p.waist_distance_mm.item() == pytest.approx(math.hypot(300.0, standoff), rel=1e-12)
    assert (p.near_mm.item() + p.far_mm.item()) / 2 == pytest.approx(outside, rel=1e-12)
    assert p.far_mm.item() - p.near_mm.item() == pytest.approx(220.0)


def test_scatter_at_a_depth_is_what_the_volume_has_there(thesis):
    sensor = altered(thesis, {"volume": {"near_mm": 250.0, "far_mm": 400.0}})
    p = numbers(sensor)
    transform = camera_from_object(sensor)
    outer = sensor.camera.window.distance_mm + sensor.camera.window.thickness_mm
    z = (outer + np.array([250.0, 325.0, 400.0]) - transform[2, 3]) / transform[2, 2]
    scatter = predict_scatter(p, z, np.full(3, 1e3), reflectance=0.5)
    found, _ = compute_figures(p, reflectance=0.5, water_depth_m=10.0)
    expected = [found.sigma_z_near_mm.item(), found.sigma_z_middle_mm.item(), found.sigma_z_far_mm.item()]
    # Root mean squares over 15 and over 7 places of a curve that changes by some 10 % along the stripe.
    np.testing.assert_allclose(scatter, expected, rtol=0.05)
