"""Joint calibration on views by Fermat's principle: derivatives, results and stated uncertainties."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import WATER, built_sensor, square_sensor
from tests.uwlts.joint_views import Noise, assert_derivatives, edited, gathered, lit_points, step_views, target_series
from tests.uwlts.simulated_campaign import ModelErrors, drawn_reality, evidence
from tests.virtual_sensors import altered
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.joint.initial import estimate_series_start
from uwlts.calibration.joint.parameters import DescribedSheet, Parameters, Prior, ViewMedium, window_values
from uwlts.calibration.joint.residuals import TARGET, StepProfileEvidence, TargetEvidence
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError
from uwlts.model.calibration import FanModel, SheetModel
from uwlts.model.parameter_keys import StageParameter, StepHeight, TargetParameter, WindowParameter, parse_parameter
from uwlts.model.placement import camera_from_object, laser_pose
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import sheet_surface

BOW = 0.001
BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False)
AIR, IN_WATER = np.arange(10) * 28.0 - 200.0, np.arange(10) * 20.0 - 120.0
TILTS = np.array([(0, 0), (0.35, 0), (-0.35, 0), (0, 0.35), (0, -0.35), (0.25, 0.25), (-0.25, 0.25), (0.3, -0.2)])


@pytest.fixture(scope="module")
def noise():
    return Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))


def truth():
    window, camera = BUILT.camera.window, BUILT.camera
    normal = window.normal()
    return {
        "f": camera.focal_length_px(),
        "cx": camera.principal_point()[0],
        "cy": camera.principal_point()[1],
        "k1": camera.distortion.k1,
        "k2": camera.distortion.k2,
        "window_distance": window.distance_mm,
        "window_slope_x": normal[0] / normal[2],
        "window_slope_y": normal[1] / normal[2],
        "index of water": WATER,
        "sheet_bow": BOW,
        "laser_window_turn": np.radians(BUILT.laser.window.tilt_y_deg) - BOW,
        "target_bow": 0.0,
    }


def std_by_text(result):
    return {key.text: std for key, std in result.estimate.std().items()}


def pulls(result):
    """Return the errors of the parameters divided by their stated uncertainties."""
    estimate, std = result.estimate, std_by_text(result)
    values = {key.text: value for key, value in zip(estimate.parameters.keys, estimate.values, strict=True)}
    return {name: (values[name] - true) / std[name] for name, true in truth().items() if name in values}


@pytest.mark.parametrize("medium_index", [1.0, WATER])
@pytest.mark.parametrize(("tilt_deg", "bow"), [(0.15, BOW), (1.0, 0.003), (1.0, -0.003), (-1.0, 0.003)])
def test_the_sheet_is_where_fermat_sees_the_fan(medium_index, tilt_deg, bow):
    """Bow and turned window, to the ends of the fan at 22.5 deg.

    The glass shifts the sheet by t d (1 - 1 / g) = 35 um for a degree between beam and normal. At the ends of the fan,
    the shift is a tenth larger.
    """
    turn = np.radians(tilt_deg)
    window = BUILT.laser.window.model_copy(update={"tilt_y_deg": tilt_deg})
    sensor = BUILT.model_copy(update={"laser": BUILT.laser.model_copy(update={"window": window})})
    pose = laser_pose(sensor)
    normal = np.cos(bow) * pose.normal - np.sin(bow) * pose.axis
    outer = pose.origin_mm + (window.distance_mm + window.thickness_mm) * pose.axis
    fan = FanModel(
        apex_mm=tuple(pose.origin_mm),
        axis=tuple(pose.axis),
        pivot_mm=tuple(outer),
        bow_rad=bow,
        window_turn_rad=turn - bow,
    )
    sheet = SheetModel(normal=tuple(normal), offset_mm=float(normal @ pose.origin_mm), fan=fan)
    lit = np.vstack(
        [
            lit_points(sensor, normal=pose.axis, point=pose.origin_mm + reach * pose.axis, index=medium_index, bow=bow)
            for reach in (300.0, 450.0, 600.0)
        ]
    )
    miss = sheet_surface(sheet, medium_index=medium_index).miss_mm(lit.T)
    plane = sheet_surface(sheet.model_copy(update={"fan": None}), medium_index=medium_index).miss_mm(lit.T)
    assert np.ptp(miss) < 0.005 * abs(tilt_deg) + 5e-4
    assert abs(miss).max() < 0.040 * (abs(tilt_deg) + np.degrees(abs(bow)))
    assert np.ptp(plane) > 0.03


def at_truth(view):
    """Parameters and a vector at what the views were made with, and the start for the series of a view."""
    nominal = nominal_calibration(BUILT)
    series = target_series(BUILT, medium=view.medium, window=view.window, positions=IN_WATER[:4], columns=9)
    window = nominal.window
    start = estimate_series_start([series], BUILT, window, [WATER], options=OPTIONS)
    known = {key.text: value for key, value in window_values(window).items()} | {
        "index of water": WATER,
        "sheet_turn_fan": 0.001,
        "sheet_turn_axis": -0.002,
        "sheet_offset": 0.05,
        "sheet_bow": 0.002,
        "laser_window_turn": 0.003,
        "stage_scale": 1e-4,
        "target_bow": 0.02,
        "target_saddle": -0.015,
        "target_twist": 0.01,
        "target_stretch_x": 2e-4,
        "target_stretch_y": -1e-4,
        "target_stripe": 0.04,
        "height of the 23 mm step": 23.0,
    }
    priors = {parse_parameter(text): Prior(value, 1.0) for text, value in known.items()}
    parameters = Parameters(start.intrinsics, DescribedSheet.from_sensor(BUILT), window, ("water",), priors)
    return parameters, parameters.start(start.intrinsics.from_model(nominal.camera)), start


@pytest.mark.parametrize("view", [ViewMedium(False, None), ViewMedium(True, None), ViewMedium(True, 0)], ids=str)
@pytest.mark.parametrize("kind", [TargetEvidence, StepProfileEvidence])
def test_every_derivative_is_what_differences_say(view, kind):
    """Compare with differences of the residuals' numerators: a residual is scaled by a derivative assumed constant.

    For a residual r, the change of its scale adds r times a relative change. The pixels are therefore moved to
    positions with zero residuals. Central differences are then exact to the square of the step, and to rounding divided
    by it.
    """
    parameters, global_values, start = at_truth(view)
    rng = np.random.default_rng(0)
    if kind is TargetEvidence:
        evidence, local = start.evidence[0], start.local[0].copy()
        local[6:] = rng.normal(0, 1e-3, len(local) - 6)
        evidence = evidence.with_stripes(slice(None, None, 40))
    else:
        frame = camera_from_object(BUILT)
        pixels = np.column_stack([np.linspace(200, 1000, 30), np.linspace(450, 550, 30)])
        evidence = StepProfileEvidence(
            view=view,
            pixels=pixels,
            upper=np.arange(30) % 2 == 0,
            upward=-frame[:3, 2],
            along=frame[:3, 1],
            across=1,
            height=StepHeight(23.0),
            lengthened=1.02,
            image=0,
        )
        local = np.array([0.02, -390.0])
    for _ in range(8):
        evidence = _without_residuals(evidence, evidence.residuals(parameters, global_values, local))
    found = evidence.residuals(parameters, global_values, local)
    assert sum(len(part.values) for part in found) >= 30
    assert max(np.abs(part.values).max() for part in found) < 1e-8
    assert_derivatives(evidence, parameters, global_values, local, within=1e-5)
    # Prior residuals are linear, and zero for other parameters.
    known = evidence.known_before(local, BUILT.uncertainty)
    assert len(known.residuals) == (len(local) - 6 if kind is TargetEvidence else 0)
    assert known.by_local @ local == pytest.approx(known.residuals[:, 0], rel=1e-12)


def _without_residuals(evidence, parts):
    if isinstance(evidence, StepProfileEvidence):
        return replace(evidence, pixels=evidence.pixels - np.outer(parts[0].values, (0, 1)))
    pixels, stripe = evidence.placement.pixels.copy(), evidence.pixels.copy()
    for part in parts:
        if part.kind == TARGET:
            pixels[evidence.placement.image == part.image] -= part.values.reshape(-1, 2)
        else:
            stripe[evidence.image == part.image, 1] -= part.values
    return replace(evidence, placement=replace(evidence.placement, pixels=pixels), pixels=stripe)


@pytest.fixture(scope="module")
def in_water(noise):
    return target_series(BUILT, medium=0, positions=IN_WATER, bow=BOW, noise=noise)


@pytest.fixture(scope="module")
def in_air(noise):
    return target_series(BUILT, window=False, positions=AIR, bow=BOW, noise=noise)


def test_target_images_in_water_alone_give_everything(in_water, thesis):
    result = solve_jointly(gathered(thesis, [in_water]), options=OPTIONS)
    found, std = pulls(result), std_by_text(result)
    assert max(map(abs, found.values())) < 4.5
    assert std["window_distance"] < 1.0
    assert std["f"] < 0.0005 * truth()["f"]
    assert result.estimate.noise["target"].sigma_px == pytest.approx(0.03, rel=0.1)
    assert result.estimate.noise["stripe on the target"].sigma_px == pytest.approx(0.1, rel=0.15)
    calibration = result.calibration
    assert calibration.media[0].index == pytest.approx(WATER, abs=5e-4)
    assert calibration.medium_index(calibration.media[0].medium) == calibration.media[0].index
    turns = np.degrees([std["sheet_turn_fan"], std["sheet_turn_axis"]])
    normal = calibration.std().sheet_normal_deg
    assert normal is not None and max(turns) <= normal <= np.hypot(*turns)


def test_air_and_water_together_are_better_than_either(in_air, in_water, thesis):
    alone = std_by_text(solve_jointly(gathered(thesis, [in_water]), options=OPTIONS))
    result = solve_jointly(gathered(thesis, [in_air, in_water]), options=OPTIONS)
    assert max(map(abs, pulls(result).values())) < 4.5
    std = std_by_text(result)
    assert std["f"] < 0.7 * alone["f"]
    assert std["window_distance"] < 0.2 * alone["window_distance"]
    assert std["laser_window_turn"] < 0.1 * alone["laser_window_turn"]


def test_a_target_held_by_hand_in_water(noise, thesis):
    series = target_series(
        BUILT, medium=0, positions=np.linspace(-60, 60, len(TILTS)), bow=BOW, noise=noise, tilts=TILTS
    )
    result = solve_jointly(gathered(thesis, [series]), options=replace(OPTIONS, poses="free"))
    assert max(map(abs, pulls(result).values())) < 4.5
    assert StageParameter.SCALE not in result.estimate.parameters.keys


def test_free_poses_are_refused_where_the_stage_moves_as_in_a_mirror(noise, thesis):
    """The stage moves along the laser's axis, which is inclined in the camera; described as that in a mirror."""
    series = target_series(BUILT, window=False, positions=np.linspace(-60, 60, 8), noise=noise, tilts=TILTS, columns=9)
    rotation, free = camera_from_object(thesis)[:3, :3], replace(OPTIONS, poses="free")
    mirrored = rotation.T @ ([1.0, -1.0, 1.0] * rotation[:, 2])
    solve_jointly(gathered(thesis, [replace(series, directions=[(0.0, 0.0, 1.0)])]), options=free)
    with pytest.raises(CalibrationError, match="turned by 180 deg or mirrored top to bottom: correct the images"):
        solve_jointly(gathered(thesis, [replace(series, directions=[tuple(mirrored)])]), options=free)


