"""Scans of spheres, planes and pipes as evidence: derivatives, and information from form and size."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse

from tests.uwlts.calibration_views import WATER, square_sensor
from tests.uwlts.joint_views import Noise, assert_derivatives, gathered, target_series
from tests.uwlts.scan_views import NONE, SLOPE, VIEW, Body, scan_of, stage_direction
from tests.virtual_sensors import with_fine_target
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.camera.camera_parameters import CameraOptions, Intrinsics
from uwlts.calibration.joint import policy
from uwlts.calibration.joint.estimate import estimate
from uwlts.calibration.joint.gathering import scan_stripes
from uwlts.calibration.joint.initial import build_all_scan_evidence, build_scan_evidence
from uwlts.calibration.joint.parameters import DescribedSheet, Parameters, Prior, window_values
from uwlts.calibration.joint.residuals import STEP, Residuals
from uwlts.calibration.joint.scanned_surfaces import SLOPES, ScannedPipe, ScannedPlane, ScannedSpheres
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, CaptureError, DescriptionError
from uwlts.fitting.schur_least_squares import LocalPrior
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard
from uwlts.model.parameter_keys import parse_parameter
from uwlts.model.placement import camera_from_object
from uwlts.model.sensor import Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.triangulation import reconstruct_profile
from uwlts.storage.capture import Capture, CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter

SENSOR = square_sensor()
STAGE = np.linspace(-18.0, 18.0, 13)
SPHERES = (Body((0.0, -50.0, 45.0), 25.0), Body((0.5, 49.0, 44.0), 26.0))
SPACING = float(np.linalg.norm(np.subtract(SPHERES[0].point, SPHERES[1].point)))
STANDARD = SphereStandard(diameters_mm=(50.0, 52.0), spacings_mm=(SPACING,))
ALONG, ACROSS = Body((0.0, 2.0, 130.0), 110.0, (1.0, 0.02, -0.01)), Body((0.0, 0.0, 60.0), 30.0, (0.03, 1.0, 0.01))
LEANING = Body((0.0, 0.0, 20.0), None, (0.6, 0.1, 1.0))
KINDS = {
    "spheres": (SPHERES, STANDARD),
    "plane": ((LEANING,), PlaneStandard()),
    "pipe along": ((ALONG,), PipeStandard(diameter_mm=220.0)),
    "pipe across": ((ACROSS,), PipeStandard(diameter_mm=60.0)),
}

SLOPE_NAMES = [key.text for key in SLOPES]
SIZE_FOUND = re.compile(r"found ([\d.]+), described as .* \(([-+.\d]+) mm or ([\d.]+) standard uncertainties off\)")


def parameters(**std):
    """Return parameters as built and known, except those with a standard uncertainty in ``std``."""
    nominal = nominal_calibration(SENSOR)
    known = {key.text: value for key, value in window_values(nominal.window).items()} | {"index of water": WATER}
    known |= dict.fromkeys(("sheet_turn_fan", "sheet_turn_axis", "sheet_offset", "stage_scale", *SLOPE_NAMES), 0.0)
    priors = {
        parse_parameter(text): Prior(value, std.get(text.replace(" ", "_"), 1e-9)) for text, value in known.items()
    }
    camera = SENSOR.camera
    intrinsics = Intrinsics(CameraOptions(), width_px=camera.width_px, height_px=camera.height_px)
    found = Parameters(intrinsics, DescribedSheet.from_sensor(SENSOR), nominal.window, ("water",), priors)
    return found, found.start(intrinsics.from_model(nominal.camera))


def evidence_of(kind, *, stage_mm=STAGE, sizes_known=True, artefact=None, noise=NONE):
    """Evidence as `build_scan_evidence` makes it by the sensor as built and the stage as described, and its start."""
    bodies, described = KINDS[kind]
    stripes, _ = scan_of(SENSOR, bodies, artefact or described, stage_mm=stage_mm, count=700, noise=noise)
    nominal = nominal_calibration(SENSOR)
    return build_scan_evidence(stripes, nominal, SENSOR, medium_index=WATER, sizes_known=sizes_known, image=0)


def true_own(kind, evidence):
    """The surface's local parameters and the positions' errors as the scan was made."""
    frame, surface = camera_from_object(SENSOR), evidence.surface
    points = np.array([body.point for body in KINDS[kind][0]]) @ frame[:3, :3].T + frame[:3, 3]
    body = KINDS[kind][0][0]
    match surface:
        case ScannedSpheres():
            local = np.append(points.ravel(), np.zeros(surface.count))
        case ScannedPlane():
            normal = frame[:3, :3] @ body.axis
            normal /= surface.normal @ normal
            distance = normal @ (points[0] - surface.point_mm) / np.linalg.norm(normal)
            local = np.append(surface.across @ normal, distance)
        case ScannedPipe():
            axis = frame[:3, :3] @ body.axis
            axis /= surface.axis @ axis
            away = points[0] - surface.point_mm
            local = np.concatenate(
                [surface.across @ (away - axis * (surface.axis @ away)), surface.across @ axis, [0.0]]
            )
    return np.append(local, np.zeros(len(evidence.stage_mm)))


@pytest.mark.parametrize("kind", KINDS)
def test_scans_by_fermat_lie_on_the_surface_and_every_derivative_is_what_differences_say(kind):
    """If residuals vanish, the scale of a residual does not matter; see the other evidence's test.

    Crossings by Fermat are exact to 1e-9 mm, a hundred-millionth of a pixel's 0.2 mm.
    """
    model, global_values = parameters()
    evidence, _ = evidence_of(kind, stage_mm=STAGE[::4])
    local = true_own(kind, evidence)
    for key, slope in zip(SLOPES, SLOPE, strict=True):
        global_values[model.keys.index(key)] = slope
    found = evidence.residuals(model, global_values, local)
    assert sum(len(part.values) for part in found) == len(evidence.pixels) > 300
    assert max(np.abs(part.values).max() for part in found) < 1e-6
    assert_derivatives(evidence, model, global_values, local, within=1e-4)


def test_light_from_beside_the_sheet_comes_from_a_surface_beside_it():
    """Points moved by a vector are on the plane that is moved by the same vector, not by the opposite one."""
    model, global_values = parameters()
    evidence, _ = evidence_of("plane", stage_mm=STAGE[::4])
    local = true_own("plane", evidence)
    for key, slope in zip(SLOPES, SLOPE, strict=True):
        global_values[model.keys.index(key)] = slope
    beside = np.array([0.02, -0.01, 0.05])
    plane = evidence.surface
    normal = plane.normal + plane.across.T @ local[:2]
    local[2] += normal @ beside / np.linalg.norm(normal)
    moved = replace(evidence, beside_mm=np.tile(beside[:, None], (1, len(evidence.pixels))))
    found = moved.residuals(model, global_values, local)
    assert max(np.abs(part.values).max() for part in found) < 1e-6


def test_known_sizes_are_off_by_their_standard_uncertainties():
    """Diameters of unknown uncertainty do not count, nor does anything of the same spheres of unknown size."""
    evidence, _ = evidence_of("spheres", artefact=STANDARD.model_copy(update={"spacing_uncertainty_mm": 0.02}))
    surface = evidence.surface
    local = true_own("spheres", evidence)[: surface.parameter_count]
    assert surface.sizes(local).residuals()[0] == pytest.approx([0.0], abs=1e-9)
    local[3:6] += 0.03 * (local[3:6] - local[:3]) / SPACING
    local[7] += 0.5
    assert surface.sizes(local).off_mm == pytest.approx([0.0, 0.5, 0.03], abs=1e-9)
    off, by_local = surface.sizes(local).residuals()
    assert off == pytest.approx([3.0])
    for place, column in enumerate(by_local.T):
        moved = local.copy()
        moved[place] += 1e-4
        assert surface.sizes(moved).residuals()[0] - off == pytest.approx(column * 1e-4, abs=1e-6)
    assert len(surface.free_sizes().sizes(local).residuals()[0]) == 0


class _Held:
    """Return evidence that fixes the lens, so that a scan can be evaluated alone."""

    def __init__(self, lens):
        self._lens = lens

    def known_before(self, local, uncertainty):
        return LocalPrior(np.empty((0, 1)), sparse.csr_array((0, 0)))

    def residuals(self, parameters, global_values, local):
        count = len(self._lens)
        by_global = np.zeros((count, len(global_values)))
        scale = 1e-6 * np.maximum(1e-3, np.abs(self._lens))
        by_global[:, :count] = np.diag(1.0 / scale)
        return [
            Residuals(
                STEP, (global_values[:count] - self._lens) / scale, by_global, np.empty((count, 0)), np.arange(0), 0
            )
        ]

    def linearise(self, residuals, used):
        return self


def asked(found, **std):
    """Return errors and stated uncertainties of the parameters with a standard uncertainty, from scans only."""
    model, global_values = parameters(**std)
    lens = len(model.intrinsics.names)
    evidence, local = zip(*found, strict=True)
    result = estimate(
        model,
        [*evidence, _Held(global_values[:lens].copy())],
        global_values,
        [*local, np.empty(0)],
        uncertainty=SENSOR.uncertainty,
    )
    true = dict(zip(model.keys, global_values, strict=True)) | dict(zip(SLOPES, SLOPE, strict=True))
    values = dict(zip(model.keys, result.values, strict=True))
    keys = {text: parse_parameter(text) for text in (name.replace("_of_", " of ") for name in std)}
    errors = {text: values[key] - true[key] for text, key in keys.items()}
    return errors, {text: result.std()[key] for text, key in keys.items()}, result


def noise(seed=8):
    return Noise(stripe_px=0.02, rng=np.random.default_rng(seed))


@pytest.mark.parametrize("known", [True, False], ids=["sizes known", "sizes unknown"])
def test_round_spheres_tell_the_stage_and_the_water(known):
    standard = STANDARD.model_copy(update={"diameter_uncertainty_mm": 0.002})
    scan = evidence_of("spheres", artefact=standard, sizes_known=known, noise=noise())
    errors, std, result = asked([scan], **dict.fromkeys(SLOPE_NAMES, 0.01), index_of_water=2e-3)
    for name, error in errors.items():
        assert abs(error) < 4 * std[name], name
        # The stated uncertainty includes errors common to a sphere's points, so it is far above that of 0.02 px noise.
        assert std[name] < 3e-3, name
    assert np.abs(result.local[0][6:8]).max() < (0.01 if known else 0.1)
    assert result.noise[ScannedSpheres.kind].besides > 10


def test_a_known_spacing_is_a_length_in_water():
    """Unknown diameters say nothing of the scale; the spacing does, to 0.005 mm in 62 mm or a ten-thousandth."""
    std = {"index_of_water": 5e-3, "window_distance": 1.0, **dict.fromkeys(SLOPE_NAMES, 0.01)}
    told = {}
    for known in (True, False):
        standard = STANDARD.model_copy(update={"spacing_uncertainty_mm": 0.01})
        scan = evidence_of("spheres", artefact=standard, sizes_known=known, noise=noise())
        errors, told[known], result = asked([scan], **std)
        assert abs(errors["index of water"]) < 4 * told[known]["index of water"]
        apart = np.linalg.norm(np.diff(result.local[0][:6].reshape(2, 3), axis=0)) - SPACING
        assert abs(apart) < (0.02 if known else 0.2)
    assert told[True]["index of water"] < 0.95 * told[False]["index of water"]


@pytest.mark.parametrize("kind", ["pipe along", "pipe across"])
def test_a_pipe_of_known_diameter_gives_the_water(kind):
    told = {}
    for known in (True, False):
        pipe = KINDS[kind][1].model_copy(update={"diameter_uncertainty_mm": 0.01})
        scan = evidence_of(kind, artefact=pipe, sizes_known=known, noise=noise())
        errors, told[known], _ = asked([scan], **dict.fromkeys(SLOPE_NAMES, 0.01), index_of_water=5e-3)
        assert all(abs(errors[name]) < 4 * told[known][name] for name in errors)
    # Along the stage every profile is the known circle, and no motion of the stage along the pipe's axis changes it.
    # Across the pipe the stage measures the width. Then the form determines the water nearly as well, and the pipe is
    # round only for the stage's true direction.
    better = told[True]["index of water"] / told[False]["index of water"]
    towards_z = told[True][SLOPE_NAMES[1]] / 0.01
    assert (better < 0.4 and towards_z > 0.5) if kind == "pipe along" else (better < 0.9 and towards_z < 0.1)


def test_a_plane_gives_the_sheet_but_not_the_stage():
    """Another direction of the stage shears what is measured, and a sheared plane is a plane: the priors stay.

    A sheet that is turned distorts in perspective, which the leaning plane shows, as it crosses all depths.
    """
    scan = evidence_of("plane", stage_mm=np.linspace(-70, 70, 15), noise=noise())
    errors, std, _ = asked([scan], **dict.fromkeys(SLOPE_NAMES, 0.01), sheet_turn_fan=0.05)
    for name in SLOPE_NAMES:
        assert std[name] == pytest.approx(0.01, rel=1e-3)
        assert abs(errors[name] + SLOPE[SLOPE_NAMES.index(name)]) < 1e-3
    assert std["sheet_turn_fan"] < 0.1 * 0.05
    assert abs(errors["sheet_turn_fan"]) < 4 * std["sheet_turn_fan"]


def test_all_kinds_together_with_a_target_in_water(thesis):
    """By the whole procedure, from the sensor as its drawings say; the stage's direction goes into the calibration."""
    drawn = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(5))
    water = target_series(SENSOR, medium=0, positions=np.arange(6) * 30.0 - 100.0, noise=drawn, columns=15)
    certified = {
        "spheres": {"diameter_uncertainty_mm": 0.01, "spacing_uncertainty_mm": 0.01},
        "plane": {},
        "pipe along": {"diameter_uncertainty_mm": 0.02},
    }
    scans = [
        scan_of(
            SENSOR,
            KINDS[kind][0],
            KINDS[kind][1].model_copy(update=known),
            stage_mm=STAGE,
            count=700,
            noise=drawn,
            source=kind,
        )[0]
        for kind, known in certified.items()
    ]
    seen = replace(gathered(thesis, [water]), scans=scans)
    result = solve_jointly(seen, options=CalibrationOptions(poses="stage", correct_circles=False))
    assert result.warnings == []
    found, std = result.estimate, result.estimate.std()
    values = dict(zip(found.parameters.keys, found.values, strict=True))
    camera = SENSOR.camera
    true = {"f": camera.focal_length_px(), "window_distance": camera.window.distance_mm, "index of water": WATER}
    assert max(abs(values[key] - true[key.text]) / std[key] for key in map(parse_parameter, true)) < 4.5
    for kind in (ScannedSpheres.kind, ScannedPlane.kind, ScannedPipe.kind):
        assert found.noise[kind].sigma_px == pytest.approx(0.1, rel=0.1)
    frame = result.calibration.object_transform()
    moved, stage = stage_direction(SENSOR), result.calibration.stages[0]
    assert stage.described == pytest.approx((1.0, 0.0, 0.0))
    back = result.calibration.stage_direction_of((-1.0, 0.0, 0.0))
    assert back == pytest.approx(-np.array(stage.direction))
    assert result.calibration.stage_direction_of((0.0, 1.0, 0.0)) == (0.0, 1.0, 0.0)
    slopes = [std[name] for name in SLOPES]
    assert np.linalg.norm(frame[:3, :3] @ stage.direction - moved) < 4.5 * np.linalg.norm(slopes)
    assert max(slopes) < 0.6 * np.tan(np.radians(thesis.uncertainty.stage_alignment_deg))
    sources = {image.source.split(",")[0] for image in result.calibration.joint.images}
    assert set(certified) < sources


