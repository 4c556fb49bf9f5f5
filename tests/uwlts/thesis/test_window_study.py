"""Window distance by the step images used, and its effect on spheres, on drawn stripes with known truth."""

import numpy as np
import pytest

from tests.uwlts.calibration_views import STEP_MM, WATER
from tests.uwlts.drawn_stripes import SENSOR, SPACING_MM, STAGE_MM, sphere_profiles, step_image, write
from uwlts.errors import CaptureError
from uwlts.optics.nominal import nominal_calibration
from uwlts.thesis.campaign_folder import CampaignFolder
from uwlts.thesis.results import WindowChoice
from uwlts.thesis.sphere_spacing import SphereScan, mean_spacing_error, spacing_error, window_choices

EXACT = nominal_calibration(SENSOR)
DISTANCE_MM = SENSOR.camera.window.distance_mm
PLACES = {"near": -40.0, "standoff": 10.0, "far": 60.0}


def described(distance_mm):
    """Return the sensor described by its captures, with the window at another distance."""
    window = SENSOR.camera.window.model_copy(update={"distance_mm": distance_mm})
    return SENSOR.model_copy(update={"camera": SENSOR.camera.model_copy(update={"window": window})})


def campaign(folder, poses, *, odd_mm=None):
    """Write a campaign folder with step images in some poses at every position; the far step has another height."""
    for place, depth in PLACES.items():
        height = odd_mm if odd_mm is not None and place == "far" else STEP_MM
        images = [step_image(depth, tilt=tilt, shift_mm=shift, height_mm=height) for tilt, shift in poses]
        artefact = {"kind": "step", "height_mm": STEP_MM}
        write(folder / f"step-{place}-water.h5", images, sensor=described(55.0), artefact=artefact)
    return CampaignFolder(folder)


@pytest.fixture(scope="module")
def scans():
    """Exact stripes on two spheres at two depths."""
    found = []
    for depth in (0.0, 50.0):
        profiles = sphere_profiles(depth)
        pieces = [
            (x, n, pixels) for x, profile in zip(STAGE_MM, profiles, strict=True) for n, pixels in enumerate(profile)
        ]
        found.append(
            SphereScan(
                placement=f"{depth:g}",
                pixels=np.concatenate([pixels for _, _, pixels in pieces]),
                stage_mm=np.concatenate([np.full(len(pixels), x) for x, _, pixels in pieces]),
                sphere=np.concatenate([np.full(len(pixels), n) for _, n, pixels in pieces]),
                stage_direction=np.array([1.0, 0.0, 0.0]),
                medium_index=WATER,
                spacing_mm=SPACING_MM,
            )
        )
    return found


def moved(distance_mm):
    return EXACT.model_copy(update={"window": EXACT.window.model_copy(update={"distance_mm": distance_mm})})


def test_exact_spheres_have_no_error_and_their_mean_is_without_sign(scans):
    # Rays are rounded at 1e-13 and fitted by iteration.
    assert mean_spacing_error(EXACT, scans) < 1e-6
    errors = [spacing_error(moved(DISTANCE_MM + 5), scan) for scan in scans]
    assert all(abs(error) > 0.01 for error in errors)
    assert mean_spacing_error(moved(DISTANCE_MM + 5), scans) == pytest.approx(np.mean(np.abs(errors)))
    opposite = [
        spacing_error(EXACT, scan, medium_index=WATER + sign * 1e-3) for scan, sign in zip(scans, (1, -1), strict=True)
    ]
    assert opposite[0] * opposite[1] < 0


@pytest.fixture(scope="module")
def study(tmp_path_factory, scans):
    folder = campaign(tmp_path_factory.mktemp("study"), [(0.01, -8.0), (-0.02, 0.0), (0.03, 6.0)])
    return window_choices(folder, EXACT, scans)


def test_every_choice_of_images_finds_the_window(study, scans):
    choices = {choice.images: choice for choice in study[0]}
    singles = [f"{place} {number}" for place in PLACES for number in (1, 2, 3)]
    assert list(choices) == [*singles, *PLACES, "all"]
    per_mm = mean_spacing_error(moved(DISTANCE_MM + 1), scans)
    for choice in choices.values():
        # Drawn stripes are good to 0.01 px, which the mean over some hundred lines brings to 1 um of the step's height;
        # 1 mm of distance changes that by 0.015 mm or more.
        assert choice.distance_mm == pytest.approx(DISTANCE_MM, abs=0.25), choice
        # The spheres feel what is left in proportion, but for the square of the change: 1 % per mm.
        expected = abs(choice.distance_mm - DISTANCE_MM) * per_mm
        assert choice.mean_sse_mm == pytest.approx(expected, rel=0.05, abs=1e-6), choice
    assert abs(choices["all"].distance_mm - DISTANCE_MM) < 0.1
    together = np.mean([choices[name].distance_mm for name in singles])
    assert choices["all"].distance_mm == pytest.approx(together, abs=0.1)


def test_profiles_are_a_step_at_four_distances(study):
    profiles = study[1]
    shares = [profile.distance_mm / DISTANCE_MM for profile in profiles]
    assert shares == pytest.approx([0.25, 0.5, 1.0, 1.5])
    heights = []
    for profile in profiles:
        points = np.array(profile.points_mm)
        assert points.ndim == 2 and len(points) > 80 and np.isfinite(points).all()
        # The first image at the stand-off: a block 60 mm wide about Y = -8 mm, tilted by 0.01 rad.
        y, z = (points @ [[1.0, -0.01], [0.01, 1.0]]).T
        on_block, beside = np.abs(y + 8) < 25, np.abs(np.abs(y + 8) - 45) < 10
        assert np.count_nonzero(on_block) > 15 and np.count_nonzero(beside) > 15
        heights.append(np.median(z[beside]) - np.median(z[on_block]))
    # The true one at the true distance, too high before and too low behind it or the other way round: 0.02 mm per mm.
    assert heights[2] == pytest.approx(STEP_MM, abs=0.05)
    slopes = np.diff(heights) / np.diff([profile.distance_mm for profile in profiles])
    assert np.abs(slopes) == pytest.approx([0.02] * 3, rel=0.25)
    assert len(set(np.sign(slopes))) == 1


def test_images_that_determine_no_distance_give_no_result(tmp_path, scans):
    choices, _ = window_choices(campaign(tmp_path, [(0.0, 0.0)], odd_mm=STEP_MM + 4), EXACT, scans)
    found = {choice.images: choice for choice in choices}
    for name in ("far 1", "far"):
        assert found[name] == WindowChoice(name, None, None)
    assert found["near 1"].distance_mm == pytest.approx(DISTANCE_MM, abs=0.3)


def test_a_missing_place_is_reported(tmp_path, scans):
    folder = campaign(tmp_path, [(0.0, 0.0)])
    (tmp_path / "step-far-water.h5").unlink()
    with pytest.raises(CaptureError, match=r"no step-far-water\.h5"):
        window_choices(folder, EXACT, scans)
