"""Camera calibration: exact recovery, honest covariance, and refusals, by the stage and by free poses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.uwlts.calibration_views import Lens, built_sensor, inside, lattice, lens_of, stage_images, turn
from uwlts.calibration.camera.camera_parameters import (
    CameraOptions,
    Intrinsics,
    TargetImage,
    observe,
    placements,
    z_away,
)
from uwlts.calibration.camera.target_poses import centre_offsets, direct_linear, solve_camera, stage_direction
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.fitting.schur_least_squares import schur_least_squares

SENSOR = built_sensor()
LENS = lens_of(SENSOR)
SIZE = {"width_px": SENSOR.camera.width_px, "height_px": SENSOR.camera.height_px}
FEW = np.arange(7) * 50.0


def free_images(*, noise_px=0.0, rng=None, points=None, count=9, seed=3):
    """A target held by hand before the camera, tilted up to 35 deg, and the true poses."""
    points, draw = lattice(15, 15) if points is None else points, np.random.default_rng(seed)
    images, poses = [], []
    for _ in range(count):
        pose = np.eye(4)
        pose[:3, :3] = turn(*draw.uniform(-0.6, 0.6, 2), draw.uniform(-3, 3))
        pose[:3, 3] = [*draw.uniform(-20, 20, 2), draw.uniform(330, 480)]
        pixels = LENS.pixels(points @ pose[:3, :3].T + pose[:3, 3])
        here = inside(pixels, SENSOR)
        noise = rng.normal(0, noise_px, (here.sum(), 2)) if noise_px else 0.0
        images.append(TargetImage(points[here], pixels[here] + noise))
        poses.append(pose)
    return images, np.array(poses)


def found(solution):
    model = solution.model
    return np.array([model.fx_px, model.cx_px, model.cy_px, model.distortion.k1, model.distortion.k2])


TRUE = np.array([LENS.fx, LENS.cx, LENS.cy, LENS.k1, LENS.k2])


@pytest.mark.parametrize("poses", ["stage-normal", "stage", "free"])
def test_exact_pixels_give_the_exact_camera(poses):
    tilt = (0.02, -0.01) if poses == "stage" else (0.0, 0.0)
    images, true_poses = free_images() if poses == "free" else stage_images(SENSOR, positions=FEW, stage_tilt=tilt)[:2]
    solution = solve_camera(images, **SIZE, poses=poses)
    # Pixels are rounded at 1e-13; conditions of up to 1e5 leave 1e-8.
    np.testing.assert_allclose(found(solution), TRUE, rtol=0, atol=1e-8)
    np.testing.assert_allclose(solution.target_poses, true_poses, rtol=0, atol=1e-8)
    assert solution.rms_px() < 1e-9
    assert [len(r) for r in solution.residuals_px] == [len(i.points_mm) for i in images]


def test_prior_knowledge_of_the_tangential_terms_is_weighed_by_its_covariance():
    """The posterior of two normal distributions; that of the images is normal to a fraction of its deviation."""
    noise_px, std = 0.1, 7e-5
    images, _ = free_images(noise_px=noise_px, rng=np.random.default_rng(6))
    distortion = ("k1", "k2", "p1", "p2")
    alone, known = (
        solve_camera(images, **SIZE, poses="free", options=CameraOptions(distortion, tangential=tangential))
        for tangential in (None, (std, noise_px))
    )
    # Weights are relative to the stated noise of the points, which the images' own scatter confirms.
    information = np.linalg.inv(alone.covariance) * (alone.sigma_px / noise_px) ** 2
    prior = np.diag([name in ("p1", "p2") for name in alone.parameters]) / std**2
    covariance = np.linalg.inv(information + prior)
    values, found = (np.array(list(each.values().values())) for each in (alone, known))
    deviation = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found / deviation, covariance @ information @ values / deviation, atol=0.05)
    np.testing.assert_allclose(list(known.std().values()), deviation * known.sigma_px / noise_px, rtol=0.02)
    # The prior is about as certain as the images, so that both count.
    assert 0.5 < std / alone.std()["p1"] < 2


def test_the_stage_is_found_tilted_against_the_target():
    images, _, direction = stage_images(SENSOR, positions=FEW, stage_tilt=(0.02, -0.01))
    free = solve_camera(images, **SIZE, poses="stage")
    np.testing.assert_allclose(free.stage_direction, direction, atol=1e-9)
    assert free.stage_tilt_rad == pytest.approx(np.arctan(np.hypot(0.02, 0.01)), abs=1e-9)
    # Taken for the normal, the tilt of 1.3 deg shifts points by up to 6 mm over 300 mm of travel: tens of pixels.
    assert solve_camera(images, **SIZE).rms_px() > 0.5


def test_free_poses_tell_the_stages_direction():
    images, poses, direction = stage_images(SENSOR, positions=FEW)
    solution = solve_camera(images, **SIZE, poses="free")
    np.testing.assert_allclose(solution.stage_direction, direction, atol=1e-8)
    assert stage_direction(poses, np.zeros(len(poses))) is None
    assert stage_direction(poses, 2 * FEW) is None


@pytest.mark.parametrize("up", [False, True])
@pytest.mark.parametrize("reverse", [False, True])
def test_either_way_of_the_stage_and_of_the_targets_axes(up, reverse):
    images, true_poses, direction = stage_images(SENSOR, positions=FEW)
    flip = np.diag([1.0, -1.0, -1.0]) if up else np.eye(3)
    images = [replace(i, points_mm=i.points_mm @ flip, stage_mm=-i.stage_mm if reverse else i.stage_mm) for i in images]
    assert all(z_away(image) is not up for image in images)
    solution = solve_camera(images, **SIZE, approaching=not reverse)
    np.testing.assert_allclose(found(solution), TRUE, atol=1e-8)
    np.testing.assert_allclose(solution.target_poses[:, :3, :3], true_poses[:, :3, :3] @ flip, atol=1e-9)
    np.testing.assert_allclose(solution.stage_direction, -direction if reverse else direction, atol=1e-9)


def test_several_placements_of_the_target_share_the_camera():
    first, first_poses, _ = stage_images(SENSOR, positions=FEW)
    second, second_poses, _ = stage_images(SENSOR, positions=FEW[:4], spin=-0.5)
    second = [replace(image, placement=1) for image in second]
    solution = solve_camera(first + second, **SIZE)
    np.testing.assert_allclose(found(solution), TRUE, atol=1e-8)
    np.testing.assert_allclose(solution.target_poses, np.vstack([first_poses, second_poses]), atol=1e-8)


def test_chosen_parameters_only():
    images, _ = free_images()
    everything = CameraOptions(distortion=("k1", "k2", "p1", "p2", "k3"), pixel_aspect=None)
    solution = solve_camera(images, **SIZE, poses="free", options=everything)
    assert solution.parameters == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    np.testing.assert_allclose(found(solution), TRUE, atol=1e-7)
    np.testing.assert_allclose(solution.model.coefficients()[2:], 0, atol=1e-8)
    centred = CameraOptions(distortion=("k1",), principal_point_px=(600.0, 500.0))
    solution = solve_camera(images, **SIZE, poses="free", options=centred)
    assert solution.parameters == ("f", "k1")
    assert (solution.model.cx_px, solution.model.cy_px, solution.model.distortion.k2) == (600.0, 500.0, 0.0)
    for wrong in ({"distortion": ("k7",)}, {"distortion": ("k1", "k1")}, {"soft_limit_px": 0.0}):
        with pytest.raises(DescriptionError):
            CameraOptions(**wrong)


@pytest.mark.parametrize("local", [6, 8])
def test_derivatives_agree_with_differences(local):
    images, poses, _ = stage_images(SENSOR, positions=FEW, stage_tilt=(0.03, 0.02), points=lattice(7, 7))
    view = placements(images, approaching=True)[0]
    intrinsics = Intrinsics(CameraOptions(distortion=("k1", "k2", "p1", "p2", "k3")), **SIZE)
    global_values = np.array([LENS.fx, LENS.cx, LENS.cy, -0.09, 0.1, 1e-3, -2e-3, 0.05])
    pose = np.r_[cv2.Rodrigues(poses[0][:3, :3])[0].ravel(), poses[0][:3, 3], 0.03, 0.02][:local]
    at = observe(view, intrinsics, global_values, pose)
    derivatives, start = np.hstack([at.by_global, at.by_local]), np.r_[global_values, pose]
    assert derivatives.shape == (2 * len(view.points_mm), 8 + local)
    for column in range(len(start)):
        step = np.zeros(len(start))
        step[column] = 1e-5 * max(1.0, abs(start[column]))
        both = [observe(view, intrinsics, *np.split(start + sign * step, [8])).residuals.ravel() for sign in (1, -1)]
        difference = (both[0] - both[1]) / (2 * step[column])
        # Central differences: rounding 1e-13 / 1e-5 and curvature 1e-10 of the largest derivative.
        np.testing.assert_allclose(derivatives[:, column], difference, atol=2e-7 * np.abs(difference).max() + 1e-7)


@pytest.mark.parametrize("poses", ["stage-normal", "stage", "free"])
def test_errors_follow_the_reported_covariance(poses):
    rng, noise, points, scores, sigmas = np.random.default_rng(5), 0.05, lattice(9, 9), [], []
    for _ in range(30):
        if poses == "free":
            images, _ = free_images(noise_px=noise, rng=rng, points=points)
        else:
            images, _, _ = stage_images(SENSOR, positions=FEW, noise_px=noise, rng=rng, points=points)
        solution = solve_camera(images, **SIZE, poses=poses)
        error = found(solution) - TRUE
        scores.append(error @ np.linalg.solve(solution.covariance, error))
        sigmas.append(solution.sigma_px)
    # The scores are chi-square with 5 degrees of freedom (std sqrt(10)): their mean is 5 with a std of 0.58; 4 std.
    assert abs(np.mean(scores) - 5) < 2.3
    # Each sigma comes from at least 900 residuals: 2.4 %, the mean of 30 0.43 %; 4 std.
    assert np.mean(sigmas) == pytest.approx(noise, rel=0.017)


def test_free_poses_agree_with_opencv():
    images, _ = free_images(noise_px=0.05, rng=np.random.default_rng(2))
    options = CameraOptions(pixel_aspect=None)
    solution = solve_camera(images, **SIZE, poses="free", options=options)
    flags = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3
    rms, matrix, distortion, _, _ = cv2.calibrateCamera(
        [i.points_mm.astype(np.float32) for i in images],
        [i.pixels.astype(np.float32) for i in images],
        (SIZE["width_px"], SIZE["height_px"]),
        None,
        None,
        flags=flags,
    )
    assert rms == pytest.approx(solution.rms_px(), rel=1e-4)
    ours = np.r_[
        solution.model.fx_px,
        solution.model.fy_px,
        solution.model.cx_px,
        solution.model.cy_px,
        solution.model.coefficients()[:2],
    ]
    theirs = np.r_[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], distortion.ravel()[:2]]
    # OpenCV rounds pixels to float32, 3e-5 px against noise of 0.05 px; its own stopping rule costs as little.
    assert np.all(np.abs(ours - theirs) < 0.01 * np.sqrt(np.diag(solution.covariance)))


def test_a_restart_ends_at_the_same_camera():
    rng = np.random.default_rng(4)
    images, _, _ = stage_images(SENSOR, positions=FEW, noise_px=0.05, rng=rng, stage_tilt=(0.01, 0))
    for poses in ("stage-normal", "stage"):
        first = solve_camera(images, **SIZE, poses=poses)
        again = solve_camera(images, **SIZE, poses=poses, start=first)
        assert again.rounds <= first.rounds
        assert np.all(np.abs(found(again) - found(first)) < 1e-3 * np.sqrt(np.diag(first.covariance)))


def test_a_soft_limit_withstands_wrong_points():
    rng = np.random.default_rng(6)
    images, _, _ = stage_images(SENSOR, positions=FEW, noise_px=0.05, rng=rng, points=lattice(15, 15))
    for image in images:
        image.pixels[rng.choice(len(image.pixels), 3, replace=False)] += 5.0
    plain, soft = (
        np.abs(found(solve_camera(images, **SIZE, options=CameraOptions(soft_limit_px=limit))) - TRUE)
        for limit in (None, 0.1)
    )
    # 2 % of the points pull 100 times as hard as one in the noise; under the soft loss no harder than one at the limit.
    assert soft[0] < 0.3 * plain[0] or soft[3] < 0.3 * plain[3]
    assert soft[0] < 0.5


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.1, 3.1), st.floats(1500, 5000), st.floats(-0.2, 0.2))
@settings(max_examples=30, deadline=None)
def test_any_pose_and_lens(about_x, about_y, about_z, f, k1):
    lens, points = Lens(f, f, 600.0, 550.0, k1, 0.0), lattice(11, 11)
    rotation, images = turn(about_x, about_y, about_z), []
    for stage in (0.0, 30.0, 80.0):
        origin = np.array([5.0, -8.0, 0.22 * f]) - stage * rotation[:, 2]
        images.append(TargetImage(points, lens.pixels(points @ rotation.T + origin), stage))
    solution = solve_camera(images, **SIZE)
    # Three images at little depth are worse off than the thesis's 31: rounding times a condition of 1e6.
    assert solution.model.fx_px == pytest.approx(f, abs=1e-6)
    np.testing.assert_allclose(solution.target_poses[0, :3, :3], rotation, atol=1e-8)


def test_the_linear_camera_is_exact_without_distortion():
    rng = np.random.default_rng(7)
    points, rotation = rng.uniform(-80, 80, (40, 3)), turn(0.3, -0.2, 2.0)
    translation = np.array([10.0, -20.0, 400.0])
    camera = points @ rotation.T + translation
    lens = Lens(2400.0, 2400.0, 640.0, 500.0, 0.0, 0.0)
    found_matrix, found_rotation, found_translation = direct_linear(points, lens.pixels(camera))
    np.testing.assert_allclose(found_matrix, [[2400, 0, 640], [0, 2400, 500], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(found_rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found_translation, translation, atol=1e-6)
    with pytest.raises(CalibrationError, match="mirrored"):
        direct_linear(points * [1, 1, -1], lens.pixels(camera))
    with pytest.raises(CalibrationError, match="one plane"):
        direct_linear(points * [1, 1, 0], lens.pixels(camera))
    with pytest.raises(CalibrationError, match="at least 6"):
        direct_linear(points[:5], lens.pixels(camera)[:5])
    with pytest.raises(CalibrationError, match="same place"):
        direct_linear(points, np.full((40, 2), 7.0))


def ellipse_centres(matrix, pose, centres, radius):
    """Centres (N, 2) of the conics H^-T C H^-1 that are the images of circles in the target's plane."""
    homography = matrix @ np.column_stack([pose[:3, 0], pose[:3, 1], pose[:3, 3]])
    back, middles = np.linalg.inv(homography), []
    for x, y, _ in centres:
        circle = np.array([[1, 0, -x], [0, 1, -y], [-x, -y, x * x + y * y - radius**2]])
        conic = back.T @ circle @ back
        middles.append(-np.linalg.solve(conic[:2, :2], conic[:2, 2]))
    return np.array(middles)


