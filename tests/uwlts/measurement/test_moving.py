"""Reconstruction of scans by a platform: by its poses, a mount and a trajectory."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import uwlts
from tests.uwlts.measurement.test_reconstruction import CALIBRATION, FRESH, HEIGHT, WIDTH, small_sensor, stripe_image
from tests.uwlts.mount_views import MOUNT
from uwlts.measurement.moving import with_mount
from uwlts.model.mount import Mount, SphereFound
from uwlts.storage.capture import CaptureHeader, CaptureWriter
from uwlts.storage.cloud import PointUncertainty

START = np.eye(4)
START[:3, :3] = Rotation.from_euler("ZYX", [70, 20, -35], degrees=True).as_matrix()
START[:3, 3] = (900.0, -340.0, 610.0)
STEP_MM = 2.0
STD = np.array([0.05, 0.08, 0.03, 4e-4, 2e-4, 3e-4])


def mount_of(transform, **changed):
    fields = {
        "T_platform_sensor": tuple(map(tuple, transform.tolist())),
        "covariance": tuple(map(tuple, np.diag(STD**2).tolist())),
        "coverage_factor": 2.0,
        "artefact": SphereFound(centre_mm=(0, 0, 0), radius_mm=20.0),
        "point_std_mm": 0.02,
        "pose_std_mm": 0.01,
        "rms_mm": 0.02,
        "held_out_rms_mm": 0.02,
        "poses": (),
    }
    return Mount(**fields | changed)


def platform_at(stage_mm):
    """The platform's pose where the sensor went by ``stage_mm`` along its x axis from the start."""
    moved = np.eye(4)
    moved[0, 3] = stage_mm
    return START @ moved @ np.linalg.inv(MOUNT)


def record(path, *, stage=False, poses=False):
    """Five images, one without laser, taken each second and each 2 mm: by the stage, or by the platform."""
    header = CaptureHeader(
        name="scan",
        sensor=small_sensor(),
        medium_name="water",
        medium=FRESH,
        stage_direction=(1, 0, 0),
        saturation_dn=255,
    )
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number in range(5):
            at = STEP_MM * number
            image = stripe_image(number) if number != 3 else np.zeros((HEIGHT, WIDTH), np.uint8)
            pose = platform_at(at) if poses else None
            frame = uwlts.Frame(image, at if stage else 0.0, number != 3, 1.0, float(number), pose)
            writer.append(frame)
    return path


@pytest.fixture
def expected(tmp_path):
    """Points of the scan by the stage, in the base frame."""
    cloud = uwlts.reconstruct(record(tmp_path / "stage.h5", stage=True), CALIBRATION)
    return cloud.points_mm @ START[:3, :3].T + START[:3, 3]


def test_poses_in_the_capture_are_the_platform_s_with_a_mount(tmp_path, expected):
    path = record(tmp_path / "posed.h5", poses=True)
    uwlts.write_mount(tmp_path / "mount.json", mount_of(MOUNT))
    cloud = uwlts.reconstruct(path, CALIBRATION, mount=tmp_path / "mount.json")
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)


@pytest.mark.parametrize("with_offset", [False, True])
def test_images_are_placed_along_the_trajectory_at_their_times(tmp_path, expected, with_offset):
    """The clock of the platform is 100 s ahead, as the mount or the caller says."""
    path = record(tmp_path / "moving.h5")
    times = np.array([99.5, 100.3, 101.0, 102.9, 104.2])
    trajectory = uwlts.Trajectory(times, np.array([platform_at(STEP_MM * (time - 100)) for time in times]))
    known = mount_of(MOUNT) if with_offset else mount_of(MOUNT, time_offset_s=100.0, time_offset_std_s=1e-4)
    offset = 100.0 if with_offset else None
    cloud = uwlts.reconstruct(path, CALIBRATION, mount=known, trajectory=trajectory, clock_offset_s=offset)
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)


def test_a_trajectory_without_a_mount_is_the_sensor_s(tmp_path, expected):
    poses = np.array([platform_at(STEP_MM * time) for time in (0.0, 4.0)]) @ MOUNT
    trajectory = uwlts.Trajectory(np.array([0.0, 4.0]), poses)
    cloud = uwlts.reconstruct(record(tmp_path / "moving.h5"), CALIBRATION, trajectory=trajectory)
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)


def test_the_robot_s_scale_stretches_its_positions(tmp_path, expected):
    scale, path = 1.0005, tmp_path / "moving.h5"
    record(path)
    poses = np.array([platform_at(STEP_MM * time) for time in (0.0, 4.0)])
    poses[:, :3, 3] /= scale
    trajectory, known = uwlts.Trajectory(np.array([0.0, 4.0]), poses), mount_of(MOUNT, robot_scale=scale)
    cloud = uwlts.reconstruct(path, CALIBRATION, mount=known, trajectory=trajectory)
    np.testing.assert_allclose(cloud.points_mm, expected, atol=1e-8)


def test_a_mount_without_poses_is_refused(tmp_path):
    with pytest.raises(uwlts.Error, match="4 of 4 laser images have no pose.*trajectory"):
        uwlts.reconstruct(record(tmp_path / "stage.h5", stage=True), CALIBRATION, mount=mount_of(MOUNT))


def test_images_outside_the_trajectory_are_refused(tmp_path):
    trajectory = uwlts.Trajectory(np.array([1.0, 9.0]), np.array([platform_at(0.0), platform_at(8.0)]))
    with pytest.raises(uwlts.Error, match="1 of 4 times"):
        uwlts.reconstruct(record(tmp_path / "moving.h5"), CALIBRATION, trajectory=trajectory)


def test_the_mount_s_uncertainty_moves_points_as_other_mounts_do():
    """Against points that were calculated with 4000 mounts drawn by the covariance."""
    rng = np.random.default_rng(1)
    seen = rng.uniform([-40, -1, 150], [40, 1, 300], size=(30, 3))
    poses = np.array([platform_at(stage) for stage in rng.uniform(0, 500, 30)])
    poses[:, :3, :3] = Rotation.random(30, rng=rng).as_matrix()

    def points(transform):
        on_platform = seen @ transform[:3, :3].T + transform[:3, 3]
        return np.einsum("nij,nj->ni", poses[:, :3, :3], on_platform) + poses[:, :3, 3]

    drawn = []
    for step in rng.standard_normal((4000, 6)) * STD:
        other = MOUNT.copy()
        other[:3, 3] += step[:3]
        other[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ MOUNT[:3, :3]
        drawn.append(points(other))
    none = PointUncertainty(np.zeros((30, 6)), np.zeros((30, 3)), np.zeros((1, 30, 3)))
    found = with_mount(none, points(MOUNT), poses, mount_of(MOUNT)).covariance_mm2()
    # The standard deviation of 4000 is right to 1.1 %; 90 of them stay within five of those.
    np.testing.assert_allclose(np.sqrt(np.einsum("nii->ni", found)), np.std(drawn, axis=0), rtol=0.056)
