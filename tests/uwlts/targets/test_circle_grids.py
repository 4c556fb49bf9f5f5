"""Circle grids without marks, drawn ray by ray: their numbers, their centres, and what is refused."""

from functools import cache, partial

import cv2
import numpy as np
import pytest

from tests.oracles.drawings import circles, draw, pinhole, pose, project_points
from uwlts.calibration.camera.photographs import calibrate_camera
from uwlts.errors import DescriptionError, TargetError
from uwlts.targets import CircleGridTarget, parse_target
from uwlts.targets.detection.ellipses import circle_centre_bias

SIZE, CENTRE, FOCAL = (480, 384), (243.3, 188.2), 500.0
RAYS = pinhole(FOCAL, CENTRE)
ASYMMETRIC = CircleGridTarget(columns=4, rows=11, pitch_mm=10.0, diameter_mm=8.0, asymmetric=True)
RECTANGULAR = CircleGridTarget(columns=9, rows=6, pitch_mm=10.0, diameter_mm=6.0)


def opencv_points():
    """OpenCV's points of an asymmetric grid, as its tutorial on calibration writes them."""
    return np.array([((2 * j + i % 2) * 10.0, i * 10.0) for i in range(11) for j in range(4)])


def photograph(points, diameter, place, *, bright=False, hidden=()):
    shown = np.delete(points, hidden, axis=0)
    levels = circles(shown, diameter, bright=bright, edge_mm=8.0)
    return draw(levels, RAYS, place, size=SIZE, rng=np.random.default_rng(5), samples=3, noise=1.0)


def errors_px(view, target, place, points_mm):
    """Return distances of found centres from those of the true ellipses; points (N, 2) as the target should number."""

    def project(points):
        seen = points @ place[:3, :3].T + place[:3, 3]
        return FOCAL * seen[:, :2] / seen[:, 2:] + CENTRE

    flat = np.column_stack([points_mm, np.zeros(len(points_mm))])
    bias = circle_centre_bias(project, flat, diameter_mm=target.diameter_mm)
    true = project_points(points_mm, RAYS, place, start=view.pixels) + bias
    return np.linalg.norm(view.pixels - true, axis=1)


@pytest.mark.parametrize("turn", [5.0, 100.0, 190.0, -80.0])
def test_an_asymmetric_grid_has_opencvs_numbers_in_any_turn(turn):
    place = pose((20.0, -25.0, turn), (0.0, 0.0, 200.0))
    place[:3, 3] -= place[:3, :3] @ [35.0, 50.0, 0.0]
    image = photograph(opencv_points(), 8.0, place, bright=turn > 0)
    view = ASYMMETRIC.detect(image)
    np.testing.assert_allclose(view.points_mm[:, :2], opencv_points())
    np.testing.assert_allclose(ASYMMETRIC.points_mm[:, :2], opencv_points())
    # 0.02 px measured; a wrong number is off by 20 px.
    assert errors_px(view, ASYMMETRIC, place, opencv_points()).max() < 0.1


def test_opencv_finds_the_same_asymmetric_grid():
    place = pose((10.0, 5.0, 5.0), (0.0, 0.0, 170.0))
    place[:3, 3] -= place[:3, :3] @ [35.0, 50.0, 0.0]
    image = photograph(opencv_points(), 8.0, place)
    found, centres = cv2.findCirclesGrid(image, (4, 11), flags=cv2.CALIB_CB_ASYMMETRIC_GRID)
    assert found
    # OpenCV's centres are those of blobs in whole grey levels.
    assert np.linalg.norm(centres.reshape(-1, 2) - ASYMMETRIC.detect(image).pixels, axis=1).max() < 0.5


@pytest.mark.parametrize("turn", [5.0, 185.0])
def test_x_points_right_where_half_a_turn_changes_nothing(turn):
    place = pose((15.0, 20.0, turn), (0.0, 0.0, 150.0))
    place[:3, 3] -= place[:3, :3] @ [40.0, 25.0, 0.0]
    # A circle beneath dirt costs this one only.
    view = RECTANGULAR.detect(photograph(RECTANGULAR.points_mm[:, :2], 6.0, place, hidden=[20]))
    assert len(view.pixels) == 53
    points = view.points_mm[:, :2] if turn < 90 else np.array([80.0, 50.0]) - view.points_mm[:, :2]
    assert errors_px(view, RECTANGULAR, place, points).max() < 0.1


@cache
def rectangular_photograph(hidden):
    place = pose((0.0, 10.0, 5.0), (-40.0, -25.0, 150.0))
    return photograph(RECTANGULAR.points_mm[:, :2], 6.0, place, hidden=list(hidden))


