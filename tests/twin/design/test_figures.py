"""Compare the design formulas with known results of triangulation, optics and laser safety."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.virtual_sensors import altered
from twin.design.figures_of_merit import CLASS_NAMES, Figures, compute_figures, laser_class
from twin.design.sensor_arrays import adjust_to_standoff, extract_parameters
from uwlts.model.media import water_absorption_per_m, water_scattering_per_m
from uwlts.model.placement import view_of_sheet
from uwlts.model.sensor import Sensor

STANDOFF = 400.0
QUIET = {
    "read_noise_e": 1e-3,
    "dsnu_e": 0.0,
    "prnu": 0.0,
    "dark_current_e_per_s": 0.0,
    "bits": 12,
    "full_well_e": 100.0,
}


def judged(sensor: Sensor, medium: str = "water", *, follow=(), reflectance: float = 0.5) -> Figures:
    p = extract_parameters([sensor], [sensor.media[medium]])
    found, (reason,) = compute_figures(p, reflectance=reflectance, water_depth_m=100.0, follow=follow)
    assert reason == ""
    return found


def at_standoff(sensor: Sensor, baseline_mm: float) -> Sensor:
    """The sensor with another baseline whose sheet crosses the camera's axis at the same depth from the pupil."""
    laser = {"baseline_mm": baseline_mm, "triangulation_angle_deg": math.degrees(math.atan(baseline_mm / STANDOFF))}
    outer = sensor.camera.window.distance_mm + sensor.camera.window.thickness_mm
    middle = STANDOFF - outer
    return altered(sensor, {"laser": laser, "volume": {"near_mm": middle - 20, "far_mm": middle + 20}})


def reason_of(sensor: Sensor, *, follow=()) -> str:
    p = extract_parameters([sensor], [sensor.media["water"]])
    _, (reason,) = compute_figures(p, reflectance=0.5, water_depth_m=100.0, follow=follow)
    return reason


# --- triangulation ----------------------------------------------------------------------------------------------------


def test_twice_the_baseline_halves_depth_per_pixel_along_the_cameras_axis(thesis):
    for medium in ("air", "water"):
        single, double = (judged(at_standoff(thesis, b), medium) for b in (120.0, 240.0))
        # Z runs along the laser's axis, which leans by atan(B / stand-off).
        along_camera = [
            figures.depth_per_px_mm.item() * math.cos(math.atan(b / STANDOFF))
            for figures, b in ((single, 120.0), (double, 240.0))
        ]
        assert along_camera[0] / along_camera[1] == pytest.approx(2.0, rel=1e-9)


def test_depth_per_pixel_is_that_of_equation_2_9_in_air(thesis):
    bare = altered(thesis, {"camera": {"window": {"mounted": False}}, "laser": {"window": {"mounted": False}}})
    baseline = 200.0
    angle = math.atan(baseline / STANDOFF)
    sensor = altered(
        bare,
        {
            "laser": {"baseline_mm": baseline, "triangulation_angle_deg": math.degrees(angle)},
            "volume": {"near_mm": STANDOFF - 68.73 - 20, "far_mm": STANDOFF - 68.73 + 20},
        },
    )
    expected = STANDOFF**2 * 5.3e-3 / (baseline * 12.5) / math.cos(angle)
    # The volume counts from where the window's outer face would be.
    assert judged(sensor, "air").depth_per_px_mm.item() == pytest.approx(expected, rel=1e-9)


def test_the_occlusion_angle_on_the_axis_in_air_is_the_triangulation_angle(thesis):
    slim = altered(
        at_standoff(thesis, 200.0),
        {
            "camera": {"width_px": 16, "height_px": 16},
            "volume": {"near_mm": STANDOFF - 68.74, "far_mm": STANDOFF - 68.72},
        },
    )
    found = judged(slim, "air").occlusion_deg.item()
    # Eight pixels beside the axis are 0.2 deg.
    assert found == pytest.approx(math.degrees(math.atan(200.0 / STANDOFF)), abs=0.25)