def circle_pose(stage):
    pose = np.eye(4)
    pose[:3, :3] = turn(0.6, 0.1, 0.02)
    pose[:3, 3] = np.array([0, 0, 560.0]) - stage * pose[:3, 2]
    return pose


def centres(matrix, stage, points):
    """Images (N, 2) of the circles' centres."""
    pose = circle_pose(stage)
    images = (points @ pose[:3, :3].T + pose[:3, 3]) @ matrix.T
    return images[:, :2] / images[:, 2:]


def test_the_offset_of_circle_images_is_taken_out(monkeypatch):
    matrix, points, images = np.array([[2440.0, 0, 640], [0, 2440.0, 510], [0, 0, 1]]), lattice(11, 11), []
    for stage in FEW:
        images.append(TargetImage(points, ellipse_centres(matrix, circle_pose(stage), points, 3.0), stage))

    rounds = []

    def counted(*problem, **options):
        rounds.append(problem)
        return schur_least_squares(*problem, **options)

    biased = solve_camera(images, **SIZE)
    monkeypatch.setattr("uwlts.calibration.camera.target_poses.schur_least_squares", counted)
    unbiased = solve_camera(images, **SIZE, circle_diameter_mm=6.0)
    # The offsets, up to 0.09 px, act like a shift of the target by micrometres. They depend so little on the solution
    # that the change of less than 1e-4 px which ends the rounds leaves a thousandth of that.
    shift, left = (s.target_poses[0, :3, 3] - [0, 0, 560.0] for s in (biased, unbiased))
    assert np.abs(shift).max() > 5e-3
    assert np.abs(left).max() < 1e-5
    assert abs(biased.model.fx_px - 2440) > 1e-3
    assert abs(unbiased.model.fx_px - 2440) < 1e-5
    assert 1 < len(rounds) <= 4
    assert unbiased.rms_px() < 1e-5 < biased.rms_px()
    largest = max(np.hypot(*(i.pixels - centres(matrix, i.stage_mm, points)).T).max() for i in images)
    assert float(np.linalg.norm(np.vstack(unbiased.bias_px), axis=1).max()) == pytest.approx(largest, rel=1e-3)


