"""Reconstruction of scans on a moving platform, from its poses, a mount and a trajectory."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwlts
from tests.uwlts.mount_views import MOUNT, MOUNT_STD, known_mount
from tests.uwlts.reconstruction.test_reconstruct import CALIBRATION, FRESH, HEIGHT, WIDTH, small_sensor, stripe_image
from uwlts.evaluation.figure_uncertainty import shift_std_mm
from uwlts.reconstruction.moving import PlatformPoses, add_platform_uncertainty, correct_path_uncertainty
from uwlts.storage.capture import CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointUncertainty

START = np.eye(4)
START[:3, :3] = Rotation.from_euler("ZYX", [70, 20, -35], degrees=True).as_matrix()
START[:3, 3] = (900.0, -340.0, 610.0)
STEP_MM = 2.0


def platform_at(stage_mm):
    """Return the platform's pose after a motion of the sensor by ``stage_mm`` along its x axis."""
    moved = np.eye(4)
    moved[0, 3] = stage_mm
    return START @ moved @ np.linalg.inv(MOUNT)


def record(path, *, stage=False, poses=False, mount=None):
    """Five images, one without laser, taken each second and each 2 mm: by the stage, or by the platform."""
    header = CaptureHeader(
        name="scan",
        sensor=small_sensor(),
        medium_name="water",
        medium=FRESH,
        stage_direction=(1, 0, 0),
        saturation_dn=255,
        T_platform_sensor=None if mount is None else tuple(map(tuple, mount.tolist())),
    )
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number in range(5):
            at = STEP_MM * number
            image = stripe_image(number) if number != 3 else np.zeros((HEIGHT, WIDTH), np.uint8)
            pose = platform_at(at) if poses else None
            frame = Frame(image, at if stage else 0.0, number != 3, 1.0, float(number), pose)
            writer.append(frame)
    return path


@pytest.fixture
def expected(tmp_path):
    """Points of the scan by the stage, in the base frame."""
    cloud = uwlts.reconstruct(record(tmp_path / "stage.h5", stage=True), CALIBRATION)
    return cloud.points_mm @ START[:3, :3].T + START[:3, 3]


def test_poses_in_the_capture_are_the_platform_s_with_a_mount(tmp_path, expected):
    path = record(tmp_path / "posed.h5", poses=True)
    known_mount(MOUNT).save(tmp_path / "mount.json")
    cloud = uwlts.reconstruct(path, CALIBRATION, mount=tmp_path / "mount.json")
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)


KNOWN_S = np.array([-0.5, 0.3, 1.0, 2.9, 4.2])


def trajectory(times=KNOWN_S, *, by=None, scale=1.0):
    """Return the platform's trajectory by its clock, whose positions a robot reports too small by ``scale``."""
    poses = np.array([platform_at(STEP_MM * time) for time in KNOWN_S]) @ (np.eye(4) if by is None else by)
    poses[:, :3, 3] /= scale
    return uwlts.Trajectory(times, poses)


@pytest.mark.parametrize(
    ("way", "mount", "clock"),
    [
        (trajectory(100 + KNOWN_S), known_mount(MOUNT, time_offset_s=100.0, time_offset_std_s=1e-4), {}),
        (trajectory(100 + KNOWN_S), known_mount(MOUNT), {"clock_offset_s": 100.0}),
        (trajectory(50 + 1.002 * KNOWN_S), known_mount(MOUNT), {"clock_offset_s": 50.0, "clock_drift_ppm": 2000.0}),
        (trajectory(scale=1.0005), known_mount(MOUNT, robot_scale=1.0005), {}),
        (trajectory(by=MOUNT), None, {}),
    ],
    ids=["offset of the mount", "offset", "drift", "robot's scale", "of the sensor"],
)
def test_images_are_placed_along_the_trajectory_at_their_times(tmp_path, expected, way, mount, clock):
    path = record(tmp_path / "moving.h5")
    cloud = uwlts.reconstruct(path, CALIBRATION, mount=mount, trajectory=way, **clock)
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"trajectory": trajectory(), "clock_offset_s": 0.0, "clock_drift_ppm": 1e6}, "drifts by 1e[+]06 ppm"),
        ({"mount": known_mount(MOUNT), "clock_drift_ppm": 2000.0}, "without a trajectory"),
        ({"mount": known_mount(MOUNT)}, "4 of 4 laser images have no pose.*trajectory"),
        ({"trajectory": trajectory(KNOWN_S + 1.0)}, "1 of 4 times"),
    ],
)
def test_images_without_a_place_are_refused(tmp_path, given, says):
    with pytest.raises(uwlts.Error, match=says):
        uwlts.reconstruct(record(tmp_path / "stage.h5", stage=True), CALIBRATION, **given)