CERTIFIED = {
    "spheres": {"diameter_uncertainty_mm": 0.01, "spacing_uncertainty_mm": 0.01},
    "pipe along": {"diameter_uncertainty_mm": 0.02},
    "pipe across": {"diameter_uncertainty_mm": 0.02},
}


@pytest.fixture(scope="module")
def target_in_water():
    drawn = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(5))
    return target_series(SENSOR, medium=0, positions=np.arange(6) * 30.0 - 100.0, noise=drawn, columns=11)


def scanned(kind, **described):
    """A scan of what it shows, as an artefact that is described otherwise."""
    drawn = Noise(stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(6))
    bodies, artefact = KINDS[kind]
    wrong = artefact.model_copy(update=described)
    return scan_of(SENSOR, bodies, wrong, stage_mm=STAGE, count=700, noise=drawn, source=f"{kind}.h5")[0]


def solved(thesis, target, *scans):
    options = CalibrationOptions(poses="stage", correct_circles=False)
    return solve_jointly(replace(gathered(thesis, [target]), scans=[*scans]), options=options)


@pytest.mark.parametrize(
    ("kind", "wrong", "name", "true_mm"),
    [
        ("spheres", {"diameters_mm": (50.0, 53.0)}, "diameter of sphere 2", 52.0),
        ("spheres", {"spacings_mm": (SPACING + 1.0,)}, "spacing of spheres 1 and 2", SPACING),
        ("pipe along", {"diameter_mm": 221.0}, "diameter of the pipe", 220.0),
        ("pipe across", {"diameter_mm": 61.0}, "diameter of the pipe", 60.0),
    ],
)
def test_a_size_described_a_millimetre_wrong_is_refused_by_its_name(
    thesis, target_in_water, kind, wrong, name, true_mm
):
    """Sizes are certified to 0.02 mm; the scans measure them with standard uncertainties of 0.07 mm at most.

    If the wrong size were accepted, the error of the window's distance would grow by two of its stated uncertainties.
    """
    right = scanned("spheres", **CERTIFIED["spheres"])
    with pytest.raises(CalibrationError, match="most likely it is described wrongly") as caught:
        solved(thesis, target_in_water, right, replace(scanned(kind, **wrong, **CERTIFIED[kind]), source="wrong.h5"))
    said = str(caught.value)
    found, off, sigmas = (float(text) for text in SIZE_FOUND.search(said).groups())
    assert said.count("described as") == 1
    assert f"wrong.h5: {name} found" in said
    assert abs(found - true_mm) < 0.3
    assert off == pytest.approx(found - true_mm - 1.0, abs=1e-3)
    assert sigmas > 10