def test_coverage_is_the_share_of_the_depth_in_view(thesis):
    view = view_of_sheet(thesis, thesis.media["water"])
    expected = (min(view.farthest_mm, 420.0) - max(view.nearest_mm, 200.0)) / 220.0
    assert 0.5 < expected < 0.95
    # The view is searched in steps of 0.15 mm.
    assert judged(thesis).coverage.item() == pytest.approx(expected, abs=0.3 / 220)
    whole = altered(thesis, {"volume": {"near_mm": view.nearest_mm + 1, "far_mm": view.farthest_mm - 1}})
    assert judged(whole).coverage.item() == 1.0


# --- noise ------------------------------------------------------------------------------------------------------------


def test_a_smaller_aperture_coarsens_speckle_and_sharpens_what_is_out_of_focus(thesis):
    def with_number(number: float) -> Figures:
        return judged(altered(thesis, {"camera": {"f_number": number}}), follow=("focus", "waist"))

    # Fast lenses blur the volume's ends, slow ones have coarse speckle: in between it is best.
    numbers = np.geomspace(1.0, 22.0, 25)
    scatter = np.array([with_number(n).sigma_z_rms_mm.item() for n in numbers])
    best = int(np.argmin(scatter))
    assert 0 < best < len(numbers) - 1
    assert scatter[-1] > 2.0 * scatter[best]
    # Defocus is proportional to 1 / N, and Dorsch's limit to N.
    fast, slow = with_number(2.0), with_number(4.0)
    assert fast.blur_px.item() / slow.blur_px.item() == pytest.approx(2.0, rel=0.02)  # diffraction apart
    assert slow.speckle_limit_mm.item() / fast.speckle_limit_mm.item() == pytest.approx(2.0, rel=1e-9)


def test_speckle_alone_makes_the_scatter_independent_of_the_light(thesis):
    bright = altered(thesis, {"laser": {"power_mw": 70.0}, "detector": {"read_noise_e": 0.0, "dsnu_e": 0.0}})
    deep = altered(bright, {"detector": {"full_well_e": 1e8}})
    once, twice = judged(deep, reflectance=0.4), judged(deep, reflectance=0.8)
    assert once.sigma_z_rms_mm.item() == pytest.approx(twice.sigma_z_rms_mm.item(), rel=1e-3)
    assert once.required_ms.item() == pytest.approx(2 * twice.required_ms.item(), rel=1e-9)


def test_photons_alone_make_the_scatter_fall_with_the_root_of_the_light(thesis):
    # Light of large line width on a rough surface gives no speckle; with few electrons, the form of the profile does
    # not matter.
    white = altered(thesis, {"detector": QUIET, "laser": {"linewidth_nm": 2000.0}})
    exposures = [judged(altered(white, {"exposure": {"laser_ms": ms}})) for ms in (1e-4, 4e-4)]
    ratio = exposures[0].sigma_z_rms_mm.item() / exposures[1].sigma_z_rms_mm.item()
    assert exposures[1].signal_e.item() < 10
    assert ratio == pytest.approx(2.0, rel=0.02)


def test_photon_noise_of_a_gaussian_line_is_sigma_over_the_root_of_n(thesis):
    white = altered(thesis, {"detector": QUIET, "laser": {"linewidth_nm": 2000.0}, "exposure": {"laser_ms": 2e-4}})
    slim = altered(white, {"volume": {"near_mm": 309.0, "far_mm": 310.5}})
    found = judged(slim, follow=("focus", "waist"))
    electrons = math.sqrt(2 * math.pi) * found.stripe_px.item() * found.signal_e.item()
    # Signal and width are the extremes of a small volume, along which they change by some 10 %.
    assert found.centre_px.item() == pytest.approx(found.stripe_px.item() / math.sqrt(electrons), rel=0.1)


def test_speckle_contrast_in_a_pixel_is_below_that_of_two_polarisations(thesis):
    contrast = extract_parameters([thesis], [thesis.media["water"]]).pixel_contrast(np).item()
    assert 0.2 < contrast < 1 / math.sqrt(2)


# --- light ------------------------------------------------------------------------------------------------------------


