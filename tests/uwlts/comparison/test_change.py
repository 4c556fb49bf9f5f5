"""Change between clouds: false positives, detected changes, and coordinates that a registration does not determine."""

import json
from dataclasses import replace

import laspy
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.cli import app
from uwlts.comparison.change import SurfaceChange, _estimate_areas, _thin_points
from uwlts.comparison.change_reference import (
    IdealCylinder,
    IdealPlane,
    IdealSphere,
    place_shape,
    read_reference,
    sample_mesh,
)
from uwlts.comparison.local_means import ComparisonOptions
from uwlts.errors import CaptureError, DescriptionError, EvaluationError, OutputError
from uwlts.fitting.local_surface import number_cubes
from uwlts.registration.surface_registration import SurfaceSample, register_to_surface
from uwlts.storage.cloud import STEP, WATER, PointCloud, PointUncertainty
from uwlts.storage.ply import read_ply

NOISE_MM, SHIFT_MM, TILT, STAGE_MM = 0.03, 0.04, 1e-3, 0.02
SIDE_MM, STEP_MM = 60.0, 0.5


def height(x, y):
    """Return the height of a surface without symmetry: every motion changes it."""
    return 2.0 * np.sin(x / 9.0) + 1.5 * np.cos(y / 7.0) + 0.01 * x * y / 5


def dent(x, y):
    return 0.5 * (np.hypot(x - 10, y - 5) < 5)