def test_sizes_that_are_all_off_by_the_same_share_may_be_the_targets_fault(thesis, target_in_water):
    larger = {"diameters_mm": (50.5, 52.52), "spacings_mm": (1.01 * SPACING,)}
    with pytest.raises(
        CalibrationError, match=r"all known sizes are off by the same -0\.99 %: also check the target's"
    ):
        solved(thesis, target_in_water, scanned("spheres", **larger, **CERTIFIED["spheres"]))


def test_a_wrong_size_without_a_stated_uncertainty_does_no_harm_and_is_told(thesis, target_in_water):
    """It is estimated; a millimetre is worth a warning, 0.18 % of it is not, though measured to 0.03 %."""
    result = solved(thesis, target_in_water, scanned("spheres", diameters_mm=(50.09, 53.0)))
    (said,) = result.warnings
    assert said.startswith("spheres.h5: diameter of sphere 2 found 5")
    assert said.endswith("it was estimated")
    right = solved(thesis, target_in_water, scanned("spheres"))
    assert right.warnings == []
    np.testing.assert_allclose(result.calibration.camera.fx_px, right.calibration.camera.fx_px, rtol=1e-5)


@pytest.mark.slow
def test_what_only_a_known_size_contradicts_it_is_the_cause_of(thesis, target_in_water, monkeypatch):
    """A pipe found 4.5 standard uncertainties too small is a doubt, but not where nothing else explains a misfit."""
    scan = scanned("pipe along", diameter_mm=220.16, **CERTIFIED["pipe along"])
    fine = with_fine_target(thesis)
    warnings = solved(fine, target_in_water, scan).warnings
    assert warnings[0].startswith("pipe along.h5: diameter of the pipe found 220.0")
    as_described = policy._solve_with_observed_uncertainties

    def misfitting(problem):
        result, against = as_described(problem)
        known = problem.evidence[-1].surface.diameter_std_mm < np.inf
        return result, replace(against, misfits={"target": "a misfit"}) if known else against

    monkeypatch.setattr(policy, "_solve_with_observed_uncertainties", misfitting)
    with pytest.raises(CalibrationError, match=r"itself: pipe along.h5: diameter .* off\): most .*; a misfit"):
        solved(fine, target_in_water, scan)