def test_a_fit_that_leaves_circles_out_of_view_does_not_fit():
    """A trial fit that diverges is a calibration that fails, which another lens may replace."""
    points = lattice(2, 2)
    with pytest.raises(CalibrationError, match="4 of 4 circles cannot be projected"):
        centre_offsets(lambda seen: np.full((len(seen), 2), np.nan), circle_pose(0.0), points, diameter_mm=5.0)


def test_contradictory_stage_directions_are_refused():
    images, _, _ = stage_images(SENSOR, positions=FEW)
    with pytest.raises(CalibrationError, match="mirrored relative to the stage"):
        solve_camera(images, **SIZE, approaching=False)
    still = [replace(image, stage_mm=0.0) for image in images]
    with pytest.raises(CalibrationError, match="did not move"):
        solve_camera(still, **SIZE)
    mixed = [replace(image, points_mm=image.points_mm * [1, (-1) ** n, 1]) for n, image in enumerate(images)]
    with pytest.raises(CalibrationError, match="mirrored in some"):
        solve_camera(mixed, **SIZE)
    with pytest.raises(CalibrationError, match="square"):
        solve_camera(images, **SIZE, poses="stage", options=CameraOptions(pixel_aspect=None))


def test_undetermined_cameras_are_refused():
    with pytest.raises(CalibrationError, match="at least 3"):
        solve_camera(free_images(count=2)[0], **SIZE, poses="free")
    points, straight = lattice(11, 11), []
    rng = np.random.default_rng(8)
    for depth in (350.0, 400.0, 450.0):
        pixels = LENS.pixels(points + [0, 0, depth]) + rng.normal(0, 0.05, (len(points), 2))
        straight.append(TargetImage(points, pixels))
    with pytest.raises(CalibrationError, match="tilt|tilted"):
        solve_camera(straight, **SIZE, poses="free")
    # Parallel planes turned about one axis leave fx, fy and cy open.
    images, _, _ = stage_images(SENSOR, positions=FEW, noise_px=0.05, rng=rng, points=points)
    with pytest.raises(CalibrationError, match="determine|converge"):
        solve_camera(images, **SIZE, poses="free", options=CameraOptions(pixel_aspect=None))