def scanned(rng, *, change=None, common=True, surface=height, calibration=None):
    """Return a cloud scanned in lines by a stage, with errors as stated.

    ``calibration`` are the errors (3,) of water, shift and tilt by one calibration, in standard deviations.
    """
    x, y = np.meshgrid(np.arange(-SIDE_MM / 2, SIDE_MM / 2, STEP_MM), np.arange(-SIDE_MM / 2, SIDE_MM / 2, STEP_MM))
    image = np.repeat(np.arange(x.shape[1])[None], x.shape[0], axis=0).ravel()
    x, y = (each.ravel() + rng.uniform(-0.2, 0.2, x.size) for each in (x, y))
    points = np.column_stack([x, y, surface(x, y) + (0.0 if change is None else change(x, y))])
    count = len(points)
    patterns = np.zeros((2, count, 3), np.float32)
    patterns[0, :, 2], patterns[1, :, 2] = SHIFT_MM, TILT * y
    if not common:
        patterns[:] = 0
    position = np.zeros((count, 3), np.float32)
    position[:, 2] = STAGE_MM
    random = np.zeros((count, 6), np.float32)
    random[:, 5] = NOISE_MM**2
    seen = points.copy()
    seen[:, 2] += NOISE_MM * rng.normal(size=count) + STAGE_MM * rng.normal(size=image.max() + 1)[image]
    errors, shared = rng.normal(size=2), {}
    if calibration is not None:
        # The patterns are any independent ones: here shift and tilt, each partly by the water.
        shares = np.array([[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
        errors, shared = shares @ calibration, {f"{WATER} 1": shares[:, :1], "sensor 1": shares[:, 1:]}
    seen[:, 2] += np.tensordot(errors, patterns[:, :, 2], axes=1)
    known = PointUncertainty(random, position, patterns, shared=shared)
    return PointCloud(seen, np.ones(count), image, np.zeros(count, int), uncertainty=known)


@pytest.mark.slow
def test_nothing_is_claimed_where_nothing_changed():
    """Over many pairs distances scatter by the level over 1.96, common errors included."""
    rng = np.random.default_rng(2)
    shares, ratios = [], []
    for _ in range(8):
        change = uwlts.compare_clouds(scanned(rng), scanned(rng), disc_mm=6.0)
        assert change.compared.mean() > 0.95
        shares.append(change.significant[change.compared].mean())
        ratios.append(1.96 * change.distance_mm[change.compared] / change.level_mm[change.compared])
    # Errors common to all points make the fractions of single pairs scatter widely about 5 %.
    assert np.mean(shares) < 0.12
    assert 0.6 < np.sqrt(np.mean(np.square(np.concatenate(ratios)))) < 1.5
    quiet = [uwlts.compare_clouds(scanned(rng, common=False), scanned(rng, common=False)) for _ in range(2)]
    claimed = np.mean([share(each) for each in quiet])
    assert 0.005 < claimed < 0.08


def test_what_one_calibration_shares_cancels():
    """The levels are those by hand, within what the scatter in discs of 30 points leaves of their median."""
    rng = np.random.default_rng(4)
    calibration = rng.normal(size=3)
    cloud, other = (scanned(rng, calibration=calibration) for _ in range(2))
    renamed = {name.replace("1", "2"): parts for name, parts in other.uncertainty.shared.items()}
    foreign = replace(other, uncertainty=replace(other.uncertainty, shared=renamed))
    quiet = uwlts.compare_clouds(*(scanned(rng, common=False) for _ in range(2)))
    found = [
        uwlts.compare_clouds(cloud, *pair, same_water=same)
        for pair, same in (((other,), True), ((other,), False), ((foreign,), True))
    ]
    random = np.median(quiet.level_mm[quiet.compared]) / 1.96
    tilted = 2 * (TILT * found[2].points_mm[:, 1]) ** 2
    expected = [0.0, 2 * (0.6 * SHIFT_MM) ** 2, 2 * SHIFT_MM**2 + tilted]
    for change, common in zip(found, expected, strict=True):
        ratio = change.level_mm / 1.96 / np.sqrt(random**2 + common)
        assert np.median(ratio[change.compared]) == pytest.approx(1.0, abs=0.05)
    # A twentieth of the places and as much again for chance: a disc holds 30 points, so that places are a thousand.
    assert share(found[0]) < 0.1
    one = uwlts.compare_clouds(scanned(rng, calibration=calibration, change=shallow), other, same_water=True)
    x, y = one.points_mm.T[:2]
    assert one.significant[np.hypot(x - 10, y - 5) < 4].mean() > 0.8
    assert found[2].significant.mean() < 0.02


def shallow(x, y):
    return 0.05 * (np.hypot(x - 10, y - 5) < 6)


def share(change):
    """Return the fraction of the area with a significant change."""
    return np.average(change.significant[change.compared], weights=change.area_mm2[change.compared])


@pytest.mark.slow
def test_a_registration_takes_up_what_looks_like_a_movement():
    """Common shift and tilt no longer count, and the claimed fraction is at most the 5 % of the level."""
    rng = np.random.default_rng(12)
    pairs = [(scanned(rng), scanned(rng)) for _ in range(4)]
    found = [uwlts.compare_clouds(*pair, register=True) for pair in pairs]
    plain = uwlts.compare_clouds(*pairs[0])
    # Noise and images have 0.03 mm, shift and tilt of both clouds 0.1 mm more.
    assert np.median(found[0].level_mm) < 0.5 * np.median(plain.level_mm)
    # Neighbouring places share their images; therefore the fraction of one pair has a standard deviation of 2 %.
    assert np.mean([share(each) for each in found]) < 0.05 + 3 * 0.02 / np.sqrt(4)


def tube(x, y):
    """A pipe of 300 mm diameter, seen from outside."""
    return 150.0 - np.sqrt(150.0**2 - x**2)


@pytest.mark.parametrize(
    ("reference", "surface"), [("plane", lambda x, y: 0 * x), ("cylinder", tube)], ids=["plane", "cylinder"]
)
def test_an_ideal_shape_is_fitted(reference, surface):
    rng = np.random.default_rng(13)
    quiet = uwlts.compare_clouds(scanned(rng, surface=surface), reference)
    assert quiet.registration is None and share(quiet) < 0.05 + 3 * 0.02
    dented = uwlts.compare_clouds(scanned(rng, surface=surface, change=dent), reference)
    x, y, _ = dented.points_mm.T
    inside = np.hypot(x - 10, y - 5) < 3
    assert dented.significant[inside].mean() > 0.95
    region = dented.regions()[0]
    assert np.hypot(region.centre_mm[0] - 10, region.centre_mm[1] - 5) < 1
    # 0.5 mm over a disc of 5 mm radius; the discs of 30 points blur its rim.
    assert region.volume_mm3 == pytest.approx(-0.5 * np.pi * 5**2, rel=0.15)
    assert reference in dented.reference


def test_a_given_shape_is_taken_as_it_is(ball, tmp_path):
    _, cloud = ball
    (tmp_path / "ball.toml").write_text('kind = "sphere"\ndiameter_mm = 49.9\npoint_mm = [0, 0, 0.02]\n')
    given = uwlts.compare_clouds(cloud, tmp_path / "ball.toml")
    far = given.compared & (given.points_mm[:, 2] < -15) & (np.hypot(*given.points_mm[:, :2].T) > 6)
    z = given.points_mm[far, 2] / 25.0
    # The cloud's centre is 0.02 mm before the sphere's, its radius is 0.05 mm larger; means of 30 points of 0.02 mm.
    assert np.mean(given.distance_mm[far] - (0.05 - 0.02 * z)) == pytest.approx(0, abs=0.003)
    (tmp_path / "ball.toml").write_text('kind = "sphere"\ndiameter_mm = 50.0\npoint_mm = [0, 0, 0.2]\n')
    moved = uwlts.compare_clouds(cloud, tmp_path / "ball.toml", register=True)
    # Rotations about the sphere's centre are undetermined; 5,000 points of 0.02 mm, the bump gets zero weight.
    centre = moved.registration.transform[:3] @ [0, 0, 0, 1]
    np.testing.assert_allclose(centre, [0, 0, 0.2], atol=0.005)
    for text in ('kind = "sphere"\npoint_mm = [0, 0, 0]\n', 'kind = "cone"\n', "kind = \n"):
        (tmp_path / "wrong.toml").write_text(text)
        with pytest.raises(DescriptionError, match="wrong.toml"):
            uwlts.compare_clouds(cloud, tmp_path / "wrong.toml")


def test_datums_hold_the_registration(tmp_path):
    """Half of the surface has moved up; datums on the other half keep that half where it was."""
    rng = np.random.default_rng(14)
    before = scanned(rng, common=False)
    after = scanned(rng, common=False, change=lambda x, y: -0.4 * (x > 0))
    datums = tmp_path / "datums.toml"
    datums.write_text("".join(f"[[datum]]\ncentre_mm = [-16, {y}, 0]\nradius_mm = 12\n" for y in (-15, 15)))
    held = uwlts.compare_clouds(after, before, register=True, datums=datums)
    x = held.points_mm[:, 0]
    assert np.nanmedian(held.distance_mm[x > 3]) == pytest.approx(0.4, abs=0.08)
    assert abs(np.nanmedian(held.distance_mm[x < -3])) < 0.02
    with pytest.raises(EvaluationError, match="`register`"):
        uwlts.compare_clouds(after, before, datums=datums)
    datums.write_text("[[datum]]\ncentre_mm = [-16, 0, 0]\nradius_mm = -1\n")
    with pytest.raises(DescriptionError, match="radius_mm"):
        uwlts.compare_clouds(after, before, register=True, datums=datums)


def test_a_dent_is_found():
    rng = np.random.default_rng(4)
    change = uwlts.compare_clouds(scanned(rng, change=dent), scanned(rng))
    x, y, _ = change.points_mm.T
    inside = np.hypot(x - 10, y - 5) < 3
    assert change.significant[inside].mean() > 0.95
    # Positive towards the sensor, so that a loss is negative.
    assert np.median(change.distance_mm[inside]) == pytest.approx(-0.5, abs=0.2)
    assert change.record()["largest_loss_mm"] < -0.4
    assert change.regions()[0].largest_mm < -0.4


def test_a_moved_cloud_is_registered():
    rng = np.random.default_rng(5)
    before, after = scanned(rng, common=False), scanned(rng, common=False, change=dent)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.4], degrees=True).as_matrix()
    moved = PointCloud(after.points_mm @ turn.T + [0.4, -0.3, 0.2], after.intensity, after.frame, after.line)
    change = uwlts.compare_clouds(moved, before, register=True)
    found = change.registration
    assert found.open_directions == ()
    back = found.transform @ np.block([[turn, np.array([[0.4], [-0.3], [0.2]])], [np.zeros((1, 3)), np.ones((1, 1))]])
    assert np.linalg.norm(back[:3, 3]) < 0.1 and Rotation.from_matrix(back[:3, :3]).magnitude() < np.radians(0.1)
    x, y, _ = change.points_mm.T
    assert change.significant[np.hypot(x - 10, y - 5) < 3].mean() > 0.9
    assert change.significant[change.compared & (np.hypot(x - 10, y - 5) > 8)].mean() < 0.12


def test_what_a_shape_does_not_tell_is_left_as_it_was():
    rng = np.random.default_rng(6)
    before, after = scanned(rng, common=False, surface=tube), scanned(rng, common=False, surface=tube)
    shifted = PointCloud(after.points_mm + [0.0, 0.6, 0.2], after.intensity, after.frame, after.line)
    found = uwlts.compare_clouds(shifted, before, register=True).registration
    assert "shift along y" in {name for words in found.open_directions for name in words.split(" with ")}
    assert abs(found.transform[1, 3]) < 0.05 and found.transform[2, 3] == pytest.approx(-0.2, abs=0.05)


def profiles(rng, ends):
    """Return a curved surface in dense profiles every 1 mm, with noise shared by three neighbours."""
    x, y = np.meshgrid(np.arange(*ends, 1.0), np.arange(-15, 15, 0.15), indexing="ij")
    drawn = rng.standard_normal((x.shape[0], x.shape[1] + 2))
    noise = NOISE_MM * (drawn[:, :-2] + drawn[:, 1:-1] + drawn[:, 2:]) / np.sqrt(3)
    points = np.column_stack([x.ravel(), y.ravel(), (0.02 * y**2 + noise).ravel()])
    return PointCloud(points, np.ones(x.size), np.repeat(np.arange(len(x)), x.shape[1]), np.arange(x.size))


def test_nothing_is_claimed_beyond_the_reference_or_of_shared_noise():
    """Beside the border of the reference, its nearest points are on a line and do not define a normal."""
    rng = np.random.default_rng(8)
    change = uwlts.compare_clouds(profiles(rng, (-40, 40)), profiles(rng, (-20, 20)))
    assert np.abs(change.points_mm[change.compared, 0]).max() < 24
    assert np.abs(change.distance_mm[change.compared]).max() < 0.2
    # About 1,500 places, where ten neighbours share their points: 5 % scatter by 2 %; without the factor it is 25 %.
    assert change.significant[change.compared].mean() < 0.12


def test_too_far_apart_is_refused():
    points = np.random.default_rng(0).uniform(0, 10, (2000, 3)) * [1, 1, 0]
    with pytest.raises(EvaluationError, match="same frame and unit"):
        register_to_surface(SurfaceSample(points + [0, 0, 50]), SurfaceSample(points), reach_mm=2)


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A sphere of 50 mm diameter as an STL file, and a cloud of its side before the sensor with a 0.3 mm bump."""
    path = tmp_path_factory.mktemp("mesh") / "ball.stl"
    trimesh.creation.icosphere(subdivisions=6, radius=25.0).export(path)
    rng = np.random.default_rng(7)
    direction = rng.normal(size=(20000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction[direction[:, 2] < -0.5]
    bump = 0.3 * (np.degrees(np.arccos(-direction[:, 2])) < 8)
    radius = 25.0 + bump + 0.02 * rng.normal(size=len(direction))
    count = len(direction)
    cloud = PointCloud(direction * radius[:, None], np.ones(count), np.zeros(count, int), np.arange(count))
    return path, cloud


def test_a_mesh_is_a_reference(ball):
    path, cloud = ball
    change = uwlts.compare_clouds(cloud, path)
    angle = np.degrees(np.arccos(-change.points_mm[:, 2] / np.linalg.norm(change.points_mm, axis=1)))
    assert np.median(change.distance_mm[angle < 5]) == pytest.approx(0.3, abs=0.03)
    assert change.significant[angle < 5].mean() > 0.95
    far = change.compared & (angle > 14) & (angle < 50)
    assert abs(np.median(change.distance_mm[far])) < 0.01 and change.significant[far].mean() < 0.15


def test_wrong_references_are_refused(ball, tmp_path):
    path, cloud = ball
    small = tmp_path / "metres.stl"
    trimesh.load(path).apply_scale(0.001).export(small)
    with pytest.raises(EvaluationError, match="`reference_unit` m"):
        uwlts.compare_clouds(cloud, small)
    assert uwlts.compare_clouds(cloud, small, reference_unit="m").compared.any()
    (tmp_path / "text.stl").write_text("no mesh")
    with pytest.raises(CaptureError, match="text.stl"):
        uwlts.compare_clouds(cloud, tmp_path / "text.stl")
    away = PointCloud(cloud.points_mm + [0, 0, 200], cloud.intensity, cloud.frame, cloud.line)
    with pytest.raises(EvaluationError, match="do not overlap"):
        uwlts.compare_clouds(away, path)
    with pytest.raises(EvaluationError, match="`?disc_mm`? is -1"):
        uwlts.compare_clouds(cloud, path, disc_mm=-1.0)
    few = PointCloud(cloud.points_mm[:9], cloud.intensity[:9], cloud.frame[:9], cloud.line[:9])
    with pytest.raises(EvaluationError, match="the cloud has 9 points"):
        uwlts.compare_clouds(few, path)


@pytest.mark.slow
def test_the_command_writes_page_figures_and_cloud(ball, tmp_path, monkeypatch):
    path, cloud = ball
    cloud.save(tmp_path / "ball.ply")
    monkeypatch.chdir(tmp_path)
    words = ["compare", "ball.ply", str(path), "--out", "change.html", "--coloured", "change.ply"]
    app(words, result_action="return_value")
    change = uwlts.compare_clouds(cloud, path)
    uwlts.report.write_change("again.html", change, coloured="change.laz")
    record = json.loads((tmp_path / "change.json").read_text())
    assert record["largest_rise_mm"] == pytest.approx(0.3, abs=0.05) and record["registration"] is None
    places, _ = read_ply(tmp_path / "change.ply", "vertex", called="cloud")
    assert set(places.dtype.names) >= {"x", "y", "z", "distance", "level", "significant"}
    # Grey where nothing changed, else red below and blue above, as on the map.
    seen = np.asarray(trimesh.load(tmp_path / "change.ply").colors, int)[:, :3]
    compared, changed = np.isfinite(places["distance"]), places["significant"] == 1
    assert changed.sum() > 20
    assert (seen[compared & ~changed] == 0xCC).all()
    assert np.array_equal((seen[changed, 2] > seen[changed, 0]), places["distance"][changed] > 0)
    assert places["significant"].mean() == pytest.approx(record["significant_share"], abs=0.2)
    table = laspy.read(tmp_path / "change.laz")
    np.testing.assert_allclose(1e3 * np.column_stack([table.x, table.y, table.z])[:, 0], places["x"], atol=1e-3)
    np.testing.assert_array_equal(np.column_stack([table.red, table.green, table.blue]), 257 * seen)
    np.testing.assert_array_equal(table["significant"], places["significant"])
    page = (tmp_path / "change.html").read_text()
    assert "level of detection" in page and "ball.ply against ball.stl" in page
    with pytest.raises(OutputError, match="exists already"):
        uwlts.report.write_change("change.html", change)


def test_all_regions_are_listed_whatever_the_size_of_the_cloud(monkeypatch, tmp_path):
    """25 losses of one size on a cloud so large that only every fourth place is examined."""
    rng = np.random.default_rng(31)
    x, y = np.meshgrid(np.arange(200.0), np.arange(200.0), indexing="ij")
    frame, line = np.indices(x.shape)
    middles = 20.0 + 40.0 * np.indices((5, 5)).reshape(2, -1).T
    lost = np.any([np.hypot(x - a, y - b) < 13 for a, b in middles], axis=0)

    def seen(depth):
        points = np.column_stack([x.ravel(), y.ravel(), (depth + 0.01 * rng.normal(size=x.shape)).ravel()])
        return PointCloud(points, np.ones(x.size), frame.ravel(), line.ravel())

    monkeypatch.setattr("uwlts.comparison.change.OPTIONS", ComparisonOptions(most_places=1000))
    change = uwlts.compare_clouds(seen(0.5 * lost), seen(0.0 * lost))
    assert 500 < len(change.distance_mm) <= 1000
    regions = [region for region in change.regions() if region.mean_mm < -0.1]
    assert len(regions) == 25
    for region in regions:
        assert np.min(np.hypot(*(middles - region.centre_mm[:2]).T)) < change.apart_mm
        # The disc about a place at the border holds a part of the loss, too.
        assert region.area_mm2 == pytest.approx(np.pi * 16**2, rel=0.35)
    uwlts.report.write_change(tmp_path / "change.html", change)
    assert "more regions of smaller volume" in (tmp_path / "change.html").read_text(encoding="utf-8")
    assert len(json.loads((tmp_path / "change.json").read_text())["regions"]) == len(change.regions())
    assert any(line.startswith("regions of change") for line in change.lines())


def test_thinning_needs_few_rounds(monkeypatch):
    """One place too many at a side of half the spacing: 36 rounds of 2 %, 1,400 if the side grew by the excess."""
    rounds = []
    monkeypatch.setattr("uwlts.comparison.change.OPTIONS", ComparisonOptions(most_places=1000))
    monkeypatch.setattr(
        "uwlts.comparison.change.number_cubes", lambda *given: rounds.append(given) or number_cubes(*given)
    )
    points = np.column_stack([np.arange(1001.0), np.zeros((1001, 2))])
    chosen, apart = _thin_points(points, 0.5)
    assert len(chosen) <= 1000 and 1.0 < apart < 1.03
    assert 10 < len(rounds) < 50


def stored(depth, step):
    """Return a plane at a depth in points every 1 mm, without noise, in coordinates rounded to a step."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(30.0), np.arange(30.0)))
    points = np.column_stack([x, y, np.full(x.size, depth)])
    return PointCloud(points, np.ones(x.size), x.astype(int), y.astype(int), metadata={STEP: step})


def test_rounded_coordinates_limit_the_level():
    """Uniform errors of 0.3 and 0.4 mm width: variances of a twelfth of the squares, which no mean reduces."""
    change = uwlts.compare_clouds(stored(99.0, 0.3), stored(100.0, 0.4), disc_mm=4.0)
    np.testing.assert_allclose(change.level_mm, 1.96 * 0.5 / np.sqrt(12), rtol=1e-9)
    np.testing.assert_allclose(change.distance_mm, 1.0, atol=1e-9)
    assert change.significant.all()


def test_a_cloud_in_metres_is_scaled_and_one_with_uncertainty_refused():
    cloud = stored(100.0, 0.4)
    read = read_reference(cloud, unit="m", disc_mm=4.0)
    np.testing.assert_allclose(read.points_mm, 1000 * cloud.points_mm)
    assert read.rounding_std_mm == pytest.approx(400 / np.sqrt(12))
    known = scanned(np.random.default_rng(1))
    assert read_reference(known, unit="mm", disc_mm=4.0).uncertainty is known.uncertainty
    with pytest.raises(EvaluationError, match="the unit is m, but clouds with uncertainty are always in mm"):
        read_reference(known, unit="m", disc_mm=4.0)


def test_samples_of_a_mesh_are_even():
    """Covariance of a uniform triangle: a twelfth of the sum of the corners' squares about the centroid."""
    corners = np.array([[0.0, 0, 0], [8, 0, 0], [2, 6, 3], [8, 6, 40]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    area = np.array([np.linalg.norm(np.cross(b - a, c - a)) / 2 for a, b, c in corners[faces]])
    disc = 0.25
    samples = sample_mesh(corners, faces, disc_mm=disc)
    # 60 in a disc; strata of equal areas leave at most one sample of each triangle to chance.
    assert len(samples.points_mm) == int(area.sum() / (np.pi / 4 * disc**2) * 60)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0]) / (2 * area[0])
    first = samples.normals @ normal > 1 - 1e-9
    assert abs(first.sum() - len(first) * area[0] / area.sum()) <= 1
    inside = samples.points_mm[first]
    weights = np.linalg.lstsq(np.vstack([corners[:3].T, np.ones(3)]), np.vstack([inside.T, np.ones(len(inside))]))[0]
    assert weights.min() > -1e-12 and np.abs((inside - corners[0]) @ normal).max() < 1e-12
    off = corners[:3] - corners[:3].mean(axis=0)
    expected = off.T @ off / 12
    # Relative standard deviations of means and variances of 2,000 and more points: 2.5 % at most, four times that.
    std = np.sqrt(np.diag(expected))
    assert len(inside) > 2000
    np.testing.assert_allclose(inside.mean(axis=0), corners[:3].mean(axis=0), atol=0.1 * std.min())
    np.testing.assert_allclose(np.cov(inside.T), expected, atol=0.1 * np.outer(std, std).max())


def test_regions_and_figures_are_those_of_the_places():
    """Places every 2 mm of 4 mm2 each: a loss of 3 x 8 places, a rise of 5, and two places that are no region."""
    x, y = np.meshgrid(2.0 * np.arange(20), 2.0 * np.arange(12), indexing="ij")
    distance, level = np.zeros(x.shape), np.full(x.shape, 0.1)
    distance[2:5, 1:9], distance[3, 4] = -0.5, -0.9
    distance[12, 2:7] = 0.3
    distance[17, 9:11] = 0.7
    distance[10, 10] = np.nan
    level[2:5, 1:9] = 0.2
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    area = np.full(x.size, 4.0)
    change = SurfaceChange(points, points, distance.ravel(), level.ravel(), area, 2.0, 4.0, 12.0, None, "cloud")
    loss, rise = change.regions()
    assert (loss.places, loss.area_mm2, loss.level_mm) == (24, 96.0, 0.2)
    assert loss.centre_mm == pytest.approx((6.0, 9.0, 0.0)) and loss.extent_mm == pytest.approx(14.0)
    assert loss.volume_mm3 == pytest.approx(-4 * (23 * 0.5 + 0.9)) and loss.largest_mm == -0.9
    assert loss.mean_mm == pytest.approx(loss.volume_mm3 / 96)
    assert (rise.places, rise.largest_mm) == (5, 0.3) and rise.extent_mm == pytest.approx(8.0)
    record = change.record()
    assert (record["places"], record["compared"], record["compared_area_mm2"]) == (240, 239, 239 * 4.0)
    assert record["significant_share"] == pytest.approx(31 / 239)
    assert record["mean_mm"] == pytest.approx((-12.4 + 1.5 + 1.4) / 239)
    assert record["rms_mm"] == pytest.approx(np.sqrt((23 * 0.25 + 0.81 + 5 * 0.09 + 2 * 0.49) / 239))
    assert (record["largest_loss_mm"], record["largest_rise_mm"], record["level_median_mm"]) == (-0.9, 0.7, 0.1)
    assert change.lines() == [
        "reference                 cloud",
        "places compared           239 of 240, means over 4 mm",
        f"distance, mm              mean {-9.5 / 239:+.4f}, rms {record['rms_mm']:.4f}",
        "level of detection, mm    0.1000 (median; 95 %)",
        "significant change        13.0 % of the area, -0.900 to +0.700 mm",
        "regions of change         2 with at least 4 places, spacing 2 mm; 2 places are in no region",
    ]


def test_ideal_shapes_have_their_distances_and_normals():
    """Signed distances along unit normals; also in the centre of a sphere, where no normal is defined."""
    places = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    given = SurfaceSample(places)
    distance, normals = place_shape(IdealSphere(diameter_mm=6.0, point_mm=(0, 0, 0)), given).nearest(places)
    np.testing.assert_allclose(distance, [2.0, -1.0, -3.0])
    np.testing.assert_allclose(normals, [[0.6, 0.8, 0], [0, 0, 1], [0, 0, 0]])
    pipe = IdealCylinder(diameter_mm=6.0, point_mm=(0, 0, 7), axis=(0, 0, -3))
    distance, normals = place_shape(pipe, given).nearest(places, reach_mm=2.5)
    np.testing.assert_allclose(distance, [2.0, np.nan, np.nan])
    np.testing.assert_allclose(normals[0], [0.6, 0.8, 0])
    plane = IdealPlane(point_mm=(0, 0, 1), normal=(0, 3, 4))
    distance, normals = place_shape(plane, given).nearest(places)
    np.testing.assert_allclose(distance, [2.4 - 0.8, 0.8, -0.8])
    np.testing.assert_allclose(normals, [[0, 0.6, 0.8]] * 3)


def test_areas_of_places_add_up_to_the_surface():
    """Inner places of a square lattice of 2 mm: 12 neighbours lie within 4 mm, so that the area is pi 16 / 12.5."""
    x, y = np.meshgrid(2.0 * np.arange(9), 2.0 * np.arange(9), indexing="ij")
    area = _estimate_areas(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])).reshape(x.shape)
    np.testing.assert_allclose(area[2:-2, 2:-2], np.pi * 16 / 12.5)
    np.testing.assert_array_equal(_estimate_areas(np.zeros((1, 3))), [0.0])