def test_green_light_wins_over_red_beyond_some_range(thesis):
    # For a calculation by hand: without speckle, whose grains are finer in green, and only in the middle of the image.
    slim = {"camera": {"width_px": 16}, "volume": {"near_mm": 309.0, "far_mm": 309.2}, "exposure": {"longest_ms": 1e9}}

    def exposure(wavelength_nm: float, baseline_mm: float) -> float:
        laser = {"wavelength_nm": wavelength_nm, "baseline_mm": baseline_mm, "linewidth_nm": 2000.0}
        return judged(altered(thesis, slim | {"laser": laser}), follow=("focus", "waist", "volume")).required_ms.item()

    ratio = np.array([exposure(635.0, b) / exposure(520.0, b) for b in (150.0, 265.0, 400.0, 700.0)])
    assert (np.diff(ratio) > 0).all() and ratio[0] < 1 < ratio[-1]
    crossing = brentq(lambda b: exposure(635.0, b) - exposure(520.0, b), 150.0, 700.0, xtol=1e-3)
    # Red has 635 / 520 times the photons per watt, and loses the factor exp(-(c_red - c_green) length) in the water.
    red, green = (
        water_absorption_per_m(wavelength_nm=nm) + water_scattering_per_m(wavelength_nm=nm, salinity_g_kg=0.0)
        for nm in (635.0, 520.0)
    )
    standoff = crossing / math.tan(math.radians(35.0))
    way_m = 1e-3 * (standoff - 68.73 + math.hypot(standoff, crossing) - 35.93)
    # Diffraction, 1 % of a stripe's width, and the indices of water, by 0.3 %, favour one of them by as little.
    assert way_m == pytest.approx(math.log(635.0 / 520.0) / (red - green), rel=0.06)
    # So green is better if the sheet crosses the camera's axis more than about 0.4 m from the camera.
    assert 0.35 < 1e-3 * standoff < 0.5


def test_absorption_costs_what_beer_and_lambert_say(thesis):
    clear = altered(thesis, {"media": {"water": {"absorption_per_m": 0.0, "scattering_per_m": 0.0}}})
    dark = altered(thesis, {"media": {"water": {"absorption_per_m": 1.0, "scattering_per_m": 0.0}}})
    thin = {"volume": {"near_mm": 309.0, "far_mm": 310.4}, "camera": {"width_px": 16}}
    lost = judged(altered(dark, thin)).required_ms.item() / judged(altered(clear, thin)).required_ms.item()
    # Path to the stand-off without the laser's window (30 mm in air and 5.93 mm of glass), and back to the camera's.
    way_m = 1e-3 * (math.hypot(378.46, 265.0) - 35.93 + 309.73)
    assert lost == pytest.approx(math.exp(way_m), rel=2e-3)


# --- safety -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("power_mw", "fan_deg", "expected"),
    [
        (0.3, 45.0, "1"),
        (7.0, 45.0, "2"),
        (30.0, 45.0, "3R"),
        (300.0, 45.0, "3B"),
        (9000.0, 45.0, "4"),
        (7.0, 0.5, "3B"),
    ],
)
def test_laser_classes(thesis, power_mw, fan_deg, expected):
    # A pupil of 7 mm at 100 mm subtends 4.0 deg, 8.9 % of 45 deg; a fan of 0.5 deg enters completely.
    sensor = altered(thesis, {"laser": {"power_mw": power_mw, "fan_angle_deg": fan_deg}})
    p = extract_parameters([sensor], [sensor.media["water"]])
    found, _ = compute_figures(p, reflectance=0.5, water_depth_m=100.0)
    assert CLASS_NAMES[int(found.laser_class.item())] == expected


