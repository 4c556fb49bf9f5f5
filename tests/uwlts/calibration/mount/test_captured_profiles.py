"""Effect of a sensor's calibration on a mount and on points along a path, compared with changed calibrations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import uwlts
from tests.uwlts.calibration.mount.test_hand_eye import CAMERA, MIDDLE, simulated
from tests.uwlts.calibration_views import WATER
from tests.uwlts.drawn_stripes import SENSOR, step_image, write
from tests.uwlts.joint_views import MEDIUM
from tests.uwlts.mount_views import errors_of
from tests.uwlts.sensor_profiles import RADIUS_MM, captured_by, half_way, joint_estimate, largest_parts
from uwlts.calibration.mount.captured_profiles import reconstruct_profiles
from uwlts.calibration.mount.hand_eye import BoardEvidence
from uwlts.calibration.mount.restricted_likelihood import RestrictedEstimate, solve_step
from uwlts.calibration.sequential.sheet_fit import object_frame
from uwlts.errors import DescriptionError
from uwlts.fitting.next_observation import CovarianceRoot
from uwlts.model.calibration import calibration_digest
from uwlts.model.sensor import Medium
from uwlts.optics.nominal import nominal_calibration
from uwlts.reconstruction.moving import PlatformPoses, add_platform_uncertainty
from uwlts.reconstruction.point_uncertainty import point_uncertainty
from uwlts.storage.capture import Capture, CaptureHeader, FrameTable


@pytest.fixture(scope="module")
def known(thesis):
    return joint_estimate(thesis)


@pytest.fixture(scope="module")
def captured(known):
    return captured_by(known, known.values, np.random.default_rng(1))


@pytest.fixture(scope="module")
def mount(captured):
    return uwlts.calibrate_mount(captured, radius_mm=RADIUS_MM)


def test_a_mount_follows_the_sensor_as_its_derivatives_say(known, captured, mount):
    """Against mounts from the same stripes by other calibrations; second order and iteration leave less than 2 %."""
    by = np.array(mount.sensor.by_parameters)
    for part in largest_parts(known, by, count=2):
        found = []
        for sign in (1, -1):
            other = replace(known, values=known.values + sign * part)
            profiles = [other.triangulate(*stripes.T)[0] for stripes in captured.stripes]
            found.append(uwlts.calibrate_mount(replace(captured, profiles=profiles), radius_mm=RADIUS_MM).transform())
        moved, std = half_way(*found), mount.std()
        assert np.linalg.norm(moved / std) > 0.3, "a part that matters"
        np.testing.assert_allclose(by @ part[: by.shape[1]] / std, moved / std, atol=0.02 * np.linalg.norm(moved / std))


def test_poses_of_a_table_replace_those_of_the_capture(tmp_path):
    medium, image = Medium(kind="custom", index=WATER), step_image(20.0, height_mm=12.0, count=60)
    path = write(tmp_path / "step.h5", [image] * 2)
    given = np.tile(np.eye(4), (3, 1, 1))
    with Capture(path) as capture:
        with pytest.raises(DescriptionError, match="2 of 2 laser images of step.h5 have no platform pose"):
            reconstruct_profiles(capture, nominal_calibration(SENSOR, medium), None, None)
        found = reconstruct_profiles(capture, nominal_calibration(SENSOR, medium), given, np.arange(3.0))
    assert found.poses is given and found.pose_times_s == pytest.approx([0, 1, 2])
    for profile in found.profiles:
        # The mean of half a hundred points with noise of some 0.1 mm each; the block is nearer.
        on_block, on_base = np.abs(profile[:, 1]) < 25, np.abs(profile[:, 1]) > 35
        assert np.median(profile[on_base, 2]) - np.median(profile[on_block, 2]) == pytest.approx(12.0, abs=0.1)


@pytest.mark.slow
def test_intervals_hold_for_sensors_that_differ_from_their_calibration(known):
    """Sensors drawn from the covariance: chi-square of six for each, beyond the limits once in 10^6 (both sides).

    Without the sensor's part the errors are hundreds of times larger than stated.
    """
    excess, apart = [], []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        values = rng.multivariate_normal(known.values, known.covariance, method="svd")
        found = uwlts.calibrate_mount(captured_by(known, values, rng), radius_mm=RADIUS_MM)
        off = np.concatenate(errors_of(found.transform()))
        excess.append(off @ np.linalg.solve(np.array(found.covariance), off))
        apart.append(off @ np.linalg.solve(np.array(found.sensor.covariance_apart), off))
    low, high = chi2.isf([1 - 5e-7, 5e-7], 6 * len(excess))
    assert low < np.sum(excess) < high
    assert np.median(apart) > 100


def test_points_do_not_count_the_sensor_twice(known, thesis, captured, mount):
    """The patterns predict the change of points along a path for another calibration and its mount."""
    number, by = 0, np.array(mount.sensor.by_parameters)
    line, centre = np.tile(np.arange(300, 900), 2), np.repeat([450.0, 620.0], 600)
    header = CaptureHeader(
        name="scan",
        sensor=thesis,
        medium_name="water",
        medium=MEDIUM,
        stage_direction=(1.0, 0.0, 0.0),
        saturation_dn=255,
        T_platform_sensor=mount.T_platform_sensor,
    )
    pose, frame = captured.poses[number], np.repeat([0, 1], 600)
    poses = np.array([pose, pose])
    table = FrameTable(header, Path("scan"), np.zeros(2), np.ones(2), poses, np.zeros(2))
    noisy = centre + 0.1 * np.random.default_rng(2).standard_normal(len(line))
    apart, common = mount.independent_covariance(calibration_digest(known.calibration))
    assert common is not None and mount.independent_covariance("another")[1] is None

    def points(values, step):
        seen, _ = replace(known, values=values).triangulate(line, noisy)
        turn = Rotation.from_rotvec(step[3:]).as_matrix() @ mount.transform()[:3, :3]
        on_platform = seen @ turn.T + mount.transform()[:3, 3] + step[:3]
        return on_platform @ pose[:3, :3].T + pose[:3, 3]

    moved = []
    for part in CovarianceRoot.from_covariance(known.covariance).root.T:
        ends = (points(known.values + sign * part, sign * by @ part[: by.shape[1]]) for sign in (1, -1))
        moved.append(np.subtract(*ends) / 2)
    expected = np.sqrt(np.sum(np.square(moved), axis=0))
    shared = point_uncertainty(table, known.calibration, (frame, line, noisy), mount_by=common)
    by_patterns = np.sqrt(np.sum(shared.patterns_mm.astype(float) ** 2, axis=0))
    # Second order of the errors, and patterns of 0.05 um that are left out.
    np.testing.assert_allclose(by_patterns, expected, rtol=0.02, atol=2e-4)
    ride, base = PlatformPoses(poses, None, np.zeros(2)), points(known.values, np.zeros(6))
    together = add_platform_uncertainty(shared, base, frame, ride, mount, mount_covariance=apart).std_mm()
    alone = point_uncertainty(table, known.calibration, (frame, line, noisy), mount_by=np.zeros((6, 0)))
    twice = add_platform_uncertainty(alone, base, frame, ride, mount).std_mm()
    # At the place of the mount's calibration, the mount compensates the change of the calibration: the sphere stays.
    assert np.median(together) < 0.5 * np.median(twice)

    def points_from_true_frame(values):
        """Return the points that a described mount and the poses place by the sensor's frame of other parameters."""
        in_camera = replace(known, values=values).triangulate(line, noisy)[0] @ here[:3, :3].T + here[:3, 3]
        sheet = known.parameters.sheet_model(values)
        there = object_frame(sheet, laser_axis=known.parameters.sheet.axis)
        on_platform = (in_camera - there[:3, 3]) @ there[:3, :3] @ mount.transform()[:3, :3].T
        return on_platform @ pose[:3, :3].T

    here, moved = known.calibration.object_transform(), []
    for part in CovarianceRoot.from_covariance(known.covariance).root.T:
        moved.append(np.subtract(*(points_from_true_frame(known.values + sign * part) for sign in (1, -1))) / 2)
    described = point_uncertainty(table, known.calibration, (frame, line, noisy)).patterns_mm.astype(float)
    expected = np.sqrt(np.sum(np.square(moved), axis=0))
    np.testing.assert_allclose(np.sqrt(np.sum(described**2, axis=0)), expected, rtol=0.02, atol=2e-4)


