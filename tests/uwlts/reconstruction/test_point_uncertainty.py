"""Compare the stated uncertainty of cloud points with Monte Carlo draws through the reconstruction."""

from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import MEDIUM, Noise, gathered, target_series
from uwlts.calibration.calibrate import solve_jointly
from uwlts.calibration.joint.parameters import Prior
from uwlts.calibration.joint.scanned_surfaces import SLOPES
from uwlts.calibration.joint.stored_estimate import read_stored_estimate
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.calibration.sequential.sheet_fit import object_frame
from uwlts.errors import CalibrationError
from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.figure_uncertainty import figure_uncertainties, linearise_figures, shift_std_mm
from uwlts.fitting.propagation import noise_shifts
from uwlts.model.artefacts import PipeStandard, PlaneStandard, SphereStandard, StepStandard
from uwlts.model.calibration import KnownMedium, KnownStage
from uwlts.model.parameter_keys import MediumIndex, StageParameter
from uwlts.model.sensor import Medium
from uwlts.optics.triangulation import reconstruct_pixels
from uwlts.reconstruction.point_uncertainty import (
    MOST_CORRELATED,
    estimate_pull_px,
    estimate_stripe_noise_px,
    measure_correlation,
    point_uncertainty,
    stage_components,
)
from uwlts.shapes.sphere import Sphere
from uwlts.storage.capture import Capture, CaptureHeader, Frame, describe_source
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty
from uwlts.stripe import extract_stripe

BUILT = built_sensor()
DRAWS = 400
DUMBBELL = SphereStandard(diameters_mm=(50.12, 50.14), spacings_mm=(99.18,))
LINES = np.arange(100, 1180, 12)


@pytest.fixture(scope="module")
def calibration(thesis):
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(4))
    series = target_series(BUILT, medium=0, positions=np.arange(6) * 36.0 - 120.0, noise=noise)
    options = CalibrationOptions(poses="stage", correct_circles=False)
    return solve_jointly(gathered(thesis, [series]), options=options).calibration


def header_of(sensor, medium) -> CaptureHeader:
    return CaptureHeader(
        name="scan",
        sensor=sensor,
        medium_name="water",
        medium=medium,
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
    )


def capture_of(folder, sensor, medium, frames=2) -> Capture:
    header = header_of(sensor, medium)
    path = folder / "scan.h5"
    image = np.zeros((sensor.camera.height_px, sensor.camera.width_px), np.uint8)
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number in range(frames):
            writer.append(Frame(image, 20.0 * number, True, 1.0, float(number)))
    return Capture(path)