def test_unusable_target_images_are_refused():
    points = lattice(5, 5)
    pixels = LENS.pixels(points + [0, 0, 400])
    for values in ({"pixels": np.where(np.arange(50).reshape(25, 2) == 7, np.nan, pixels)}, {"stage_mm": np.inf}):
        with pytest.raises(CalibrationError, match="not finite"):
            TargetImage(**{"points_mm": points, "pixels": pixels} | values)
    with pytest.raises(CalibrationError, match="at least 6"):
        TargetImage(points[:5], pixels[:5])
    with pytest.raises(CalibrationError, match="one line"):
        TargetImage(points * [1, 0, 0], pixels)
    with pytest.raises(CalibrationError, match="z = 0"):
        TargetImage(points + [0, 0, 1], pixels)
    with pytest.raises(ValueError, match="expected"):
        TargetImage(points, pixels[:-1])


def test_start_values_are_those_of_the_camera_matrix():
    matrix = np.array([[1000.0, 0.0, 640.0], [0.0, 1010.0, 500.0], [0.0, 0.0, 1.0]])
    intrinsics = Intrinsics(CameraOptions(pixel_aspect=None), 1280, 1024)
    np.testing.assert_array_equal(intrinsics.matrix(intrinsics.from_matrix(matrix)), matrix)