def test_images_of_a_scan_are_left_out_as_long_as_enough_agree(thesis, target_in_water):
    seen = replace(gathered(thesis, [target_in_water]), scans=[scanned("spheres")])
    assert seen.remove_images({"spheres.h5, at 0 mm"}).scans[0].image_names() == seen.scans[0].image_names()
    (kept,) = seen.remove_images({"spheres.h5, at 0 mm", "spheres.h5, at -18 mm"}).scans
    every, frames = seen.scans[0].found.frame, kept.found.frame
    assert np.unique(frames).tolist() == sorted({*every.tolist()} - {0, 6})
    assert len(kept.found.line) == len(kept.slopes) == np.isin(every, frames).sum()
    assert seen.remove_images({f"spheres.h5, at {position:g} mm" for position in STAGE[:4]}) is None


def test_scans_that_do_not_show_what_they_say_are_left_out():
    bodies, plane = KINDS["plane"]
    stripes, _ = scan_of(SENSOR, bodies, plane, stage_mm=STAGE[:3], count=300)
    wrong = replace(stripes, artefact=PipeStandard(diameter_mm=220.0), source="pipe.h5")
    few = replace(stripes, found=stripes.found[::4], slopes=stripes.slopes[::4])
    found, warnings = build_all_scan_evidence(
        [wrong, few, stripes], nominal_calibration(SENSOR), SENSOR, [WATER], sizes_known=True
    )
    assert len(found) == 1
    assert len(warnings) == 2
    assert warnings[0].startswith("pipe.h5: left out, ")
    assert "profile lines" in warnings[1]