def test_unknown_uncertainties_are_warned_of_on_all_outputs_and_can_be_stated(tmp_path):
    """The systematic errors of a scanner, 0.05 mm over the plate, are significant unless they are stated."""
    rng, clouds = np.random.default_rng(3), []
    for error_mm in (0.0, 0.05):
        x, y = rng.uniform(0, 60, (2, 4000))
        clouds.append(np.column_stack([x, y, 300 + error_mm * x / 60 + rng.normal(0, 0.02, 4000)]))
    files = [tmp_path / "a.xyz", tmp_path / "b.xyz"]
    for path, points in zip(files, clouds, strict=True):
        np.savetxt(path, points)
    scatter = uwlts.compare_clouds(*files)
    assert np.mean(scatter.significant) > 0.3
    assert [each[: each.index(" is known")] for each in scatter.warnings] == [
        "no uncertainty of the cloud",
        "no uncertainty of the reference",
    ]
    uwlts.report.write_change(tmp_path / "a.html", scatter, pdf=True)
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    recorded, page = json.loads((tmp_path / "a.json").read_text()), (tmp_path / "a.html").read_text()
    for warning in scatter.warnings:
        assert f"warning: {warning}" in scatter.lines() and warning in recorded["warnings"]
        assert warning.replace("'", "&#39;") in page
    stated = uwlts.compare_clouds(*files, cloud_std_mm=0.03, reference_std_mm=0.04)
    # The variances of independent errors add up.
    assert stated.level_mm == pytest.approx(np.hypot(scatter.level_mm, 1.96 * 0.05), rel=1e-6)
    assert not stated.warnings and not stated.significant.any()
    assert stated.record()["cloud_std_mm"] == 0.03 and stated.record()["reference_std_mm"] == 0.04
    known = scanned(rng)
    assert uwlts.compare_clouds(known, "plane", deep_mm=20.0).warnings == ()
    for options, reason in (
        ({"cloud_std_mm": 0.1}, "the cloud contains its uncertainty"),
        ({"reference_std_mm": 0.1}, "the reference contains its uncertainty"),
    ):
        with pytest.raises(EvaluationError, match=reason):
            uwlts.compare_clouds(known, "plane", deep_mm=20.0, **options)
    with pytest.raises(EvaluationError, match="`cloud_std_mm` is -1"):
        uwlts.compare_clouds(files[0], "plane", cloud_std_mm=-1)
