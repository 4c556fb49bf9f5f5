"""An earlier calibration as prior knowledge: views by Fermat's principle, captures of drawn stripes."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.system.in_process import uwlts
from tests.uwlts import drawn_stripes
from tests.uwlts.calibration_views import STEP_MM, built_sensor
from tests.uwlts.joint_views import Noise, gathered, lit_points, seen, target_series
from tests.virtual_sensors import with_fine_target
from uwlts.calibration.calibrate import calibrate, solve_jointly
from uwlts.calibration.capture_evidence import StepEvidence
from uwlts.calibration.joint.estimate import estimate
from uwlts.calibration.joint.observability import compute_mesh_lengths, list_regions, read_region_estimate
from uwlts.calibration.joint.parameters import EarlierEstimate, Prior, ViewMedium
from uwlts.calibration.joint.residuals import StepProfileEvidence
from uwlts.calibration.joint.stored_estimate import read_original_estimate, read_stored_estimate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, DescriptionError, RangeError
from uwlts.model.artefacts import StepStandard
from uwlts.model.calibration import calibration_digest
from uwlts.model.parameter_keys import MediumIndex, SheetParameter, StepHeight, TargetParameter, parse_parameter
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.report.certificate import make_certificate
from uwlts.storage.calibration_file import load_calibration
from uwlts.storage.capture import Capture

BUILT = built_sensor()
OPTIONS = CalibrationOptions(poses="stage", correct_circles=False)
WARM = Medium(kind="fresh", temperature_c=25.0)
COLD = Medium(kind="fresh", temperature_c=18.0)
WAVELENGTH = BUILT.laser.wavelength_nm
INDEX = COLD.refractive_index(WAVELENGTH)
POORLY_KNOWN = 1e-3


def noise(seed):
    return Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(seed))


def calibrated(described, sensor=BUILT, *, seed=4, columns=15):
    """By a target in water of 25 degC, whose index the views have to 2e-5."""
    series = target_series(sensor, medium=0, positions=np.arange(8) * 27.0 - 130.0, noise=noise(seed), columns=columns)
    evidence = gathered(described, [series])
    evidence.media["water"] = WARM
    return solve_jointly(evidence, options=OPTIONS).calibration


@pytest.fixture(scope="module")
def earlier(thesis):
    return calibrated(with_fine_target(thesis))


@cache
def tread(depth_mm, *, index, between=None, beyond=None):
    """Pixels on a plane across the sheet at an OCS depth, with |Y| within limits in mm; without noise."""
    frame = camera_from_object(BUILT)
    lit = lit_points(BUILT, normal=frame[:3, 2], point=frame[:3, 3] + depth_mm * frame[:3, 2], index=index, count=600)
    across = np.abs((lit - frame[:3, 3]) @ frame[:3, 1])
    lit = lit[across < between] if between else lit[across > beyond]
    pixels = seen(BUILT, lit, index=index, window=True)
    return pixels[((pixels >= 0) & (pixels <= [BUILT.camera.width_px - 1, BUILT.camera.height_px - 1])).all(axis=1)]


def steps(thesis, *, index=INDEX, depths_mm=(15.0,), medium=WARM, height_mm=STEP_MM, seed=1):
    """Evidence of step captures: a standard of 23.17 mm, certified to 1 um, in water described as warm."""
    found, rng = [], np.random.default_rng(seed)
    standard = StepStandard(height_mm=height_mm, height_uncertainty_mm=0.002)
    for depth in depths_mm:
        pieces = [tread(depth, index=index, beyond=31.0), tread(depth - STEP_MM, index=index, between=28.0)]
        pixels = np.vstack(pieces)
        pixels = pixels[np.argsort(pixels[:, 0])]
        pixels[:, 1] += rng.normal(0, 0.1, len(pixels))
        found.append((StepEvidence(pixels, standard, medium.refractive_index(WAVELENGTH), "step"), ViewMedium(True, 0)))
    evidence = gathered(thesis, [], found)
    evidence.media["water"] = medium
    return evidence


def refreshed(earlier, evidence, **options):
    """Calibrate from images in new water."""
    options = CalibrationOptions(earlier=earlier, same_water=False, **options)
    return solve_jointly(evidence, options=options)


def index_in(calibration, name="water 2"):
    """Return index and standard uncertainty of a medium."""
    place = [key for key in calibration.joint.parameters if isinstance(key, MediumIndex)].index(MediumIndex(name))
    return calibration.media[place].index, calibration.joint.std_of(MediumIndex(name))


def largest_length_std(calibration):
    """Return the largest standard uncertainty of a length in the water of use, mm."""
    region = list_regions(calibration)[0]
    known = read_region_estimate(calibration, region)
    return compute_mesh_lengths(known, region).std_mm(known.covariance).max()


def test_one_step_gives_the_index_of_colder_water(earlier, thesis):
    """Water of 18 degC described as 25 degC: an index error of 6.4e-4. An image of 23 mm known to 1 um gives it to
    4e-4.
    """
    result = refreshed(earlier, steps(thesis), index_std=POORLY_KNOWN)
    calibration = result.calibration
    index, std = index_in(calibration)
    assert calibration.joint.std_before[-2] == POORLY_KNOWN
    assert std < 0.6 * POORLY_KNOWN
    assert abs(index - INDEX) < 3 * std
    assert result.warnings == []
    assert [known.medium for known in calibration.media] == [WARM, WARM]
    assert calibration.medium_index(WARM) == index
    assert calibration.media[0].index == pytest.approx(earlier.media[0].index, abs=1e-4)


def test_water_that_is_described_alike_is_the_same_unless_it_is_new(earlier, thesis):
    """Steps in the water of the target: its index moves within the drift, and no other appears."""
    options = CalibrationOptions(earlier=earlier)
    result = solve_jointly(steps(thesis, index=WARM.refractive_index(WAVELENGTH)), options=options)
    assert [known.medium for known in result.calibration.media] == [WARM]
    index, std = index_in(result.calibration, "water")
    assert abs(index - WARM.refractive_index(WAVELENGTH)) < 3 * std
    with pytest.raises(CalibrationError, match=r"other than before, give `new_water`"):
        solve_jointly(steps(thesis, index=1.3385), options=options)


def test_another_target_is_known_as_described(earlier, thesis):
    """The same target is better known after further images of it."""
    positions, index = np.arange(4) * 40.0 - 80.0, WARM.refractive_index(WAVELENGTH)
    series = target_series(BUILT, medium=0, positions=positions, noise=noise(7), columns=9, index=index)
    evidence = replace(gathered(thesis, [series]), media={"water": WARM})
    other = earlier.model_copy(update={"provenance": earlier.provenance | {"target": {}}})
    same, fresh = (
        solve_jointly(evidence, options=replace(OPTIONS, earlier=each)).calibration.joint.std_of(TargetParameter.BOW)
        for each in (earlier, other)
    )
    assert same < earlier.joint.std_of(TargetParameter.BOW) < 0.9 * fresh


def test_water_whose_steps_are_left_out_is_not_said_to_be_measured(earlier, thesis):
    """Two waters; in one of them the stripe is on the lower tread only."""
    evidence = steps(thesis)
    flat = replace(evidence.steps[0][0], pixels=tread(15.0, index=INDEX, beyond=31.0))
    evidence = replace(
        evidence, media=evidence.media | {"pool": COLD}, steps=[*evidence.steps, (flat, ViewMedium(True, 1))]
    )
    result = refreshed(earlier, evidence, index_std=POORLY_KNOWN)
    assert index_in(result.calibration, "pool")[1] == pytest.approx(POORLY_KNOWN)
    assert index_in(result.calibration)[1] < 0.6 * POORLY_KNOWN
    assert "step: left out" in result.warnings[0]


def test_a_prior_with_correlations_counts_as_its_covariance():
    """Residuals, their derivatives by differences, and the chi-square; from degrees of 1e-8 to 1e3."""
    rng = np.random.default_rng(0)
    scale = 10.0 ** np.arange(-8, 4, 3)
    root = scale[:, None] * rng.normal(size=(4, 4))
    values = scale * rng.normal(size=4)
    earlier = EarlierEstimate(values, root @ root.T)
    global_values = np.append(values + scale * rng.normal(size=4), (7.0, 8.0))
    off, by_global = earlier.residuals(global_values)
    assert by_global.shape == (4, 6)
    expected = np.linalg.solve(root, global_values[:4] - values)
    assert off @ off == pytest.approx(expected @ expected, rel=1e-8)
    for place in range(6):
        reach = scale[place] if place < 4 else 1.0
        ahead, behind = (global_values + sign * reach * np.eye(6)[place] for sign in (1, -1))
        numeric = (earlier.residuals(ahead)[0] - earlier.residuals(behind)[0]) / (2 * reach)
        # Linear, so that differences are exact but for rounding.
        assert by_global[:, place] == pytest.approx(numeric, rel=1e-8, abs=1e-8 * np.abs(off).max() / reach)


@pytest.mark.parametrize("covariance", [np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_a_covariance_that_is_none_is_refused(covariance):
    with pytest.raises(CalibrationError, match="covariance of the earlier calibration is damaged"):
        EarlierEstimate(np.zeros(2), covariance)


def test_evidence_without_information_leaves_everything_as_it_was(earlier, thesis):
    """Two pixels determine a line, and a third an unknown height."""
    known = read_original_estimate(earlier, WARM)
    frame = camera_from_object(BUILT)
    priors = known.parameters.priors | {StepHeight(20.0): Prior(20.0, 1e4)}
    parameters = replace(known.parameters, priors=priors, earlier=EarlierEstimate(known.values, known.covariance))
    evidence = StepProfileEvidence(
        view=ViewMedium(True, 0),
        pixels=np.array([[300.0, 505.0], [900.0, 505.0], [600.0, 480.0]]),
        upper=np.array([False, False, True]),
        upward=-frame[:3, 2],
        along=frame[:3, 1],
        across=1,
        height=StepHeight(20.0),
        image=0,
    )
    count = len(known.values)
    result = estimate(
        parameters, [evidence], np.append(known.values, 20.0), [np.array([0.0, -330.0])], uncertainty=thesis.uncertainty
    )
    std = np.sqrt(np.diag(known.covariance))
    assert np.abs((result.values[:count] - known.values) / std).max() < 1e-5
    off = (result.covariance[:count, :count] - known.covariance) / np.outer(std, std)
    assert np.abs(off).max() < 1e-5
    assert abs(result.values[-1] - 20.0) > 0.1


def test_what_was_held_is_as_the_calibration_says(earlier):
    """A bow of 1 deg and a window turned by 2 deg, known exactly: points as another calculation has them."""
    joint, sheet = earlier.joint, earlier.sheet
    held = {SheetParameter.BOW, SheetParameter.WINDOW_TURN}
    kept = [place for place, key in enumerate(joint.parameters) if key not in held]
    assert len(joint.parameters) - len(kept) == 2
    fewer = {name: tuple(getattr(joint, name)[place] for place in kept) for name in ("parameters", "values", "std")}
    covariance = tuple(map(tuple, joint.covariance_matrix()[np.ix_(kept, kept)].tolist()))
    turned = sheet.fan.model_copy(update={"bow_rad": np.radians(1.0), "window_turn_rad": np.radians(2.0)})
    calibration = earlier.model_copy(
        update={
            "joint": joint.model_copy(update=fewer | {"covariance": covariance}),
            "sheet": sheet.model_copy(update={"fan": turned}),
        }
    )
    known, pixels = (
        read_original_estimate(calibration, WARM),
        np.array([[150.0, 480.0], [640.0, 520.0], [1100.0, 450.0]]),
    )
    found = known.parameters.stripe_points(known.values, known.view, pixels, across=0).points
    index, along = calibration.medium_index(WARM), np.eye(3)[0]
    frame = calibration.object_transform()

    def expected(by):
        return reconstruct_pixels(by, pixels, medium_index=index, stage_mm=0.0, stage_direction=along).points_mm

    assert frame[:3, :3].T @ (found - frame[:3, 3:]) == pytest.approx(expected(calibration).T, abs=1e-6)
    # The effect is a tenth of a millimetre.
    assert np.abs(expected(calibration) - expected(earlier)).max() > 0.1


def test_correlations_of_the_earlier_estimate_count(earlier, thesis):
    """With variances only, a step would change other parameters, and lengths would be less certain."""
    covariance = tuple(map(tuple, np.diag(np.diag(earlier.joint.covariance)).tolist()))
    loose = earlier.model_copy(update={"joint": earlier.joint.model_copy(update={"covariance": covariance})})
    full, alone = (
        largest_length_std(refreshed(each, steps(thesis), index_std=POORLY_KNOWN).calibration)
        for each in (earlier, loose)
    )
    assert alone > 1.5 * full


def test_the_file_holds_old_and_new_water(earlier, thesis, tmp_path):
    result = refreshed(earlier, steps(thesis), index_std=POORLY_KNOWN)
    path = tmp_path / "new.json"
    result.calibration.save(path)
    calibration = load_calibration(path)
    joint, before = calibration.joint, earlier.joint
    count = len(before.parameters)
    assert joint.parameters[:count] == before.parameters
    assert joint.parameters[count:] == (MediumIndex("water 2"), StepHeight(23.17))
    assert joint.std_before[:count] == before.std_before
    assert joint.std_before[count:] == pytest.approx((POORLY_KNOWN, 0.001))
    assert (np.array(joint.std[:count]) <= np.array(before.std) * (1 + 1e-6)).all()
    assert set(joint.scatter_px) == {*before.scatter_px, "stripe on the step"}
    assert len(joint.images) == len(before.images) + 1
    assert calibration.provenance["earlier"]["digest"] == calibration_digest(earlier)
    # The new water is that of use, over the same volume, and its index is the new one.
    region = list_regions(calibration)[0]
    assert region.name == "water 2"
    assert region.has_area()
    known = read_region_estimate(calibration, region)
    assert known.parameters.medium_index(known.values, known.view) == calibration.media[1].index
    assert read_stored_estimate(calibration, thesis, WARM).view == ViewMedium(True, 1)
    assert make_certificate(calibration, path, issued="2026-01-01").validity[0].name == "water 2"
    again = refreshed(calibration, steps(thesis, seed=2), index_std=POORLY_KNOWN)
    assert index_in(again.calibration, "water 3")[1] < 0.6 * POORLY_KNOWN


@pytest.mark.parametrize("wrong", [{"height_mm": 23.4}, {"index": 1.3385}])
def test_a_step_that_contradicts_its_description_is_refused(earlier, thesis, wrong):
    """A certificate of another step, or sea water said to be fresh."""
    with pytest.raises(CalibrationError, match=r"index of water 2 found 1\.3\d+, described as 1\.33122 ") as caught:
        refreshed(earlier, steps(thesis, **wrong))
    assert "check the medium and the step's height in the captures, or `index`" in str(caught.value)


def moved_since(calibration, name, by):
    """Return a calibration of the sensor before a parameter changed."""
    joint = calibration.joint
    values = list(joint.values)
    values[joint.parameters.index(parse_parameter(name))] += by
    return calibration.model_copy(update={"joint": joint.model_copy(update={"values": tuple(values)})})


def test_a_sensor_that_has_changed_is_noticed(earlier, thesis):
    """Steps at three depths, in unknown water: no index explains a shifted sheet or new focus."""
    evidence = steps(thesis, depths_mm=(-45.0, 15.0, 85.0))
    with pytest.raises(CalibrationError, match=r"contradicts itself: height of the 23.17 mm step found 23\.[2-4]"):
        refreshed(moved_since(earlier, "sheet_offset", 0.45), evidence, index_std=0.02)
    # Five standard uncertainties, with a scatter of one: a warning up to six, then a contradiction.
    try:
        said = refreshed(moved_since(earlier, "f", 9.0), evidence, index_std=0.02).warnings
    except CalibrationError as error:
        said = [str(error)]
    assert any(re.search(r"the new images contradict the earlier calibration by [4-6]\.", words) for words in said)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """A calibration of the coarse sensor in water of 25 degC, and steps drawn in water of index 1.3312."""
    folder = tmp_path_factory.mktemp("earlier")
    square = drawn_stripes.SENSOR.laser.window.model_copy(update={"tilt_y_deg": 0.0})
    sensor = drawn_stripes.SENSOR.model_copy(
        update={"laser": drawn_stripes.SENSOR.laser.model_copy(update={"window": square})}
    )
    calibrated(sensor, sensor).save(folder / "calibration.json")
    return folder, sensor


def step_capture(folder, described_by, name="step.h5", **header):
    images = [drawn_stripes.step_image(15.0)]
    described = {
        "sensor": described_by,
        "artefact": {"kind": "step", "height_mm": STEP_MM, "height_uncertainty_mm": 0.002},
        "medium_name": "water",
        "medium": WARM,
    }
    return drawn_stripes.write(folder / name, images, **(described | header))


def test_the_command_adds_new_water(drawn):
    folder, sensor = drawn
    capture, new = step_capture(folder, sensor), folder / "today.json"
    told = ("calibrate", "--calibration", folder / "calibration.json", "--step", capture, "--new-water")
    done = uwlts(*told, "--index-std", 0.001, "--out", new)
    assert done.returncode == 0, done.stderr
    found = load_calibration(new)
    index, std = index_in(found)
    assert f"index of water 2: {index:.6g} ± {std:.2g} (0.001)" in done.stdout
    assert abs(index - 1.3312) < 3 * std
    assert std < 9e-4
    origin = json.loads(new.read_text(encoding="utf-8"))["provenance"]
    assert origin["step_captures"][0]["sha256"]
    assert origin["earlier"]["digest"] == calibration_digest(load_calibration(folder / "calibration.json"))
    twice = uwlts("calibrate", "--calibration", new, "--step", capture, "--out", folder / "twice.json")
    assert twice.returncode == 2
    assert "step.h5 was already used for this calibration: take a new image" in twice.stderr


def renamed(sensor, **changes):
    return sensor.model_copy(update=changes)


@pytest.mark.parametrize(
    ("header", "error", "said"),
    [
        (lambda s: {"artefact": None}, DescriptionError, "does not describe its step standard"),
        (
            lambda s: {"sensor": renamed(s, name="other")},
            CalibrationError,
            r"step.h5 is of the sensor 'other', .*right one",
        ),
        (
            lambda s: {"sensor": renamed(s, laser=renamed(s.laser, wavelength_nm=s.laser.wavelength_nm + 3.0))},
            CalibrationError,
            "with a laser of 638 nm; the calibration is for 635 nm",
        ),
        (
            lambda s: {"sensor": renamed(s, laser=renamed(s.laser, wavelength_nm=520.0))},
            CalibrationError,
            "with a laser of 520 nm",
        ),
        (
            lambda s: {"sensor": renamed(s, camera=renamed(s.camera, window=renamed(s.camera.window, mounted=False)))},
            CalibrationError,
            "without the camera's window",
        ),
        (lambda s: {"artefact": {"kind": "step", "height_mm": 8.0}}, CalibrationError, "left out, no two"),
    ],
)
def test_an_unsuitable_capture_is_refused(drawn, tmp_path, header, error, said):
    folder, sensor = drawn
    calibration = load_calibration(folder / "calibration.json")
    path = step_capture(tmp_path, sensor, **header(sensor))
    with Capture(path) as capture, pytest.raises(error, match=said):
        calibrate(calibration=calibration, step=[capture])


def test_a_capture_given_twice_is_refused(drawn, tmp_path):
    """Its noise would count as two independent ones."""
    folder, sensor = drawn
    path = step_capture(tmp_path, sensor)
    copy = tmp_path / "copy.h5"
    copy.write_bytes(path.read_bytes())
    known, said = load_calibration(folder / "calibration.json"), r"step\.h5 and copy\.h5 are the same capture"
    with Capture(path) as one, Capture(copy) as other, pytest.raises(CalibrationError, match=said):
        calibrate(calibration=known, step=[one, other])


def test_an_unsuitable_calibration_is_refused(drawn, earlier):
    folder, sensor = drawn
    with pytest.raises(DescriptionError, match="no captures of a target"):
        calibrate(calibration=earlier)
    with pytest.raises(DescriptionError, match="leave out `distortion`"):
        calibrate(calibration=earlier, step=["step.h5"], distortion=("k1",))
    with Capture(step_capture(folder, sensor, "again.h5")) as capture:
        with pytest.raises(CalibrationError, match="calibrate jointly"):
            calibrate(calibration=nominal_calibration(sensor), step=[capture])
        with pytest.raises(CalibrationError, match="the calibration is for air only"):
            calibrate(
                calibration=load_calibration(folder / "calibration.json").model_copy(update={"window": None}),
                step=[capture],
            )
        with pytest.raises(RangeError, match="be positive"):
            calibrate(calibration=load_calibration(folder / "calibration.json"), step=[capture], index_std=0.0)