@pytest.mark.parametrize("profile", ["flat", "gaussian"])
@pytest.mark.parametrize("fan_deg", [8.0, 30.0, 45.0, 80.0])
def test_the_class_changes_with_the_power_through_7_mm_at_100_mm(thesis, profile, fan_deg):
    """Classes 2, 3R, 3B and 4 begin at 0.39, 1, 5 and 500 mW through the aperture (IEC 60825-1, condition 3).

    The power through it is the integral of the profile over its angle. The estimate takes the largest power per angle
    for all of it, which is more for a Gaussian profile, by less than 14 % in the narrowest fan.
    """
    half = math.radians(fan_deg) / 2
    angle = np.linspace(-half, half, 200_001)
    density = np.exp(-2 * (angle / half) ** 2) if profile == "gaussian" else np.ones_like(angle)
    share = density[np.abs(angle) <= math.atan(3.5 / 100.0)].sum() / density.sum()
    most = math.exp(2 * (math.atan(0.035) / half) ** 2) if profile == "gaussian" else 1.0

    def class_of(power_mw: float) -> str:
        laser = {"power_mw": power_mw, "fan_angle_deg": fan_deg, "fan_profile": profile}
        sensor = altered(thesis, {"laser": laser})
        return CLASS_NAMES[int(laser_class(extract_parameters([sensor], [sensor.media["water"]])).item())]

    for limit_mw, below, above in ((0.39, "1", "2"), (1.0, "2", "3R"), (5.0, "3R", "3B"), (500.0, "3B", "4")):
        assert class_of(limit_mw / share * 1.001) == above
        assert class_of(limit_mw / share / most * 0.999) == below


def test_the_optical_depth_of_scattering_is_the_coefficient_times_the_longest_path(thesis):
    def depth(per_m: float) -> float:
        return judged(altered(thesis, {"media": {"water": {"scattering_per_m": per_m}}})).scattering_depth.item()

    assert depth(3.0) == pytest.approx(3 * depth(1.0), rel=1e-9)
    # On the axes at the far end, 420 mm from the camera's window: the laser's path behind its window, 35.93 mm from its
    # origin, and the camera's path, aslant by less than tan 35 deg. The ends of the line are farther by up to a tenth.
    laser = 265 / math.sin(math.radians(35)) + (420 - 309.73) / math.cos(math.radians(35)) - 35.93
    assert 1e-3 * (laser + 420) < depth(1.0) < 1.1e-3 * (laser + 420 / math.cos(math.radians(11)))


def test_the_window_for_the_pressure_is_that_of_equation_3_2(thesis):
    from uwlts.optics.design import window_thickness_mm

    pressure = 1e-6 * 1030.0 * 9.81 * 100.0
    expected = window_thickness_mm(pressure_mpa=pressure, unsupported_diameter_mm=63.0, strength_mpa=60.0)
    assert judged(thesis).window_mm.item() == pytest.approx(expected, rel=1e-12)
    # Acrylic, also by a common name, is weaker than the fused silica that replaces an unknown material.
    acrylic = altered(thesis, {"camera": {"window": {"glass": "acrylic"}}})
    assert judged(acrylic).window_mm.item() == pytest.approx(expected * math.sqrt(60 / 41.4), rel=1e-12)
    # 5.93 mm in front of 63 mm (camera) and 50 mm (laser): the wider one is weaker, in proportion to 1 / diameter^2.
    assert judged(thesis).window_safety.item() == pytest.approx(4 * (5.93 / expected) ** 2, rel=1e-12)
    thin = judged(altered(thesis, {"laser": {"window": {"thickness_mm": 4.0}}})).window_safety.item()
    assert thin == pytest.approx(4 * (4.0 / (expected * 50 / 63)) ** 2, rel=1e-12)


# --- designs that cannot work -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"laser": {"baseline_mm": 20.0}}, "behind the window"),
        ({"camera": {"focus_distance_mm": 10.0}}, "not larger than the focal length"),
        ({"camera": {"window": {"aperture_diameter_mm": 20.0}}}, "cone of view"),
        ({"laser": {"window": {"distance_mm": 200.0}}}, "fan is"),
        ({"volume": {"near_mm": 900.0, "far_mm": 950.0}}, "reach no point"),
        ({"laser": {"roll_deg": 90.0}}, "other side"),
        ({"exposure": {"laser_ms": 100.0}}, "saturates"),
    ],
)
def test_why_designs_cannot_work(thesis, changes, says):
    assert says in reason_of(altered(thesis, changes))


def test_a_volume_that_would_begin_inside_the_housing(thesis):
    close = altered(thesis, {"laser": {"baseline_mm": 110.0}})
    assert "would begin" in reason_of(close, follow=("volume",))
    p = adjust_to_standoff(np, extract_parameters([close], [close.media["water"]]), ("volume",))
    assert p.near_mm.item() < 0