def test_steps_add_the_window_to_a_target_in_air(thesis):
    """The laser's window is square to the sheet here, as the step views need it."""
    sensor = square_sensor()
    noise = Noise(circles_px=0.03, stripe_px=0.1, rng=np.random.default_rng(2))
    air = target_series(sensor, window=False, positions=AIR, noise=noise)
    result = solve_jointly(gathered(thesis, [air], step_views(sensor, noise=noise)), options=OPTIONS)
    found = pulls(result)
    assert max(abs(found[name]) for name in ("f", "cx", "cy", "k1", "k2", "window_distance", "window_slope_x")) < 4.5
    assert result.estimate.std()[WindowParameter.DISTANCE] < 0.5 * thesis.uncertainty.window_distance_mm
    height = next(key for key in result.estimate.parameters.keys if isinstance(key, StepHeight))
    place = result.estimate.parameters.keys.index(height)
    assert abs(result.estimate.values[place] - 23.17) < 4.5 * result.estimate.std()[height]


def test_outliers_do_not_count(in_water, thesis):
    clean = solve_jointly(gathered(thesis, [in_water]), options=OPTIONS)
    rng = np.random.default_rng(1)

    def spoilt(_, image):
        return replace(image, pixels=image.pixels + 3.0 * (rng.random((len(image.pixels), 1)) < 0.02))

    result = solve_jointly(gathered(thesis, [edited(in_water, spoilt)]), options=OPTIONS)
    moved = np.abs(result.estimate.values - clean.estimate.values) / np.sqrt(np.diag(clean.estimate.covariance))
    assert result.estimate.outliers >= 50
    assert moved.max() < 1.0