def test_scans_along_different_directions_are_refused():
    bodies, plane = KINDS["plane"]
    stripes, _ = scan_of(SENSOR, bodies, plane, stage_mm=STAGE[:3])
    other = replace(stripes, stage_direction=np.array([0.0, 1.0, 0.0]))
    with pytest.raises(CalibrationError, match="different directions"):
        build_all_scan_evidence([stripes, other], nominal_calibration(SENSOR), SENSOR, [WATER], sizes_known=True)


@pytest.mark.parametrize(
    ("artefact", "pose", "error", "says"),
    [
        (None, None, DescriptionError, "does not describe what it shows"),
        ({"kind": "step", "height_mm": 20.0}, None, DescriptionError, "shows a step"),
        ({"kind": "pipe"}, None, DescriptionError, "diameter_mm"),
        ({"kind": "plane"}, None, CaptureError, "no stripe"),
        ({"kind": "plane"}, np.eye(4), CalibrationError, "contains poses"),
    ],
)
def test_captures_that_are_no_scan_of_a_known_surface(tmp_path, artefact, pose, error, says):
    header = CaptureHeader(
        name="scan",
        sensor=SENSOR,
        medium_name="water",
        medium=Medium(kind="custom", index=WATER),
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
        artefact=artefact,
    )
    path = tmp_path / "scan.h5"
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        image = np.zeros((SENSOR.camera.height_px, SENSOR.camera.width_px), dtype=np.uint8)
        writer.append(Frame(image, 0.0, True, 1.0, 0.0, pose))
    with Capture(path) as capture, pytest.raises(error, match=says):
        scan_stripes(capture, VIEW, stripe=CalibrationOptions().stripe)