def test_a_mount_by_a_target_follows_its_images():
    """Each image's pose moves by a random matrix times a number; the solution by the derivative, to second order."""
    rng = np.random.default_rng(3)
    by = [np.diag([0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3]) @ rng.standard_normal((6, 1)) for _ in range(12)]
    images = [replace(each, by_sensor=own) for each, own in zip(simulated(rng), by, strict=True)]
    problem, scatter = BoardEvidence(images, CAMERA, MIDDLE), np.array([1.0, 0.05, 3e-4])

    def solved(evidence, state):
        for _ in range(3):
            state = evidence.apply_step(
                state, solve_step(evidence, state, evidence.covariance(state)(np.log(scatter))[0])
            )
        return state

    state = solved(problem, problem.start())
    ends = []
    for size in (0.1, -0.1):
        moved = []
        for image, own in zip(images, by, strict=True):
            step, seen = size * own[:, 0], image.camera_from_target.copy()
            place = seen[:3, :3] @ MIDDLE + seen[:3, 3] + step[:3]
            seen[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix() @ seen[:3, :3]
            seen[:3, 3] = place - seen[:3, :3] @ MIDDLE
            moved.append(replace(image, camera_from_target=seen))
        ends.append(solved(BoardEvidence(moved, CAMERA, MIDDLE), state)[0])
    expected, found = (
        half_way(*ends) / 0.1,
        RestrictedEstimate(problem, state, scatter).propagate(problem.residual_derivatives(state))[:6, 0],
    )
    size = np.repeat([np.linalg.norm(expected[:3]), np.linalg.norm(expected[3:])], 3)
    np.testing.assert_allclose(found / size, expected / size, atol=0.02)
