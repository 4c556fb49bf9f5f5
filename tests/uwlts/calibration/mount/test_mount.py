"""Mounts from simulated profiles: errors, coverage, wrong poses and background, missing motions, wrong conventions."""

import json

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import uwlts
from tests.uwlts.mount_views import (
    MOUNT,
    RADIUS_MM,
    SPHERE_MM,
    STANDOFF_MM,
    Campaign,
    errors_of,
    profile_of,
    sphere_campaign,
)
from uwlts.calibration.mount import restricted_likelihood
from uwlts.cli import main
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.model.mount import Mount, PlaneFound, SphereFound
from uwlts.shapes.flat import Circle
from uwlts.storage.mount_files import read_mount, read_profiles
from uwlts.storage.pose_files import read_poses


def mount_of(campaign: Campaign, **options) -> Mount:
    return uwlts.calibrate_mount(campaign.profiles, campaign.poses, **options)


def within(mount: Mount, *, factor: float = 5.0) -> None:
    """Errors are below ``factor`` standard uncertainties; one normal error in 1.7 million exceeds 5."""
    errors = np.concatenate(errors_of(mount.transform()))
    assert (np.abs(errors) < factor * mount.std()).all(), errors / mount.std()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20)


@pytest.mark.parametrize("radius", [RADIUS_MM, None])
def test_an_ideal_robot_gives_the_mount(rng, radius):
    mount = mount_of(sphere_campaign(rng, noise_mm=0.02), radius_mm=radius)
    within(mount)
    # What 15 poses are to give: 0.05 mm and 0.01 deg.
    assert (mount.std()[:3] < 0.05).all() and (np.degrees(mount.std()[3:]) < 0.01).all()
    assert isinstance(mount.artefact, SphereFound)
    assert mount.artefact.radius_mm == pytest.approx(RADIUS_MM, abs=0.02)
    assert mount.artefact.centre_mm == pytest.approx(SPHERE_MM, abs=0.1)
    assert all(pose.reason is None for pose in mount.poses)
    # Noise along z of 0.02 mm is less than that along the normals of an arc.
    assert 0.01 < mount.point_std_mm < 0.02
    assert mount.pose_std_mm < 0.01


def test_the_scatter_of_a_robot_is_found(rng):
    mount = mount_of(sphere_campaign(rng, poses=30, robot_mm=0.05), radius_mm=RADIUS_MM)
    within(mount)
    # 81 degrees of freedom: the standard deviation is known to 8 %, and six of these are far less likely than 1e-6.
    assert 0.5 < mount.pose_std_mm / 0.05 < 1.5
    assert mount.held_out_rms_mm < 0.1


def test_wrong_poses_and_empty_profiles_are_left_out(rng):
    campaign = sphere_campaign(rng, poses=18, robot_mm=0.05)
    campaign.poses[3, :3, 3] += (0.8, -0.5, 0.6)
    campaign.poses[7, :3, 3] += (30.0, 0.0, 0.0)
    campaign.profiles[11][:] = np.nan
    mount = mount_of(campaign, radius_mm=RADIUS_MM)
    within(mount)
    # One pose may be left out by chance (1 in 1000).
    reasons = {number for number, pose in enumerate(mount.poses) if pose.reason is not None}
    assert {3, 7, 11} <= reasons and len(reasons) < 6
    assert "no sphere found" in mount.poses[11].reason


def test_a_short_arc_is_fitted_by_its_distances(rng):
    """The least-squares circle by SciPy; the algebraic one has a smaller radius."""
    angle = rng.uniform(-0.4, 0.4, 80) + 1.1
    radius = 20.0 + 0.2 * rng.standard_normal(80)
    points = np.array([300.0, -70.0]) + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    fit = least_squares(
        lambda circle: np.linalg.norm(points - circle[:2], axis=1) - circle[2], [300, -70, 20], xtol=1e-12
    )
    found = Circle.fit(points)
    np.testing.assert_allclose(np.append(found.centre_mm, found.radius_mm), fit.x, atol=1e-4)