def test_images_that_no_camera_explains_are_refused_and_the_worst_named(thesis):
    """Points in waves of 4 px, in one image of 6; a thousandth of the focal length, 2.4 px, is allowed."""
    air = target_series(BUILT, window=False, positions=AIR[::2], columns=13)

    def waved(number, image):
        off = (6.0 if number == 3 else 4.0) * np.sin(image.pixels[:, ::-1] / 30.0)
        return replace(image, pixels=image.pixels + off)

    with pytest.raises(CalibrationError, match="no camera fits the target images in air: .* in target, frame 3: "):
        solve_jointly(gathered(thesis, [edited(air, waved)]), options=OPTIONS)


def test_a_target_without_stripes_is_refused(in_water, thesis):
    found = replace(in_water.found, stripes=[np.empty((0, 2))] * len(in_water.found.images))
    with pytest.raises(CalibrationError, match="no stripe was found on the target"):
        solve_jointly(gathered(thesis, [replace(in_water, found=found)]), options=OPTIONS)


def test_a_target_of_another_form_is_noticed_and_taken_for_uncertain(thesis):
    """A saddle of 0.1 mm, stated 0.02 mm: in the images, and in both halves of them."""
    real = drawn_reality(thesis, np.random.default_rng(3), errors=ModelErrors(saddle_mm=0.05))
    calibration = solve_jointly(evidence(real, thesis, wet=True), options=OPTIONS).calibration
    (warning,) = (each for each in calibration.origin().warnings if TargetParameter.SADDLE.quantity.words in each)
    assert "its uncertainty was enlarged" in warning
    place = list(calibration.joint.parameters).index(TargetParameter.SADDLE)
    assert abs(calibration.joint.values[place] - real.target_saddle_mm) < 4 * calibration.joint.std[place]