def test_what_blur_and_the_sheets_thickness_leave_is_common_to_all_points():
    """The blur contributes a uniformly distributed fraction, light beside the sheet twice its thickness uncertainty.

    On a plane square to the laser's axis, a shift of the sheet by d moves the points as a pixel shift does. This shift
    is d divided by the size of a pixel there, because the camera's rays cross the old sheet or the plane.
    """
    square = Body((0.0, 0.0, 40.0), None, (0.0, 0.0, 1.0))
    stripes, _ = scan_of(SENSOR, (square,), PlaneStandard(), stage_mm=STAGE, count=300)
    nominal, rng = nominal_calibration(SENSOR), np.random.default_rng(4)
    seen = stripes.found
    blur, slopes = rng.normal(0, 0.05, (2, len(seen.line)))
    given = {"medium_index": WATER, "sizes_known": True, "image": 0}
    plain, _ = build_scan_evidence(replace(stripes, blur_px=blur, slopes=0 * slopes), nominal, SENSOR, **given)
    kept = np.searchsorted(seen.frame * 1e6 + seen.line, plain.frame * 1e6 + plain.pixels[:, 0])
    np.testing.assert_allclose(plain.common_px, np.abs(blur[kept]) / np.sqrt(3), rtol=1e-9)
    common = {}
    for thickness in (0.1, 0.3):
        known = SENSOR.uncertainty.model_copy(update={"sheet_thickness": thickness})
        sensor = SENSOR.model_copy(update={"uncertainty": known})
        found, _ = build_scan_evidence(replace(stripes, blur_px=0 * blur, slopes=slopes), nominal, sensor, **given)
        common[thickness] = found.common_px
    np.testing.assert_allclose(common[0.3], 3 * common[0.1], rtol=1e-9)
    moved_z = np.abs(nominal.object_transform()[:3, 2] @ found.beside_mm)
    below = replace(seen, centre_px=seen.centre_px + 1.0)
    z = [
        reconstruct_profile(
            nominal, each.line, each.centre_px, medium_index=WATER, stage_mm=0.0, stage_direction=np.array([1.0, 0, 0])
        ).points_mm[:, 2]
        for each in (seen, below)
    ]
    np.testing.assert_allclose(common[0.1], 0.2 * moved_z / np.abs(z[1] - z[0])[kept], rtol=0.02)