def least_scatter_mm(campaign: Campaign) -> float:
    """Return the rms distance from the sphere after SciPy's plain least squares, started at the true values."""
    seen = [np.isfinite(profile).all(axis=1) for profile in campaign.profiles]
    flat = np.vstack([profile[own] for profile, own in zip(campaign.profiles, seen, strict=True)])
    points = np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]])
    poses = np.repeat(campaign.poses, [np.count_nonzero(own) for own in seen], axis=0)

    def distances(values: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(values[3:6]).as_matrix() @ MOUNT[:3, :3]
        platform = points @ turn.T + MOUNT[:3, 3] + values[:3]
        base = np.einsum("nij,nj->ni", poses[:, :3, :3], platform) + poses[:, :3, 3]
        return np.linalg.norm(base - SPHERE_MM - values[6:9], axis=1) - RADIUS_MM - values[9]

    return float(np.sqrt(np.mean(least_squares(distances, np.zeros(10), x_scale="jac").fun ** 2)))


@pytest.mark.slow
def test_smooth_errors_of_the_profiler_are_weighed():
    """Profiles of 2,000 points have little noise and, as real ones, a larger smooth error of the profiler.

    If the points counted as independent, they would outweigh the robot, and the estimate would jump by millimetres.
    """
    campaign = sphere_campaign(
        np.random.default_rng([5, 0]),
        poses=24,
        noise_mm=0.009,
        robot_mm=0.05,
        smooth_mm=0.07,
        rays=2000,
        background=False,
    )
    mount = mount_of(campaign)
    within(mount)
    assert all(pose.reason is None for pose in mount.poses)
    # The optimum adapts to the errors a little more than any estimate that weighs them.
    assert mount.rms_mm < 1.1 * least_scatter_mm(campaign)
    # Halves of the poses differ by what both state, but for one in 10,000.
    halves = [uwlts.calibrate_mount(campaign.profiles[k::2], campaign.poses[k::2]) for k in range(2)]
    one, other = (half.transform() for half in halves)
    turn = Rotation.from_matrix(one[:3, :3] @ other[:3, :3].T).as_rotvec()
    apart = np.append(one[:3, 3] - other[:3, 3], turn)
    spread = sum(np.array(half.covariance) for half in halves)
    assert apart @ np.linalg.solve(spread, apart) < chi2.isf(1e-4, 6)


def test_a_plane_gives_the_mount(rng):
    mount = mount_of(sphere_campaign(rng, poses=24, plane_only=True), artefact_kind="plane")
    within(mount)
    assert isinstance(mount.artefact, PlaneFound)
    assert abs(mount.artefact.distance_mm) == pytest.approx(SPHERE_MM[2] - 1.1 * RADIUS_MM, abs=0.2)


@pytest.mark.slow
def test_a_plane_and_a_robot_that_scatters_give_the_mount():
    """The first steps reverse because the scatter changes; later steps must not remain damped."""
    campaign = sphere_campaign(np.random.default_rng([1, 3]), poses=24, plane_only=True, robot_mm=0.03)
    within(mount_of(campaign, artefact_kind="plane"))


def test_the_scale_of_a_robot_is_found(rng):
    mount = mount_of(sphere_campaign(rng, poses=25, scale=1.002), radius_mm=RADIUS_MM, scale=True)
    within(mount)
    assert abs(mount.robot_scale - 1.002) < 5 * mount.robot_scale_std
    assert mount.robot_scale_std < 3e-4


def test_a_time_offset_is_found(rng):
    """Profiles are stamped 0.04 s early on a smooth trajectory that is known every 2 ms."""
    nodes = sphere_campaign(rng, poses=30)
    stamped = np.arange(30) * 1.0
    times, poses = [], []
    for time, pose in zip(stamped, nodes.poses, strict=True):
        # About each pose the platform moves at 5 to 15 mm/s in a direction of its own, and turns.
        speed, spin = rng.uniform(-15, 15, 3), np.radians(rng.uniform(-5, 5, 3))
        for s in np.linspace(-0.1, 0.1, 101):
            moved = pose.copy()
            moved[:3, 3] += s * speed
            moved[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(s * spin).as_matrix()
            times.append(time + s)
            poses.append(moved)
    mount = uwlts.calibrate_mount(
        nodes.profiles,
        np.array(poses),
        radius_mm=RADIUS_MM,
        time=True,
        profile_times_s=stamped - 0.04,
        pose_times_s=np.array(times),
    )
    within(mount)
    assert abs(mount.time_offset_s - 0.04) < 5 * mount.time_offset_std_s + 1e-4
    assert mount.time_offset_std_s < 2e-3


def test_missing_turns_are_named(rng):
    with pytest.raises(CalibrationError, match=r"insufficient rotation about the platform's x axis .*Next pose to add"):
        mount_of(sphere_campaign(rng, tilt_deg=0.0), radius_mm=RADIUS_MM)


def test_missing_turns_are_named_if_the_estimate_does_not_converge(rng, monkeypatch):
    monkeypatch.setattr(restricted_likelihood, "_MOST_ROUNDS", 1)
    with pytest.raises(CalibrationError, match=r"insufficient rotation about the platform's x axis"):
        mount_of(sphere_campaign(rng, tilt_deg=0.0), radius_mm=RADIUS_MM)
    with pytest.raises(CalibrationError, match=r"does not converge: after 1 rounds"):
        mount_of(sphere_campaign(rng), radius_mm=RADIUS_MM)


def test_the_next_pose_lowers_the_uncertainty_as_said(rng):
    mount = mount_of(sphere_campaign(rng, poses=7, robot_mm=0.05), radius_mm=RADIUS_MM)
    assert mount.next_pose.after_mm < mount.next_pose.before_mm
    assert "turn the platform by" in mount.next_pose.words


@pytest.mark.parametrize(("radius", "says"), [(22.0, r"another radius, (19\.9|20\.0)"), (RADIUS_MM, "T_platform_base")])
def test_usual_mistakes_are_named(rng, radius, says):
    campaign = sphere_campaign(rng)
    poses = campaign.poses if radius != RADIUS_MM else np.linalg.inv(campaign.poses)
    with pytest.raises(CalibrationError, match=says):
        uwlts.calibrate_mount(campaign.profiles, poses, radius_mm=radius)


@pytest.mark.slow
@pytest.mark.parametrize("robot_mm", [0.0, 0.05])
def test_errors_are_as_large_as_stated(robot_mm):
    """Chi-square of six errors in six campaigns each, exceeded once in 10,000 runs: 77 for 36 degrees of freedom.

    Standard uncertainties that are too small by a factor of two make it 144.
    """
    square = 0.0
    for seed in range(6):
        campaign = sphere_campaign(np.random.default_rng([7, seed]), robot_mm=robot_mm)
        mount = mount_of(campaign, radius_mm=RADIUS_MM)
        errors = np.concatenate(errors_of(mount.transform()))
        # The coverage factor is Student's, so that scatter from few poses counts as well.
        covariance = np.array(mount.covariance) * (mount.coverage_factor / 1.96) ** 2
        square += errors @ np.linalg.solve(covariance, errors)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 36)
    assert low < square < high


def written(folder, campaign: Campaign, *, decimal: str = ".") -> None:
    """One CSV file for each pose, with empty cells where nothing was seen."""
    (folder / "profiles").mkdir()
    mark = ";" if decimal == "," else ","
    for number, profile in enumerate(campaign.profiles):
        rows = [
            mark.join("" if np.isnan(v) else f"{v:.5f}".replace(".", decimal) for v in row) for row in profile.tolist()
        ]
        # A side without points is long enough to hide the decimal commas from a look at the first lines.
        text = "\n".join([mark.join(("x [mm]", "z [mm]")), *[mark] * 200, *rows]) + "\n"
        (folder / "profiles" / f"pose-{number + 1}.csv").write_text(text)


@pytest.mark.parametrize("decimal", [".", ","])
def test_the_command_reads_another_makers_files(tmp_path, rng, capsys, monkeypatch, decimal):
    campaign = sphere_campaign(rng)
    written(tmp_path, campaign, decimal=decimal)
    quaternions = Rotation.from_matrix(campaign.poses[:, :3, :3]).as_quat(scalar_first=True)
    rows = np.column_stack([campaign.poses[:, :3, 3] / 1000, quaternions])
    np.savetxt(tmp_path / "poses.csv", rows, delimiter=",", fmt="%.9f", header="x,y,z,qw,qx,qy,qz", comments="")
    out = tmp_path / "mount.json"
    line = f"uwlts mount {tmp_path / 'profiles'} {tmp_path / 'poses.csv'} --pose-format quaternion-wxyz --pose-unit m"
    monkeypatch.setattr("sys.argv", [*line.split(), "--radius-mm", f"{RADIUS_MM}", "--out", str(out)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0, capsys.readouterr().err
    assert "poses used                15 of 15" in capsys.readouterr().out
    mount = read_mount(out)
    within(mount)
    assert len(mount.inputs) == 16 and json.loads(out.read_text())["format"] == "uwlts-mount"


def files_of(folder, campaign: Campaign):
    """Write the campaign as a table of profiles, and one of poses whose angles are about moved axes."""
    rows = [(n, *p) for n, profile in enumerate(campaign.profiles) for p in profile.tolist()]
    np.savetxt(folder / "all.csv", rows, delimiter="\t", header="pose\tx\tz", comments="")
    angles = Rotation.from_matrix(campaign.poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    np.savetxt(folder / "poses.txt", np.column_stack([campaign.poses[:, :3, 3], angles]), header="KUKA: X Y Z A B C")
    return folder / "all.csv", folder / "poses.txt"


def test_one_table_holds_all_profiles(tmp_path, rng):
    files = files_of(tmp_path, sphere_campaign(rng))
    within(uwlts.calibrate_mount(*files, pose_format="euler-ZYX-deg", radius_mm=20.0))
    with pytest.raises(DescriptionError, match="`profile_unit` describes files of profiles"):
        uwlts.calibrate_mount([np.zeros((20, 2))], np.eye(4)[None], profile_unit="m")


@pytest.mark.slow
def test_a_wrong_format_of_poses_is_named(tmp_path, rng):
    """As slow as the inverse poses of `test_usual_mistakes_are_named`."""
    with pytest.raises(CalibrationError, match="their format .Euler angles about moved axes, such as ZYX"):
        files = files_of(tmp_path, sphere_campaign(rng))
        uwlts.calibrate_mount(*files, pose_format="euler-zyx-deg", radius_mm=20.0)


TURN = Rotation.from_euler("zyx", [0.3, -0.2, 0.5])


@pytest.mark.parametrize(
    ("pose_format", "numbers"),
    [
        ("matrix", TURN.as_matrix()),
        ("quaternion-xyzw", TURN.as_quat()),
        ("quaternion-wxyz", TURN.as_quat(scalar_first=True)),
        ("rotvec-rad", TURN.as_rotvec()),
        ("euler-zyx-rad", [0.3, -0.2, 0.5]),
        ("euler-XYZ-deg", np.degrees([0.5, -0.2, 0.3])),
    ],
)
def test_poses_of_every_format(tmp_path, pose_format, numbers):
    shift = np.array([0.1, 0.2, 0.3])
    row = np.column_stack([numbers, shift]).ravel() if pose_format == "matrix" else np.append(shift, numbers)
    (tmp_path / "poses.csv").write_text(",".join(f"{value:.12f}" for value in row) + "\n")
    poses, times = read_poses(tmp_path / "poses.csv", pose_format=pose_format, unit="m")
    assert times is None
    # Turns about fixed axes in one order are those about moved axes in the other one.
    assert poses[0, :3, :3] == pytest.approx(TURN.as_matrix(), abs=1e-9)
    assert poses[0, :3, 3] == pytest.approx(1000 * shift)


@pytest.mark.parametrize(
    ("pose_format", "row", "says"),
    [
        ("matrix", "1,0,0,0,0,1,0,0,0,0,-1,0", "It is a reflection"),
        ("matrix", "1,0,0,0,0,1,0,0,0,0,1,0,5,6,7,1", "column by column"),
        ("matrix", "1,0,0,0", "4 columns of numbers"),
        ("quaternion-xyzw", "1,2,3,0.5,0.5,0.5,0.9", "length"),
        ("quaternion-xyzw", "1,2,3,0.5,0.5,0.5,nan", "not finite"),
        ("euler-zyx-rad", "1,2,3,90,0,0", "are they degrees"),
        ("euler-zz-rad", "1,2,3,1,0,0", "expected matrix, quaternion-xyzw"),
        ("rotvec-rad", "1,2,3,a,0,0\n1,2,3,a,0,0", "no table of numbers"),
    ],
)
def test_wrong_poses_are_refused_in_words(tmp_path, pose_format, row, says):
    (tmp_path / "poses.csv").write_text(row + "\n")
    with pytest.raises(DescriptionError, match=says):
        read_poses(tmp_path / "poses.csv", pose_format=pose_format)


def test_wrong_profiles_are_refused_in_words(tmp_path, rng):
    campaign = sphere_campaign(rng, poses=6)
    with pytest.raises(DescriptionError, match="6 profiles and 5 poses"):
        uwlts.calibrate_mount(campaign.profiles, campaign.poses[:5])
    with pytest.raises(CalibrationError, match="of 6 profiles show the sphere"):
        uwlts.calibrate_mount([p[:5] for p in campaign.profiles], campaign.poses)
    (tmp_path / "a.csv").write_text("x,depth\n1,2\n")
    with pytest.raises(DescriptionError, match="columns x, depth; expected x and z"):
        read_profiles(tmp_path)
    with pytest.raises(DescriptionError, match="no column 'pose'"):
        read_profiles(tmp_path / "a.csv")


def table_campaign(rng, *, angles, place=(14.0, 6.0, 30.0)):
    """Profiles of a sphere at a place on a table that turns by angles, and the table's frame in the sensor's (4, 4)."""
    table, sensor = np.eye(4), np.eye(4)
    table[:3, :3] = Rotation.from_euler("xyz", rng.uniform(-5, 5, 3), degrees=True).as_matrix()
    tilt = Rotation.from_euler("xyz", [60 + rng.uniform(-3, 3), *rng.uniform(-5, 5, 2)], degrees=True)
    sensor[:3, :3] = (Rotation.from_euler("x", np.pi) * tilt).as_matrix()
    sensor[:3, 3] = (table @ [0, 0, place[2], 1])[:3] - sensor[:3, :3] @ [0, 0, STANDOFF_MM]
    profiles = []
    for angle in angles:
        centre = table[:3, :3] @ Rotation.from_rotvec([0, 0, angle]).apply(place) + table[:3, 3]
        seen_from = sensor.copy()
        seen_from[:3, 3] += SPHERE_MM - centre
        profiles.append(profile_of(seen_from, rng, noise_mm=0.03, background=False))
    return profiles, np.linalg.inv(sensor) @ table


def axis_errors(mount, table):
    """Angle, rad, between the axis found and the true one, whose frame in the sensor's is given; distance there, mm."""
    found = np.linalg.inv(mount.transform())
    off = table[:3, 3] - found[:3, 3]
    off -= off @ table[:3, 2] * table[:3, 2]
    return float(np.arccos(min(1.0, found[:3, 2] @ table[:3, 2]))), float(np.linalg.norm(off))


def test_the_axis_of_a_rotary_table_is_found(tmp_path, rng):
    """Angle and distance have two coordinates each: beyond 5 standard deviations with a probability of 4e-6."""
    angles = np.radians(np.linspace(0, 345, 16))
    profiles, table = table_campaign(rng, angles=angles)
    np.savetxt(tmp_path / "angles.csv", np.degrees(angles), header="angle", comments="")
    poses, _ = read_poses(tmp_path / "angles.csv", pose_format="angle-deg")
    mount = uwlts.calibrate_mount(profiles, poses, radius_mm=RADIUS_MM, axis="-z")
    turn, shift = axis_errors(mount, table)
    std = mount.std()
    assert turn < 5 * np.linalg.norm(std[3:5]) < np.radians(0.2)
    assert shift < 5 * np.hypot(np.linalg.norm(std[:2]), STANDOFF_MM * np.linalg.norm(std[3:5])) < 1.0
    assert std[2] == std[5] == 0, "shift along the axis and turn about it are chosen"
    mount.save(tmp_path / "mount.json")
    assert read_mount(tmp_path / "mount.json") == mount
    # The same profiles fit the table that is mirrored in the sheet, y -> -y: its axis, an axial vector, is
    # (-x, y, -z), at 2 arccos |y| from the true one, apart from two errors of at most 5 standard deviations.
    mirrored = uwlts.calibrate_mount(profiles, poses, radius_mm=RADIUS_MM, axis="z")
    assert mirrored.rms_mm == pytest.approx(mount.rms_mm, rel=0.01)
    apart = 2 * np.arccos(abs(table[1, 2]))
    assert axis_errors(mirrored, table)[0] == pytest.approx(apart, abs=2 * 5 * np.linalg.norm(std[3:5]))


def test_poses_that_are_no_turns_of_a_table_are_refused(rng):
    campaign = sphere_campaign(rng, poses=6)
    with pytest.raises(DescriptionError, match="not rotations about one z axis"):
        uwlts.calibrate_mount(campaign.profiles, campaign.poses, radius_mm=RADIUS_MM, axis="z")