def test_the_mount_s_uncertainty_moves_points_as_other_mounts_do():
    """Compare with points calculated with 4000 mounts drawn from the covariance."""
    rng = np.random.default_rng(1)
    seen = rng.uniform([-40, -1, 150], [40, 1, 300], size=(30, 3))
    poses = np.array([platform_at(stage) for stage in rng.uniform(0, 500, 30)])
    poses[:, :3, :3] = Rotation.random(30, rng=rng).as_matrix()

    def points(transform):
        on_platform = seen @ transform[:3, :3].T + transform[:3, 3]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], on_platform) + poses[:, :3, 3]

    drawn = []
    for step in rng.standard_normal((4000, 6)) * MOUNT_STD:
        other = MOUNT.copy()
        other[:3, 3] += step[:3]
        other[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ MOUNT[:3, :3]
        drawn.append(points(other))
    none = PointUncertainty(np.zeros((30, 6)), np.zeros((30, 3)), np.zeros((1, 30, 3)))
    ride = PlatformPoses(poses, None, np.arange(30.0))
    found = add_platform_uncertainty(none, points(MOUNT), np.arange(30), ride, known_mount(MOUNT)).covariance_mm2()
    # The standard deviation of 4000 is right to 1.1 %; 90 of them stay within five of those.
    np.testing.assert_allclose(np.sqrt(np.einsum("nii->ni", found)), np.std(drawn, axis=0), rtol=0.056)


def drawn_points(seen, poses, errors):
    """Points in the base frame of ``seen`` (n, 3) from poses (F, 4, 4) with errors (F, 6), (F, n, 3)."""
    turned = Rotation.from_rotvec(errors[:, 3:]).as_matrix() @ poses[:, :3, :3]
    return np.einsum("fij,nj->fni", turned, seen) + (poses[:, :3, 3] + errors[:, :3])[:, None]


def test_errors_of_each_pose_move_its_image_s_points_together():
    """Compare with 4000 draws of pose errors, independent between images; means over images average them."""
    rng = np.random.default_rng(2)
    seen, images = rng.uniform([-40, -1, 150], [40, 1, 300], size=(5, 3)), 6
    poses = np.array([platform_at(20.0 * number) for number in range(images)])
    root = np.tril(rng.normal(size=(6, 6))) * np.array([0.1, 0.1, 0.1, 4e-4, 4e-4, 4e-4])[:, None]
    covariance = np.tile(root @ root.T, (images, 1, 1))
    points, frame = drawn_points(seen, poses, np.zeros((images, 6))).reshape(-1, 3), np.repeat(range(images), 5)
    none = PointUncertainty(np.zeros((30, 6)), np.zeros((30, 3)), np.zeros((1, 30, 3)))
    ride = PlatformPoses(poses, covariance, np.arange(6.0))
    found = add_platform_uncertainty(none, points, frame, ride, None)
    errors = rng.standard_normal((4000, images, 6)) @ root.T
    drawn = np.array([drawn_points(seen, poses, each).reshape(-1, 3) for each in errors])
    # The standard deviation of 4000 is right to 1.1 %; 90 of them stay within five of those.
    np.testing.assert_allclose(found.std_mm(), drawn.std(axis=0), rtol=0.056)
    cloud = uwlts.PointCloud(points, np.ones(30), frame, np.arange(30), uncertainty=found)
    mean = shift_std_mm(cloud, np.ones(30, dtype=bool))
    np.testing.assert_allclose(mean, drawn.mean(axis=1).std(axis=0), rtol=0.056)
    assert (mean < 0.6 * found.std_mm().mean(axis=0)).all()


@pytest.mark.parametrize("kind", ["random walk", "common", "Gauss-Markov"])
def test_errors_along_a_path_are_correlated_as_its_covariances_state(kind):
    """Compare the length between the first and the last images with 4000 draws of errors along the path.

    Variances that grow with time mean a random walk. Shapes in time contain 99 % of its variance; the rest counts as
    independent. This changes the uncertainty of a distance between points of two images by 1 % at most.
    """
    rng = np.random.default_rng(3)
    count, seen, std = 40, np.array([[10.0, 0.0, 200.0]]), np.array([0.5, 0.7, 0.3, 1e-4, 2e-4, 3e-4])
    poses = np.array([platform_at(10.0 * number) for number in range(count)])
    times = np.arange(count, dtype=float)
    if kind == "random walk":
        steps = rng.standard_normal((4000, count, 6)) * std / np.sqrt(count)
        errors, correlation_s = np.cumsum(steps, axis=1), None
        covariance = np.diag(std**2) * ((times + 1) / count)[:, None, None]
    elif kind == "common":
        errors = np.repeat(rng.standard_normal((4000, 1, 6)) * std, count, axis=1)
        covariance, correlation_s = np.tile(np.diag(std**2), (count, 1, 1)), np.inf
    else:
        covariance, correlation_s = np.tile(np.diag(std**2), (count, 1, 1)), 30.0
        alike = np.linalg.cholesky(np.exp(-np.abs(times[:, None] - times) / 30.0))
        errors = np.einsum("fg,mgk->mfk", alike, rng.standard_normal((4000, count, 6)) * std)
    points = drawn_points(seen, poses, np.zeros((count, 6)))[:, 0]
    none = PointUncertainty(np.zeros((count, 6)), np.zeros((count, 3)), np.zeros((1, count, 3)))
    ride = PlatformPoses(poses, covariance, times, rates=np.zeros((count, 6)))
    found = add_platform_uncertainty(none, points, np.arange(count), ride, None, correlation_s=correlation_s)
    drawn = np.array([drawn_points(seen, poses, each)[:, 0] for each in errors])
    # 1.1 % of 4000 draws five times, and 1 % of the variance.
    np.testing.assert_allclose(found.std_mm(), drawn.std(axis=0), rtol=0.065, atol=1e-3)
    together = found.patterns_mm
    apart = np.sqrt(np.sum(found.poses_mm**2, axis=0))
    for first, last in ((0, count - 1), (count // 2, count - 1)):
        common = np.sqrt(np.sum((together[:, last] - together[:, first]) ** 2, axis=0))
        total = np.sqrt(common**2 + apart[first] ** 2 + apart[last] ** 2)
        np.testing.assert_allclose(total, (drawn[:, last] - drawn[:, first]).std(axis=0), rtol=0.08, atol=2e-3)


def test_many_images_have_the_uncertainty_of_few():
    """Compare a random walk at 1200 images, with modes from 400 times, with a tenth of the images."""
    count, seen = 1200, np.array([[10.0, 0.0, 200.0]])
    poses = np.array([platform_at(0.5 * number) for number in range(count)])
    points = drawn_points(seen, poses, np.zeros((count, 6)))[:, 0]
    variance = np.square([0.5, 0.7, 0.3, 1e-4, 2e-4, 3e-4])
    covariance = np.diag(variance) * ((np.arange(count) + 1.0) / count)[:, None, None]
    found = []
    for images in (np.arange(count), np.arange(0, count, 10)):
        none = PointUncertainty(np.zeros((len(images), 6)), np.zeros((len(images), 3)), np.zeros((1, len(images), 3)))
        ride = PlatformPoses(poses[images], covariance[images], images * 1.0, rates=np.zeros((len(images), 6)))
        found.append(add_platform_uncertainty(none, points[images], np.arange(len(images)), ride, None))
    many, few = found[0][::10], found[1]
    np.testing.assert_allclose(many.std_mm(), few.std_mm(), rtol=1e-5)
    for first, last in ((0, 119), (60, 119), (60, 70)):
        apart = [np.linalg.norm(each.patterns_mm[:, last] - each.patterns_mm[:, first], axis=0) for each in (many, few)]
        np.testing.assert_allclose(*apart, rtol=0.05)


def test_the_time_offset_s_uncertainty_moves_points_along_the_path():
    poses = np.array([platform_at(10.0 * number) for number in range(4)])
    rates = np.tile([100.0, 0.0, 0.0, 0.0, 0.0, 0.1], (4, 1))
    points = poses[:, :3, 3] + np.array([0.0, 200.0, 0.0])
    none = PointUncertainty(np.zeros((4, 6)), np.zeros((4, 3)), np.zeros((1, 4, 3)))
    mount = known_mount(
        MOUNT, time_offset_s=0.0, time_offset_std_s=2e-4, covariance=tuple(map(tuple, np.eye(6) * 1e-20))
    )
    found = add_platform_uncertainty(
        none, points, np.arange(4), PlatformPoses(poses, None, np.arange(4.0), rates), mount
    )
    # 100 mm/s along x, less 0.1 rad/s about z at 200 mm along y: 80 mm/s in 0.2 ms.
    np.testing.assert_allclose(found.std_mm(), np.tile([0.016, 0.0, 0.0], (4, 1)), atol=1e-6)


def test_a_mount_of_the_drawing_is_used_with_a_warning(tmp_path, expected):
    path = record(tmp_path / "posed.h5", poses=True, mount=MOUNT)
    cloud = uwlts.reconstruct(path, CALIBRATION)
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)
    np.testing.assert_array_equal(cloud.time_s, cloud.frame)
    assert "calibrate it" in cloud.warnings[-1]
    turned = MOUNT.copy()
    turned[0, 3] += 5.0
    calibrated = uwlts.reconstruct(path, CALIBRATION, mount=known_mount(turned))
    shift = np.linalg.norm(calibrated.points_mm - expected, axis=1)
    np.testing.assert_allclose(shift, 5.0, atol=1e-8)
    assert not calibrated.warnings


def test_points_have_the_covariance_of_the_path_and_of_their_sensor():
    """Single points are exact (float32); covariances between images omit the 1 % assigned to single images."""
    rng = np.random.default_rng(2)
    images, coefficients, count = 60, 8, 1200
    at = np.linspace(0, 1, images)[:, None]
    basis = np.exp(-(((at - np.linspace(0, 1, coefficients)) / 0.2) ** 2))
    # As smooth as a drift: 1 % is left after less than twelve shapes.
    apart = np.subtract.outer(np.linspace(0, 1, coefficients), np.linspace(0, 1, coefficients))
    covariance = np.kron(np.exp(-((apart / 1.5) ** 2)), np.diag(np.square([5.0] * 3 + [0.01] * 3)))
    image, levers = rng.integers(images, size=count), rng.uniform(-300, 300, (count, 3))
    # Two parts of a sensor and the navigation's, mixed as patterns are.
    sensor, navigation = rng.standard_normal((2, count, 3)), 40 * rng.standard_normal((1, count, 3))
    mixed = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    patterns = np.tensordot(mixed, np.concatenate([sensor, navigation]), axes=1)
    noise = rng.standard_normal((count, 3, 3))
    own = noise @ noise.transpose(0, 2, 1)
    pairs = np.stack([own[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], axis=1)
    known = PointUncertainty(pairs, np.zeros((count, 3)), patterns, shared={"sensor": mixed[:, :2]})
    blocks = covariance.reshape(coefficients, 6, coefficients, 6)
    poses = np.einsum("fc,cidj,fd->fij", basis, blocks, basis)
    found = correct_path_uncertainty(known, np.zeros((count, 3)), levers, image, basis, covariance, poses)
    cross = np.zeros((count, 3, 6))
    cross[:, :, :3] = np.eye(3)
    for axis, unit in enumerate(np.eye(3)):
        cross[:, :, 3 + axis] = np.cross(unit, levers)
    by = np.einsum("nij,nc->nicj", cross, basis[image]).reshape(count, 3, -1)
    path = by @ covariance @ by.transpose(0, 2, 1)
    expected = path + own + np.einsum("kni,knj->nij", sensor, sensor)
    size = np.sqrt(np.einsum("nii->ni", expected))
    np.testing.assert_allclose(
        found.covariance_mm2() / (size[:, :, None] * size[:, None]),
        expected / (size[:, :, None] * size[:, None]),
        atol=1e-4,
    )
    between = np.einsum("nia,ab,mjb->nimj", by[:40], covariance, by[40:80]) + np.einsum(
        "kni,kmj->nimj", sensor[:, :40], sensor[:, 40:80]
    )
    stated = np.einsum(
        "kni,kmj->nimj", found.patterns_mm[:, :40].astype(float), found.patterns_mm[:, 40:80].astype(float)
    )
    scale = size[:40, :, None, None] * size[None, None, 40:80]
    assert np.sqrt(np.mean(((stated - between) / scale) ** 2)) < 0.03
    # The contribution of the sensor remains separate from all others.
    again = np.tensordot(found.shared["sensor"].T, found.patterns_mm, axes=1)
    np.testing.assert_allclose(again, sensor, atol=1e-4)