@pytest.fixture(scope="module")
def stripes():
    """Stripes (frame, line, centre) of two images: near and far, with 0.1 px and 0.3 px of noise."""
    rng = np.random.default_rng(7)
    line = np.tile(np.arange(100, 1180), 2)
    frame = np.repeat([0, 1], len(line) // 2)
    smooth = np.where(frame == 0, 300.0, 700.0) + 20 * np.sin(line / 200)
    return frame, line, smooth + rng.normal(0, np.where(frame == 0, 0.1, 0.3))


def full(matrix6):
    result = np.zeros((len(matrix6), 3, 3))
    for column, (i, j) in enumerate(PAIRS):
        result[:, i, j] = result[:, j, i] = matrix6[:, column]
    return result


def test_the_stripes_noise_is_that_of_its_image(stripes):
    """The median of 1078 differences is right to 2 % (one standard deviation); a step between treads does not count."""
    frame, line, centre = stripes
    centre = centre + 40.0 * ((line > 500) & (line < 700))
    noise = estimate_stripe_noise_px(frame, line, centre)
    assert noise[frame == 0] == pytest.approx(0.1, rel=0.08)
    assert noise[frame == 1] == pytest.approx(0.3, rel=0.08)


@pytest.mark.parametrize(("lines", "expected"), [(1, 1.0), (2, 0.884), (3, 0.782)])
def test_noise_that_neighbours_share_counts_as_in_means(lines, expected):
    """A moving mean leaves the variance of long means; of differences of means of four, it leaves ``expected`` squared.

    Second differences alone would give 1, 0.41 and 0.27. One of sixteen differences is independent: 4 % is nearly
    four standard deviations of their median.
    """
    noise = np.random.default_rng(11).normal(0, 0.1, 200_000 + lines - 1)
    line = np.arange(200_000)
    centre = 300 + 4e-10 * (line - 1e5) ** 2 + np.convolve(noise, np.full(lines, 1 / lines), mode="valid")
    found = estimate_stripe_noise_px(np.zeros_like(line), line, centre)
    assert found == pytest.approx(0.1 * expected, rel=0.04)


def test_a_wavy_surface_adds_at_most_as_much_as_correlated_noise_does():
    line = np.arange(100_000)
    centre = 300 + np.sin(2 * np.pi * line / 20) + np.random.default_rng(12).normal(0, 0.1, len(line))
    assert measure_correlation(np.zeros_like(line), line, centre) > MOST_CORRELATED
    # Second differences of this wave have 0.1 px, as the noise has.
    assert np.all(estimate_stripe_noise_px(np.zeros_like(line), line, centre) < MOST_CORRELATED * 0.15)


@pytest.mark.parametrize("sigma", [0.53, 0.58, 0.63])
def test_narrow_stripes_err_with_their_place_in_the_pixel_as_stated(sigma):
    """Level faces in speckle of grains of half a pixel. A mean of 2000 lines scatters by a fifth of what is stated."""
    rng, fine, faces, lines = np.random.default_rng(9), 8, 8, 2000
    across = (np.arange(64 * fine) + 0.5) / fine - 0.5
    errors, stated = [], []
    for phase in (np.arange(faces) + 0.5) / faces:
        speckle = rng.gamma(2.0, 0.5, (lines, 2, 64 * 2)).mean(axis=1).repeat(fine // 2, axis=1)
        light = speckle * np.exp(-0.5 * ((across - 30 - phase) / sigma) ** 2)
        grey = 150 * light.reshape(lines, 64, fine).mean(axis=2) + 4 + rng.normal(0, 0.6, (lines, 64))
        found = extract_stripe(np.clip(np.rint(grey), 0, 255).astype(np.uint8), stripe_along="height")
        centre, width = found.centre_px[found.lines], found.width_px[found.lines]
        noise = np.full(len(centre), centre.std())
        errors.append(np.mean(centre) - 30 - phase)
        stated.append(np.mean(estimate_pull_px(centre, width, noise)))
    assert np.corrcoef(errors, stated)[0, 1] < -0.8
    assert 0.5 < np.std(errors) / np.std(stated) < 1.5


def test_wide_stripes_have_no_error_with_their_place_in_the_pixel():
    centre = np.linspace(10.0, 20.0, 101)
    assert not estimate_pull_px(centre, np.full(101, 3.0), np.full(101, 0.1)).any()
    # Above 0.2 px the noise hides the place, and the estimate stays below the noise.
    assert np.abs(estimate_pull_px(centre, np.full(101, 1.5), np.full(101, 5.0))).max() < 0.3 * 5.0


def test_covariances_are_those_of_monte_carlo(calibration, stripes, thesis, tmp_path):
    """By drawing parameters of the estimate, the stage's lean, and the shift of the sheet by the laser's window.

    Points are reconstructed with each, in the OCS of its sheet.
    """
    frame, line, centre = stripes
    with capture_of(tmp_path, thesis, MEDIUM) as capture:
        known = point_uncertainty(capture, calibration, (frame, line, centre))
        stored = read_stored_estimate(calibration, thesis, MEDIUM)
        stage = capture.stage_mm[frame] - capture.stage_mm[:].mean()
    pick = np.arange(0, len(line), 120)
    rng = np.random.default_rng(3)
    drawn = rng.multivariate_normal(stored.values, stored.covariance, DRAWS, method="svd")
    leans = np.tan(np.radians(thesis.uncertainty.stage_alignment_deg)) * rng.standard_normal((DRAWS, 2))
    glass = thesis.laser.window
    per_rad = glass.thickness_mm * (1 - 1 / glass.index(635.0))
    shifts = per_rad * np.radians(thesis.uncertainty.laser_window_tilt_deg) * rng.standard_normal(DRAWS)
    pixels = np.column_stack([line, centre])[pick]
    points = []
    for values, lean, shift in zip(drawn, leans, shifts, strict=True):
        along = np.array([1.0, *lean])
        scale = 1.0 + stored.parameters.value(values, StageParameter.SCALE)
        changed = calibration.model_copy(
            update={
                "camera": stored.parameters.camera(values),
                "window": stored.parameters.window_model(values),
                "sheet": stored.parameters.sheet_model(values),
                "camera_from_object": tuple(map(tuple, own_frame(stored, values).tolist())),
                "media": (KnownMedium(medium=MEDIUM, index=stored.parameters.medium_index(values, stored.view)),),
            }
        )
        points.append(
            [shift, 0.0, 0.0]
            + reconstruct_pixels(
                changed,
                pixels,
                medium_index=changed.medium_index(MEDIUM),
                stage_mm=scale * stage[pick],
                stage_direction=along / np.linalg.norm(along),
            ).points_mm
        )
    points = np.array(points)
    # Correlations between different points included: of the differences to the first point.
    for seen, patterns in (
        (points, known.patterns_mm[:, pick]),
        (points[:, 1:] - points[:, :1], known.patterns_mm[:, pick[1:]] - known.patterns_mm[:, pick[:1]]),
    ):
        by_draws = np.std(seen, axis=0)
        by_patterns = np.sqrt(np.sum(patterns.astype(float) ** 2, axis=0))
        # A standard deviation of 400 draws is right to 3.5 % (one sigma): 5 sigma, and 0.1 um for what is left out.
        np.testing.assert_allclose(by_patterns, by_draws, rtol=0.18, atol=1e-4)
    systematic = full(known.systematic_mm2()[pick])
    cov = np.einsum("dni,dnj->nij", points - points.mean(0), points - points.mean(0)) / (DRAWS - 1)
    size = np.sqrt(np.einsum("nii->n", systematic))[:, None, None] ** 2
    assert (np.abs(systematic - cov) / size).max() < 0.3


def test_many_points_by_a_table_have_the_covariance_of_few_by_themselves(calibration, thesis, tmp_path):
    line, frame = np.tile(np.arange(100, 1180), 6), np.repeat(np.arange(6), 1080)
    rng = np.random.default_rng(8)
    centre = 300.0 + 80.0 * frame + 20 * np.sin(line / 200) + rng.normal(0, 0.1, len(line))
    whole = np.flatnonzero(frame == 2)
    with capture_of(tmp_path, thesis, MEDIUM, frames=6) as capture:
        many = point_uncertainty(capture, calibration, (frame, line, centre))
        few = point_uncertainty(capture, calibration, (frame[whole], line[whole], centre[whole]))
    assert len(line) >= 5000 > len(whole)
    # Both omit patterns that move points by 5e-5 mm (root mean square), at most three times that at a single point.
    found, expected = many.systematic_mm2()[whole], few.systematic_mm2()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2 * (1.5e-4) ** 2)
    np.testing.assert_allclose(many.random_mm2[whole], few.random_mm2, rtol=1e-5)


def test_random_covariance_is_the_stripes_noise_on_the_object(calibration, stripes, thesis, tmp_path):
    frame, line, centre = stripes
    with capture_of(tmp_path, thesis, MEDIUM) as capture:
        known = point_uncertainty(capture, calibration, (frame, line, centre))

    def points(shift):
        pixels = np.column_stack([line, centre + shift])
        return reconstruct_pixels(
            calibration,
            pixels,
            medium_index=calibration.medium_index(MEDIUM),
            stage_mm=0.0,
            stage_direction=np.array([1.0, 0, 0]),
        ).points_mm

    expected = (points(0.5) - points(-0.5)) * estimate_stripe_noise_px(frame, line, centre)[:, None]
    np.testing.assert_allclose(
        full(known.random_mm2), np.einsum("ni,nj->nij", expected, expected), rtol=1e-3, atol=1e-3 * np.max(expected**2)
    )
    along = noise_shifts(known)
    assert np.allclose(np.abs(along), np.abs(expected), rtol=1e-2, atol=1e-5)


def test_another_water_is_known_by_its_temperature_only(calibration, stripes, thesis, tmp_path):
    frame, line, centre = stripes
    other = Medium(kind="fresh", temperature_c=12.0)
    stored = read_stored_estimate(calibration, thesis, other)
    assert stored.parameters.keys[-1] == MediumIndex("the scan")
    std = other.index_uncertainty(calibration.wavelength_nm, thesis.uncertainty)
    assert np.sqrt(stored.covariance[-1, -1]) == pytest.approx(std)
    assert not stored.covariance[-1, :-1].any()
    warm = thesis.model_copy(update={"uncertainty": thesis.uncertainty.model_copy(update={"temperature_k": 20.0})})
    sizes = []
    for number, sensor in enumerate((thesis, warm)):
        folder = tmp_path / str(number)
        folder.mkdir()
        with capture_of(folder, sensor, other) as capture:
            known = point_uncertainty(capture, calibration, (frame, line, centre))
            width = known.patterns_mm[:, 1079, 1] - known.patterns_mm[:, 0, 1]
            sizes.append(np.linalg.norm(width))
    # 20 K change the index by some 1e-3, and widths as much.
    assert 1.5 * sizes[0] < sizes[1] < 0.3


@pytest.fixture(scope="module")
def spheres():
    """Two caps with what moves their points: noise, the positions of 20 images, and smooth patterns."""
    rng = np.random.default_rng(5)
    points, frame = [], []
    for y, diameter in zip((-49.59, 49.59), DUMBBELL.diameters_mm, strict=True):
        x, across = rng.uniform(-16, 16, (2, 1500))
        inside = np.hypot(x, across) < 20
        x, across = x[inside], across[inside]
        points.append(np.column_stack([x, across + y, -np.sqrt(diameter**2 / 4 - x**2 - across**2)]))
        frame.append(((x + 16) / 1.6).astype(int))
    points = np.vstack(points)
    ray = np.array([0.0, 0.004, 0.01])
    random = np.tile([ray[i] * ray[j] for i, j in PAIRS], (len(points), 1)).astype(np.float32)
    position = np.tile(np.float32([0.004, 0.0, 0.0]), (len(points), 1))
    patterns = np.stack(
        [rng.normal(0, 0.02, 3) + points @ rng.normal(0, 1e-4, (3, 3)) + 1e-6 * points**2 for _ in range(4)]
    ).astype(np.float32)
    known = PointUncertainty(random, position, patterns)
    points = points + rng.standard_normal((len(points), 1)) * ray
    return PointCloud(points, np.ones(len(points)), np.concatenate(frame), np.arange(len(points)), uncertainty=known)


def test_figures_of_spheres_have_the_uncertainty_of_monte_carlo(spheres):
    """Of 200 draws a standard deviation is right to 5 %: 4 sigma."""
    evaluation, known = evaluate_cloud(spheres, DUMBBELL), spheres.uncertainty
    found = figure_uncertainties(spheres, evaluation)
    rng, along = np.random.default_rng(1), noise_shifts(known)
    drawn = []
    for _ in range(200):
        move = rng.standard_normal((len(spheres), 1)) * along
        move = move + rng.standard_normal((20, 1))[spheres.frame] * known.position_mm
        move = move + np.einsum("m,mni->ni", rng.standard_normal(len(known.patterns_mm)), known.patterns_mm)
        first, second = (Sphere.fit((spheres.points_mm + move)[spheres.points_mm[:, 1] * side > 0]) for side in (-1, 1))
        drawn.append((np.linalg.norm(second.centre_mm - first.centre_mm), 2 * first.radius_mm, 2 * second.radius_mm))
    names = ("SSE", "diameter error sphere 1", "diameter error sphere 2")
    for name, std in zip(names, np.std(drawn, axis=0), strict=True):
        assert np.hypot(found[name].random_mm, found[name].systematic_mm) == pytest.approx(std, rel=0.2), name
    still = replace(spheres, uncertainty=replace(known, position_mm=np.zeros_like(known.position_mm)))
    name = "diameter error sphere 1"
    assert figure_uncertainties(still, evaluation)[name].random_mm < 0.7 * found[name].random_mm


def cloud_with_errors(points, rng):
    """Return a cloud of 20 images whose points have noise across X, image errors and two smooth patterns."""
    ray = np.array([0.0, 0.004, 0.01])
    random = np.tile([ray[i] * ray[j] for i, j in PAIRS], (len(points), 1)).astype(np.float32)
    position = np.tile(np.float32([0.004, 0.001, 0.002]), (len(points), 1))
    patterns = np.stack([3e-4 * points @ rng.normal(0, 1, (3, 3)) for _ in range(2)]).astype(np.float32)
    known = PointUncertainty(random, position, patterns)
    frame = np.digitize(points[:, 0], np.linspace(-40, 40, 21)[1:-1])
    points = points + rng.standard_normal((len(points), 1)) * ray
    return PointCloud(points, np.ones(len(points)), frame, np.arange(len(points)), uncertainty=known)


def bodies():
    """Return points of the upper half of a pipe, and of a step of 20 mm, with their descriptions."""
    rng = np.random.default_rng(11)
    x, angle = rng.uniform(-40, 40, 3000), rng.uniform(0.1, np.pi - 0.1, 3000)
    pipe = np.column_stack([x, 30 * np.cos(angle), -30 * np.sin(angle)])
    y = rng.uniform(-40, 40, 3000)
    step = np.column_stack([x, y, np.where(np.abs(y) < 15, -20.0, 0.05 * x / 40)])
    return {
        "pipe": (pipe, PipeStandard(diameter_mm=60.0), "diameter error"),
        "step": (step, StepStandard(height_mm=20.0), "height error"),
    }


@pytest.mark.parametrize("body", ["pipe", "step", "spheres"])
def test_derivatives_of_figures_are_those_of_a_new_evaluation(body, spheres):
    """To the second order of moves by some 0.01 mm (spheres: 0.05 mm) and of such residuals over radii of 25 mm."""
    if body == "spheres":
        cloud, artefact, names, within = spheres, DUMBBELL, {"SSE", "SSE known radius"}, 2e-4
        names |= {f"diameter error sphere {number}" for number in (1, 2)}
    else:
        points, artefact, name = bodies()[body]
        cloud, names, within = cloud_with_errors(points, np.random.default_rng(3)), {name}, 1e-4
    evaluation = evaluate_cloud(cloud, artefact)
    figures, plain = linearise_figures(cloud, evaluation), evaluation.figures_mm
    assert figures.figures_mm(np.zeros_like(cloud.points_mm)) == pytest.approx(plain, abs=1e-8)
    assert figures.gradients.keys() == names
    for move in cloud.uncertainty.patterns_mm[:2].astype(float):
        again = evaluate_cloud(replace(cloud, points_mm=cloud.points_mm + move), artefact).figures_mm
        assert max(abs(again[each] - plain[each]) for each in again) > 1e-3
        assert figures.figures_mm(move) == pytest.approx(again, abs=within)
        for each, by_points in figures.gradients.items():
            assert np.sum(by_points * move) == pytest.approx(again[each] - plain[each], abs=within), each


def test_figures_of_a_plane_are_those_of_a_new_evaluation():
    """Inclined, and bent by up to 0.03 mm beside noise of 0.01 mm; no point leaves or joins the fit."""
    rng = np.random.default_rng(12)
    x, y = rng.uniform(-40, 40, (2, 3000))
    cloud = cloud_with_errors(np.column_stack([x, y, 300 + 0.1 * x - 0.2 * y]), np.random.default_rng(3))
    evaluation = evaluate_cloud(cloud, PlaneStandard())
    figures = linearise_figures(cloud, evaluation)
    assert figures.figures_mm(np.zeros_like(cloud.points_mm)) == pytest.approx(evaluation.figures_mm, abs=1e-8)
    bend = 0.03 * np.column_stack([0 * x, 0 * x, np.cos(x / 15) * y / 40])
    again = evaluate_cloud(replace(cloud, points_mm=cloud.points_mm + bend), PlaneStandard()).figures_mm
    assert abs(again["STD"] - evaluation.figures_mm["STD"]) > 1e-3
    assert figures.figures_mm(bend) == pytest.approx(again, abs=2e-5)
    assert figures.gradients == {}


@pytest.mark.slow
@pytest.mark.parametrize("body", ["pipe", "step"])
def test_noise_of_a_size_is_that_of_monte_carlo_and_of_no_seed(body, monkeypatch):
    """A standard deviation of 200 draws is right to 5 %: 3 sigma. Another seed changes sizes by nothing."""
    draws = 200
    monkeypatch.setattr("uwlts.evaluation.figure_uncertainty._MOST_DRAWS", draws)
    points, artefact, name = bodies()[body]
    cloud, rng = cloud_with_errors(points, np.random.default_rng(3)), np.random.default_rng(6)
    evaluation, known = evaluate_cloud(cloud, artefact), cloud.uncertainty
    figures, drawn = linearise_figures(cloud, evaluation), []
    for _ in range(draws):
        move = rng.standard_normal((len(cloud), 1)) * noise_shifts(known)
        drawn.append(figures.figures_mm(move + rng.standard_normal((20, 1))[cloud.frame] * known.position_mm))
    found = figure_uncertainties(cloud, evaluation)
    assert found[name].random_mm == pytest.approx(np.std([each[name] for each in drawn]), rel=0.15)
    monkeypatch.setattr("uwlts.fitting.propagation._SEED", 1)
    again = figure_uncertainties(cloud, evaluation)
    assert again[name].random_mm == found[name].random_mm
    # All others by 200 draws: their ratio is right to 7 %, within 3 sigma.
    for each in found:
        assert again[each].random_mm == pytest.approx(found[each].random_mm, rel=0.23), each


@pytest.mark.parametrize("part", ["patterns_mm", "position_mm", "random_mm2"])
def test_a_clouds_place_has_the_uncertainty_of_monte_carlo(spheres, part):
    """Of each kind of error alone; of 400 draws a standard deviation is right to 3.5 %: 4 sigma."""
    stated = {name: each for name, each in vars(spheres.uncertainty).items() if isinstance(each, np.ndarray)}
    others = {name: np.float32(1e-12) * values for name, values in stated.items() if name != part}
    known = replace(spheres.uncertainty, **others)
    cloud, used = replace(spheres, uncertainty=known), spheres.points_mm[:, 1] > 0
    rng, drawn = np.random.default_rng(2), []
    for _ in range(DRAWS):
        move = rng.standard_normal((len(cloud), 1)) * noise_shifts(known)
        move = move + rng.standard_normal((20, 1))[cloud.frame] * known.position_mm
        move = move + np.einsum("m,mni->ni", rng.standard_normal(len(known.patterns_mm)), known.patterns_mm)
        drawn.append(move[used].mean(axis=0))
    np.testing.assert_allclose(shift_std_mm(cloud, used), np.std(drawn, axis=0), rtol=0.15, atol=1e-7)


@pytest.mark.parametrize(("calibrated", "way"), [(True, 1.0), (True, -1.0), (False, 1.0)])
def test_the_stage_of_a_scan_is_as_well_known_as_its_calibration(calibration, thesis, calibrated, way):
    """Its direction by the estimate where that has found it, also for the way back, else by the description."""
    stored = read_stored_estimate(calibration, thesis, MEDIUM)
    priors = stored.parameters.priors | dict.fromkeys(SLOPES, Prior(0.0, 1.0))
    parameters = replace(stored.parameters, priors=priors)
    covariance = np.zeros((len(parameters.keys), len(parameters.keys)))
    covariance[: len(stored.values), : len(stored.values)] = stored.covariance
    covariance[-2:, -2:] = [[4e-8, 1e-8], [1e-8, 9e-8]]
    values = np.append(stored.values, [0.0, 0.0])
    known = replace(stored, parameters=parameters, values=values, covariance=covariance)
    stages = (KnownStage(described=(1.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0)),) if calibrated else ()
    header = header_of(thesis, MEDIUM).model_copy(update={"stage_direction": (way, 0.0, 0.0)})
    found = stage_components(
        known,
        calibration.model_copy(update={"stages": stages}),
        header,
        np.linalg.cholesky(covariance + 1e-24 * np.eye(len(covariance))),
    )
    place = parameters.keys.index(StageParameter.SCALE)
    lean = np.tan(np.radians(thesis.uncertainty.stage_alignment_deg))
    expected = np.zeros((3, 3))
    if calibrated:
        # The estimated direction is fixed in the camera frame.
        turn, steps, by = calibration.object_transform()[:3, :3], 1e-5 * np.eye(len(values)), []
        for step in steps:
            after, before = (
                own_frame(known, each)[:3, :3].T @ turn @ [1.0 + each[place], *each[-2:]]
                for each in (values + step, values - step)
            )
            by.append((after - before) / 2e-5)
        expected = np.transpose(by) @ covariance @ by
    else:
        expected[0, 0] = covariance[place, place]
        expected[1:, 1:] = lean**2 * np.eye(2)
    expected[0, 0] += values[place] ** 2
    np.testing.assert_allclose(found.T @ found, expected, rtol=1e-6, atol=1e-15)


def test_a_sequential_calibration_gives_no_uncertainty(calibration, thesis):
    without = calibration.model_copy(update={"joint": None})
    with pytest.raises(CalibrationError, match="calibrate jointly"):
        read_stored_estimate(without, thesis, MEDIUM)


def test_residual_shifts_by_blur_and_stray_light_are_common_to_all_points(calibration, stripes, thesis, tmp_path):
    frame, line, centre = stripes
    rng = np.random.default_rng(2)
    blur, beside = rng.normal(0, 0.05, len(line)), rng.normal(0, 0.01, (len(line), 3))
    width, noise = rng.uniform(1.5, 3.5, len(line)), estimate_stripe_noise_px(frame, line, centre)
    shifts = {"blur_px": blur, "beside_mm": beside, "width_px": width}
    with capture_of(tmp_path, thesis, MEDIUM) as capture:
        plain = point_uncertainty(capture, calibration, (frame, line, centre))
        known = point_uncertainty(capture, calibration, (frame, line, centre), **shifts)
    per_px = noise_shifts(plain) / noise[:, None]
    # Any part of what blur may do is as likely; the sheet's thickness, known to 10 %, counts by its square.
    by_centre = blur / np.sqrt(3) + estimate_pull_px(centre, width, noise)
    added = [per_px * by_centre[:, None], 0.2 * beside]
    expected = sum(np.stack([each[:, i] * each[:, j] for i, j in PAIRS], axis=1) for each in added)
    # Patterns that move the points by less than 0.05 um together are left out.
    together = [each.patterns_mm.astype(float) for each in (known, plain)]
    variances = [
        np.stack([np.sum(each[:, :, i] * each[:, :, j], axis=0) for i, j in PAIRS], axis=1) for each in together
    ]
    np.testing.assert_allclose(variances[0] - variances[1], expected, atol=1e-7, rtol=1e-2)


def test_water_does_not_drift_before_its_own_scan(calibration, stripes, thesis, tmp_path):
    frame, line, centre = stripes
    drifting = thesis.model_copy(update={"uncertainty": thesis.uncertainty.model_copy(update={"drift_k": 30.0})})
    water = thesis.media["water"]
    known = calibration.model_copy(update={"media": (calibration.media[0].model_copy(update={"medium": water}),)})
    with capture_of(tmp_path, drifting, water) as capture:
        own = known.model_copy(
            update={
                "provenance": known.provenance | {"scan_captures": [describe_source(capture).model_dump(mode="json")]}
            }
        )
        free, tied = (
            point_uncertainty(capture, each, (frame, line, centre)).systematic_mm2()[:, 5] for each in (known, own)
        )
    # 30 K are 3e-3 of the index: along Z, 0.07 mm or more.
    assert (free - tied > 0.06**2).all()


def test_clouds_of_one_calibration_state_their_shared_errors(calibration, stripes, thesis, tmp_path):
    """Covariance between points of two scans, by the parts that their patterns share, against drawn parameters.

    A covariance of 400 draws is right to 5 % of both standard deviations (one sigma): five of these.
    """
    frame, line, centre = stripes
    moved = centre + np.where(line > 600, 90.0, -60.0)
    with capture_of(tmp_path, thesis, MEDIUM) as capture:
        first, second = (point_uncertainty(capture, calibration, (frame, line, each)) for each in (centre, moved))
        other = point_uncertainty(
            capture, calibration.model_copy(update={"joint": changed_joint(calibration)}), stripes
        )
    assert first.shared.keys() == second.shared.keys() != other.shared.keys()
    ours, theirs = (np.hstack([known.shared[name] for name in first.shared]) for known in (first, second))
    pick = np.arange(0, len(line), 300)
    between = np.einsum(
        "mni,mk,knj->nij",
        first.patterns_mm[:, pick].astype(float),
        ours @ theirs.T,
        second.patterns_mm[:, pick].astype(float),
    )
    stored = read_stored_estimate(calibration, thesis, MEDIUM)
    drawn = np.random.default_rng(3).multivariate_normal(stored.values, stored.covariance, DRAWS, method="svd")
    image = frame[pick] == frame[0]
    off = []
    for values in drawn:
        now = replace(stored, values=values)
        into = np.linalg.inv(own_frame(stored, values)) @ calibration.object_transform()
        off.append(
            [now.triangulate(line[pick], each[pick])[0] @ into[:3, :3].T + into[:3, 3] for each in (centre, moved)]
        )
    off = np.array(off) - np.mean(off, axis=0)
    # The stage, whose scale is among the parameters, moves points of both images along X alone.
    assert image.any() and not image.all()
    expected = np.einsum("dni,dnj->nij", off[:, 0], off[:, 1])[:, 1:, 1:] / (DRAWS - 1)
    size = np.sqrt(
        np.einsum("dni->ni", off[:, 0] ** 2)[:, 1:, None] * np.einsum("dni->ni", off[:, 1] ** 2)[:, None, 1:]
    )
    assert (np.abs(between[:, 1:, 1:] - expected) / (size / DRAWS)).max() < 0.25


def own_frame(stored, values):
    """T_camera_object (4, 4) of the sheet with other parameters."""
    return object_frame(stored.parameters.sheet_model(values), laser_axis=stored.parameters.sheet.axis)


def changed_joint(calibration):
    """The joint estimate with twice the covariance."""
    joint = calibration.joint
    return joint.model_copy(
        update={
            "covariance": tuple(tuple(4 * each for each in row) for row in joint.covariance),
            "std": tuple(2 * each for each in joint.std),
        }
    )