@pytest.mark.parametrize(
    ("described", "hidden", "said"),
    [
        (RECTANGULAR.model_copy(update={"columns": 7}), (), "check columns, rows and asymmetric"),
        (RECTANGULAR.model_copy(update={"columns": 10}), (), "fit the grid at several places"),
        (ASYMMETRIC, (), "fit an asymmetric grid of 4 x 11"),
        (RECTANGULAR, range(0, 54, 9), "fit the grid at several places"),
    ],
)
def test_another_grid_is_refused_with_the_reason(described, hidden, said):
    with pytest.raises(TargetError, match=said):
        described.detect(rectangular_photograph(hidden))


def test_descriptions_that_contradict_themselves_are_refused():
    known = {"kind": "circle grid", "columns": 4, "rows": 11, "pitch_mm": 10.0, "diameter_mm": 8.0}
    refused = partial(pytest.raises, DescriptionError)
    with refused(match="otherwise the circles touch"):
        parse_target(known | {"diameter_mm": 10.0})
    with refused(match="expected one number for an asymmetric grid"):
        parse_target(known | {"pitch_mm": [10.0, 11.0], "asymmetric": True})
    # Neighbours of an asymmetric grid are along the diagonals.
    assert parse_target(known | {"diameter_mm": 12.0, "asymmetric": True}).spacing_mm == pytest.approx(200**0.5)


@pytest.mark.slow
def test_photographs_of_an_asymmetric_grid_give_the_camera(tmp_path):
    """Ellipses of 20 px, whose centres are up to 0.3 px beside the images of the circles' centres."""
    for number, (x, y) in enumerate([(30, 5), (-30, 8), (5, 30), (-6, -30), (22, 22), (-22, 20), (20, -24), (3, 2)]):
        place = pose((x, y, 15.0 * number), (0.0, 0.0, 165.0))
        place[:3, 3] -= place[:3, :3] @ [35.0, 50.0, 0.0]
        cv2.imwrite(str(tmp_path / f"{number}.png"), photograph(opencv_points(), 8.0, place))
    (tmp_path / "target.toml").write_text(
        'kind = "circle grid"\ncolumns = 4\nrows = 11\npitch_mm = 10.0\ndiameter_mm = 8.0\nasymmetric = true\n'
    )
    lens = calibrate_camera(tmp_path, distortion=("k1", "k2"), pixels="square").lens
    values, std = lens.values(), lens.std()
    assert len(lens.used) == 8 and lens.solution.rms_px() < 0.05
    for name, true in {"f": FOCAL, "cx": CENTRE[0], "cy": CENTRE[1]}.items():
        # Twelve draws in 10,000 exceed four standard uncertainties of few images.
        assert abs(values[name] - true) < 4 * std[name] < 2.0, name


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_grid_is_found_among_more_specks_than_it_has_circles(seed):
    """Specks of 1 to 3 px radius, bright and dark, outnumber the circles by four to eight."""
    rng = np.random.default_rng(seed)
    place = pose((15.0, 20.0, float(rng.uniform(0.0, 360.0))), (0.0, 0.0, 400.0))
    place[:3, 3] -= place[:3, :3] @ [40.0, 25.0, 0.0]
    image = photograph(RECTANGULAR.points_mm[:, :2], 6.0, place, bright=bool(seed % 2))
    corners = project_points(RECTANGULAR.plate_mm, RAYS, place, start=np.tile(CENTRE, (4, 1)))
    plate = cv2.fillConvexPoly(np.zeros_like(image), np.rint(corners).astype(np.int32), 1)
    near = cv2.dilate(plate, np.ones((25, 25))) > 0
    ground = np.full(image.shape, 110.0, np.float32)
    for place_px in rng.uniform(5, [SIZE[0] - 5, SIZE[1] - 5], (int(rng.uniform(300, 600)), 2)):
        level = 110.0 + float(rng.choice([-1, 1]) * rng.uniform(25, 60))
        cv2.circle(ground, place_px.astype(int), int(rng.integers(1, 4)), level, -1)
    scene = np.where(near, image, cv2.GaussianBlur(ground, (0, 0), 0.8) + rng.normal(0.0, 1.0, image.shape))
    view = RECTANGULAR.detect(np.clip(scene, 0, 255).astype(np.uint8))
    assert len(view.pixels) >= 52
    alone = RECTANGULAR.detect(image)
    assert [index for index in view.indices.tolist() if index not in alone.indices.tolist()] == []