@pytest.mark.slow
def test_a_target_of_quite_another_form_is_refused_until_it_is_stated(thesis):
    """A saddle of 0.4 mm, twenty times what is stated, that is in both halves of the images."""
    real = drawn_reality(thesis, np.random.default_rng(3), errors=ModelErrors(saddle_mm=0.2))
    seen = evidence(real, thesis, wet=True)
    with pytest.raises(CalibrationError, match="saddle of the target found .* times what is stated: state it if this"):
        solve_jointly(seen, options=OPTIONS)
    stated = altered(thesis, {"uncertainty": {"target_bow_mm": 0.4}})
    calibration = solve_jointly(replace(seen, sensor=stated), options=OPTIONS).calibration
    place = list(calibration.joint.parameters).index(TargetParameter.SADDLE)
    assert abs(calibration.joint.values[place] - real.target_saddle_mm) < 4 * calibration.joint.std[place]


def test_a_stretch_of_twenty_times_what_is_stated_is_refused_or_not_believed(thesis):
    """Images do not show which of rows and columns is right, and their difference only to 3e-4."""
    real = drawn_reality(thesis, np.random.default_rng(3), errors=ModelErrors(stretch=2e-3))
    words = TargetParameter.STRETCH_X.quantity.words
    try:
        calibration = solve_jointly(evidence(real, thesis, wet=True), options=OPTIONS).calibration
    except CalibrationError as refusal:
        assert words in str(refusal)
        return
    assert any(words in each and "not believed" in each for each in calibration.origin().warnings)
    # The target is as described, with an uncertainty that reaches to its true size.
    place = list(calibration.joint.parameters).index(TargetParameter.STRETCH_X)
    assert abs(calibration.joint.values[place] - real.stretch[0]) < 4 * calibration.joint.std[place]
