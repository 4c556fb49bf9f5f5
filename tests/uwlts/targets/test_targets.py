"""Calibration targets in rendered images, compared with the exact projections of their points."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from pydantic import ValidationError

from uwlts.errors import DescriptionError, ImageError, TargetError
from uwlts.targets import CharucoTarget, ChessboardTarget, CircleTarget, parse_target
from uwlts.targets.detection import detect_lattice, find_circles, label_lattice
from uwlts.targets.detection.blobs import _select_ellipses
from uwlts.targets.detection.ellipses import circle_centre_bias

PLATE = CircleTarget(
    spacing_x_mm=9.375, spacing_y_mm=9.372, diameter_mm=5.0, marker_diameter_mm=2.0, columns=15, rows=13, origin=(6, 5)
)
MARKS = ((0, 0), PLATE.marker_x, PLATE.marker_y)
DARK, BRIGHT = 45.0, 195.0


class Camera:
    """A pinhole with two radial coefficients, for these tests only."""

    def __init__(self, turn_deg, shift_mm, *, size=(640, 512), focal=1200.0, k=(0.0, 0.0)):
        self.size, self.focal, self.k = size, focal, k
        rx, ry, rz = np.deg2rad(turn_deg)
        about_x = np.array([[1, 0, 0], [0, np.cos(rx), -np.sin(rx)], [0, np.sin(rx), np.cos(rx)]])
        about_y = np.array([[np.cos(ry), 0, np.sin(ry)], [0, 1, 0], [-np.sin(ry), 0, np.cos(ry)]])
        about_z = np.array([[np.cos(rz), -np.sin(rz), 0], [np.sin(rz), np.cos(rz), 0], [0, 0, 1]])
        self.turn, self.shift = about_y @ about_x @ about_z, np.array(shift_mm, float)
        self.middle = (np.array(size) - 1) / 2

    def project(self, points):
        x, y, z = (np.asarray(points) @ self.turn.T + self.shift).T
        plane = np.stack([x / z, y / z], 1)
        square = (plane**2).sum(1, keepdims=True)
        return self.focal * plane * (1 + self.k[0] * square + self.k[1] * square**2) + self.middle

    def plate_point(self, pixels):
        """Return the intersections (..., 2) mm of the rays of pixels (..., 2) with the plane z = 0 of the target."""
        wanted = (pixels - self.middle) / self.focal
        plane = wanted.copy()
        for _ in range(12 if any(self.k) else 0):
            square = (plane**2).sum(-1, keepdims=True)
            plane = wanted / (1 + self.k[0] * square + self.k[1] * square**2)
        ray = np.concatenate([plane, np.ones_like(plane[..., :1])], -1) @ self.turn
        start = -self.shift @ self.turn
        return (start - ray * (start[2] / ray[..., 2])[..., None])[..., :2]


def plate_pattern(place_mm, marks, missing):
    """Return True for points (..., 2) mm of the plate that have the circles' colour."""
    i, j = np.rint(place_mm[..., 0] / PLATE.spacing_x_mm), np.rint(place_mm[..., 1] / PLATE.spacing_y_mm)
    distance = np.hypot(place_mm[..., 0] - i * PLATE.spacing_x_mm, place_mm[..., 1] - j * PLATE.spacing_y_mm)
    column, row = i + PLATE.origin[0], j + PLATE.origin[1]
    circle = (distance < PLATE.diameter_mm / 2) & (column >= 0) & (column < PLATE.columns) & (row >= 0)
    circle &= row < PLATE.rows
    for a, b in marks:
        circle &= ~((i == a) & (j == b) & (distance < PLATE.marker_diameter_mm / 2))
    for a, b in missing:
        circle &= ~((i == a) & (j == b))
    return circle


def render_plate(camera, *, bright=True, marks=MARKS, missing=(), samples=6, blur=0.7):
    """Return grey levels (H, W) of the plate, each pixel of an edge the mean of samples x samples rays."""
    pixels = np.stack(np.meshgrid(*(np.arange(n, dtype=float) for n in camera.size)), 2)
    # Within a pixel the map to the plate is taken as linear: its curvature there is 1e-4 px.
    middle = camera.plate_point(pixels)
    along = camera.plate_point(pixels + np.array([0.5, 0])) - middle
    down = camera.plate_point(pixels + np.array([0, 0.5])) - middle
    around = [(-1, -1), (1, -1), (-1, 1), (1, 1), (0, 0)]
    hits = sum(plate_pattern(middle + a * along + b * down, marks, missing).astype(int) for a, b in around)
    edge = (hits > 0) & (hits < 5)
    share = (hits > 2).astype(float)
    offset = (2 * np.arange(samples) + 1) / samples - 1
    a, b = (grid.reshape(1, -1, 1) for grid in np.meshgrid(offset, offset))
    share[edge] = plate_pattern(
        middle[edge][:, None] + a * along[edge][:, None] + b * down[edge][:, None], marks, missing
    ).mean(1)
    levels = DARK + (BRIGHT - DARK) * (share if bright else 1 - share)
    return cv2.GaussianBlur(levels, (0, 0), blur) if blur else levels


def photograph(levels, *, noise=0.0, seed=0):
    noisy = levels + noise * np.random.default_rng(seed).normal(size=levels.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def errors_px(view, camera):
    """Return detected minus true image of each circle's centre, with the perspective bias removed, (N, 2)."""
    bias = circle_centre_bias(camera.project, view.points_mm, diameter_mm=PLATE.diameter_mm)
    return view.pixels - bias - camera.project(view.points_mm)


def rms(errors):
    return float(np.sqrt((errors**2).mean()))


def all_places():
    """Return places (column, row) and points (mm) of the whole plate."""
    places = np.stack(np.meshgrid(np.arange(PLATE.columns), np.arange(PLATE.rows)), 2).reshape(-1, 2)
    steps = (places - PLATE.origin) * (PLATE.spacing_x_mm, PLATE.spacing_y_mm)
    return places, np.column_stack([steps, np.zeros(len(steps))])


def places_in_view(camera):
    """Return places of the plate whose whole circle is at least 5 px inside the image."""
    places, points = all_places()
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = PLATE.diameter_mm / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    pixels = camera.project((points[:, None] + rim).reshape(-1, 3)).reshape(len(points), 16, 2)
    inside = ((pixels > 5) & (pixels < np.array(camera.size) - 6)).all((1, 2))
    return {tuple(place) for place in places[inside].tolist()}


POSES = [
    # turn about x, y, z (deg); position of the origin (mm); bright circles; k1, k2
    ((0, 0, 0), (3, -4, 300), True, (0.0, 0.0)),
    ((0, 0, 90), (-5, 2, 280), False, (-0.2, 0.1)),
    ((35, 10, 180), (0, 0, 320), True, (-0.3, 0.1)),
    ((0, 50, 20), (0, 0, 330), False, (0.2, 0.0)),
    ((-50, 0, 270), (4, 4, 380), True, (-0.15, 0.05)),
    ((20, -35, 135), (0, 0, 160), True, (-0.2, 0.0)),
    ((25, 25, 33), (0, 0, 700), False, (-0.2, 0.0)),
]


@pytest.mark.parametrize(("turn", "shift", "bright", "k"), POSES)
def test_circles_are_numbered_and_located_in_every_pose(turn, shift, bright, k):
    camera = Camera(turn, shift, k=k)
    view = PLATE.detect(photograph(render_plate(camera, bright=bright), noise=2.0))
    places = {tuple(place) for place in view.indices.tolist()}
    assert len(places) == len(view.indices) >= 20
    # Every circle well in view is found; circles at the very border may be found as well.
    assert places_in_view(camera) <= places
    np.testing.assert_allclose(
        view.points_mm, np.column_stack([(view.indices - PLATE.origin) * (9.375, 9.372), np.zeros(len(places))])
    )
    errors = errors_px(view, camera)
    # Noise 2 on contrast 150 moves an edge point of slope 0.4/px by 0.033 px; the mean of the pi d independent ones of
    # a circle of d px by 0.033 sqrt(2 / (pi d)): 0.011 px for the smallest, 6 px. Twice that for blur and rounding.
    assert rms(errors) < 0.025
    assert np.abs(errors).max() < 0.12
    # A wrong index would be a full step off, 9 px at least; the mean has 20 circles and more behind it.
    assert np.abs(errors.mean(0)).max() < 0.012


@pytest.mark.parametrize("bright", [True, False])
def test_centres_of_a_noise_free_image_have_almost_no_bias(bright):
    camera = Camera((25, 30, 15), (2, 3, 300), k=(-0.2, 0.05))
    view = PLATE.detect(photograph(render_plate(camera, bright=bright, samples=10)))
    assert view.quality["radius_px"].min() > 6
    # Rounding to whole grey levels is noise of 0.29 grey: 0.29/2.0 of what 2.0 does above, under 0.002 px. 10 x 10
    # samples misplace an edge by 0.05 px at most and at random: 0.03 / sqrt(pi 20) = 0.004 px in the mean of a rim.
    # The required bias is below 0.01 px.
    errors = errors_px(view, camera)
    assert rms(errors) < 0.006
    assert np.abs(errors).max() < 0.02


def test_without_the_perspective_bias_the_centres_are_wrong():
    # The same measure must be able to fail: at 45 deg and 160 mm the ellipse's centre is off by a tenth of a pixel.
    camera = Camera((0, 45, 0), (0, 0, 160))
    view = PLATE.detect(photograph(render_plate(camera)))
    assert rms(view.pixels - camera.project(view.points_mm)) > 5 * rms(errors_px(view, camera))


def test_small_circles_of_six_pixels():
    # 5 mm at 1200 px / 1000 mm is 6 px.
    camera = Camera((5, -5, 10), (0, 0, 1000))
    view = PLATE.detect(photograph(render_plate(camera), noise=2.0))
    assert len(view.pixels) == PLATE.columns * PLATE.rows
    assert np.median(view.quality["radius_px"]) < 3.4
    # 0.033 sqrt(2 / (pi 6)) = 0.011 px, twice for blur, which flattens the whole of so small a circle.
    assert rms(errors_px(view, camera)) < 0.025


def test_uneven_light_of_a_factor_of_three():
    camera = Camera((10, 20, 5), (0, 0, 300))
    levels = render_plate(camera)
    gain = np.linspace(0.35, 1.05, levels.shape[1]) * np.linspace(1.0, 0.9, levels.shape[0])[:, None]
    view = PLATE.detect(photograph(levels * gain, noise=1.0))
    assert places_in_view(camera) <= {tuple(place) for place in view.indices.tolist()}
    # Left uncorrected, a slope of 0.3 % per px pulls the centroid by slope r^2 / 4 = 0.08 px at 10 px radius. Noise 1
    # on the lowest contrast of 50 is worth 3 on 150: 0.01 px at 20 px diameter.
    errors = errors_px(view, camera)
    assert rms(errors) < 0.02
    assert np.abs(errors.mean(0)).max() < 0.01


def test_a_mark_does_not_pull_its_circle():
    camera = Camera((30, 30, 15), (0, 0, 250))
    view = PLATE.detect(photograph(render_plate(camera, samples=10)))
    steps = view.indices - PLATE.origin
    marked = np.isin(steps @ (100, 1), np.array(MARKS) @ (100, 1))
    assert marked.sum() == 3
    # The same bound as for all circles without noise.
    assert rms(errors_px(view, camera)[marked]) < 0.01
    np.testing.assert_allclose(view.quality["radius_px"][marked], np.median(view.quality["radius_px"]), rtol=0.2)


@pytest.mark.parametrize("bright", [True, False])
def test_circles_cut_by_a_stripe_are_left_out(bright):
    camera = Camera((10, 10, 5), (0, 0, 280))
    levels = render_plate(camera, bright=bright)
    v, u = np.mgrid[: levels.shape[0], : levels.shape[1]]
    line = 470 + 0.05 * v
    view = PLATE.detect(photograph(levels + 150 * np.exp(-0.5 * ((u - line) / 1.5) ** 2), noise=2.0))
    distance = np.abs(view.pixels[:, 0] - (470 + 0.05 * view.pixels[:, 1]))
    whole = places_in_view(camera)
    found = {tuple(place) for place in view.indices.tolist()}
    # The stripe meets a column of circles or two, and only those are lost.
    lost = whole - found
    assert 3 <= len(lost) <= 2 * PLATE.rows
    assert {i for i, _ in lost} <= set(range(8, 13))
    # No circle remains that the stripe's two sigma touch: nearer than 0.9 radius plus 3 px.
    assert (distance > 0.9 * view.quality["radius_px"] + 3).all()
    errors = errors_px(view, camera)
    # A stripe's tail below the noise may be next to a circle: 2 of 150 grey levels over a part of the edge.
    assert rms(errors) < 0.02
    assert np.abs(errors).max() < 0.15


def test_missing_circles_and_false_blobs_do_not_confuse_the_numbering():
    random = np.random.default_rng(5)
    missing = [tuple(place) for place in random.integers(-5, 7, (35, 2)).tolist() if tuple(place) not in MARKS]
    camera = Camera((15, -25, 40), (0, 0, 320), k=(-0.2, 0.0))
    levels = render_plate(camera, missing=missing)
    _, points = all_places()
    centres = camera.project(points)
    canvas = photograph(levels, noise=2.0)
    strays = 0
    for x, y in random.integers(10, 500, (150, 2)).tolist():
        if np.linalg.norm(centres - (x, y), axis=1).min() > 17:
            cv2.circle(canvas, (x, y), int(random.integers(2, 6)), int(BRIGHT), -1, cv2.LINE_AA)
            strays += 1
    assert strays >= 10
    cv2.putText(canvas, "0o8 Q.", (20, 500), cv2.FONT_HERSHEY_SIMPLEX, 1, int(BRIGHT), 2, cv2.LINE_AA)
    view = PLATE.detect(canvas)
    found = {tuple(place) for place in view.indices.tolist()}
    gone = {(i + PLATE.origin[0], j + PLATE.origin[1]) for i, j in missing}
    assert not found & gone
    assert len(found) > 0.7 * len(places_in_view(camera) - gone)
    # A blob in a circle's stead would be several px off.
    assert np.abs(errors_px(view, camera)).max() < 0.3


def test_sixteen_bit_images_give_the_same_points():
    camera = Camera((10, 20, 5), (0, 0, 300))
    levels = render_plate(camera)
    eight = PLATE.detect(np.rint(levels).astype(np.uint8))
    sixteen = PLATE.detect(np.rint(levels * 16).astype(np.uint16))
    np.testing.assert_array_equal(eight.indices, sixteen.indices)
    # Rounding to 8 bit is noise of 0.29 grey: at most some 0.01 px.
    np.testing.assert_allclose(eight.pixels, sixteen.pixels, rtol=0, atol=0.02)


def test_the_message_counts_the_marks_that_are_missing():
    camera = Camera((10, 20, 5), (0, 0, 300))
    image = photograph(render_plate(camera, marks=MARKS[:2]), noise=2.0)
    with pytest.raises(TargetError, match=r"found \d+ circles, .* but only 2 of 3 marked circles"):
        PLATE.detect(image)


def test_marks_at_other_offsets_and_a_smaller_plate_are_named():
    camera = Camera((10, 20, 5), (0, 0, 330))
    image = photograph(render_plate(camera), noise=2.0)
    with pytest.raises(TargetError, match="check marker_x, marker_y"):
        PLATE.model_copy(update={"marker_x": (3, 0)}).detect(image)
    with pytest.raises(TargetError, match="check columns, rows and origin"):
        PLATE.model_copy(update={"columns": 9}).detect(image)


BOARD = ChessboardTarget(columns=8, rows=5, square_mm=12.0)
CHARUCO = CharucoTarget(columns=8, rows=6, square_mm=12.0, marker_mm=9.0)


@pytest.mark.parametrize(
    "image",
    [
        np.full((200, 300), 90, np.uint8),
        np.zeros((200, 300), np.uint16),
        np.random.default_rng(1).normal(120, 12, (400, 500)).astype(np.uint8),
        np.tile(np.linspace(0, 255, 300), (200, 1)).astype(np.uint8),
    ],
    ids=["blank", "black", "noise", "ramp"],
)
@pytest.mark.parametrize("target", [PLATE, BOARD, CHARUCO], ids=["circles", "chessboard", "charuco"])
def test_images_without_a_target_are_refused(image, target):
    with pytest.raises(TargetError, match="found"):
        target.detect(image)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((100, 100, 3), np.uint8), "grey channel"),
        (np.zeros((100, 100), np.float32), "float32"),
        (np.zeros((8, 100), np.uint8), "100 x 8"),
        ([[0, 1], [2, 3]], "list"),
    ],
)
@pytest.mark.parametrize("target", [PLATE, BOARD, CHARUCO], ids=["circles", "chessboard", "charuco"])
def test_foreign_images_are_refused(image, message, target):
    with pytest.raises(ImageError, match=message):
        target.detect(image)


def test_a_lattice_without_marks_is_numbered_under_strong_distortion():
    camera = Camera((10, -10, 25), (0, 0, 210), focal=700.0, k=(-0.35, 0.08))
    lattice = detect_lattice(photograph(render_plate(camera, bright=False, marks=()), noise=2.0))
    assert not lattice.circles.bright
    assert len(lattice.indices) == lattice.found >= len(places_in_view(camera)) > 150
    # Against the plate: undo the unknown origin and quarter turn by the pair of an affine fit, which must be exact.
    places, points = all_places()
    nearest = np.linalg.norm(lattice.circles.centres[:, None] - camera.project(points), axis=2).argmin(1)
    design = np.column_stack([lattice.indices, np.ones(len(nearest))])
    fit = np.linalg.lstsq(design, places[nearest], rcond=None)[0]
    np.testing.assert_allclose(design @ fit, places[nearest], rtol=0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(fit[:2]), 1.0, atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(
    tilt=st.floats(0, 55),
    towards=st.floats(0, 360),
    aspect=st.floats(0.6, 1.6),
    gaps=st.integers(0, 10),
    seed=st.integers(0, 2**31),
)
def test_any_oblique_rectangular_lattice_is_numbered(tilt, towards, aspect, gaps, seed):
    random = np.random.default_rng(seed)
    turned, tilted = np.deg2rad(towards), np.cos(np.deg2rad(tilt))
    turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    local = turn @ np.diag([tilted, 1.0]) @ turn.T
    places = np.stack(np.meshgrid(np.arange(9), np.arange(8)), 2).reshape(-1, 2)
    # Gaps in the inside leave each circle neighbours to be reached from.
    inside = np.flatnonzero(((places > 1) & (places < 6)).all(1))
    places = np.delete(places, random.choice(inside, gaps, replace=False), 0)
    centres = places * (30.0, 30.0 * aspect) @ local.T + random.normal(0, 0.02, (len(places), 2))
    shapes = np.broadcast_to(8 * local, (len(places), 2, 2))
    order = random.permutation(len(places))
    indices, labelled = label_lattice(centres[order], shapes)
    assert labelled.sum() >= 0.9 * len(places)
    step = (indices[labelled] - indices[labelled][0]).astype(float)
    fit = np.linalg.lstsq(step, (places[order] - places[order][labelled][0])[labelled], rcond=None)[0]
    np.testing.assert_allclose(step @ fit, (places[order] - places[order][labelled][0])[labelled], atol=1e-9)
    np.testing.assert_allclose(np.abs(fit).sum(), 2, atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(fit), 1, atol=1e-9)


def test_a_point_off_the_lattice_is_rejected_and_its_neighbours_are_kept():
    places = np.stack(np.meshgrid(np.arange(9), np.arange(8)), 2).reshape(-1, 2)
    centres = places * 30.0 + np.random.default_rng(2).normal(0, 0.02, (len(places), 2))
    centres[40] += (2.0, -1.5)
    _, labelled = label_lattice(centres, np.broadcast_to(8 * np.eye(2), (len(places), 2, 2)))
    assert not labelled[40]
    assert labelled.sum() == len(places) - 1


def test_too_few_circles_form_no_lattice():
    canvas = np.full((200, 200), 50, np.uint8)
    for u in (50, 100, 150):
        cv2.circle(canvas, (u, 100), 12, 200, -1, cv2.LINE_AA)
    assert len(next(find_circles(canvas))) == 3
    with pytest.raises(TargetError, match="found 3 circles"):
        detect_lattice(canvas)


COMPLETE = {"kind": "circles", "diameter_mm": 5, "marker_diameter_mm": 2, "columns": 15, "rows": 13, "origin": [6, 5]}


def test_descriptions_are_read_with_their_defaults():
    assert parse_target(COMPLETE) == PLATE
    assert parse_target({"kind": "chessboard", "columns": 8, "rows": 5, "square_mm": 12}) == BOARD
    assert parse_target(CHARUCO.model_dump()) == CHARUCO
    with pytest.raises(ValidationError, match="frozen"):
        PLATE.columns = 3


@pytest.mark.parametrize(
    ("mapping", "message"),
    [
        (COMPLETE | {"kind": "dots"}, "kind is one of"),
        (COMPLETE | {"spacing_mm": 9}, "spacing_mm is not a key"),
        (COMPLETE | {"columns": None}, "columns: .* found None"),
        (COMPLETE | {"diameter_mm": 9.4}, "circles touch"),
        (COMPLETE | {"diameter_mm": float("inf")}, "diameter_mm"),
        (COMPLETE | {"diameter_mm": -1.0}, "greater than 0"),
        (COMPLETE | {"marker_diameter_mm": 5.0}, "less than diameter_mm"),
        (COMPLETE | {"origin": [14, 5]}, "marker_x is at"),
        (COMPLETE | {"origin": [15, 5]}, "origin is at"),
        (COMPLETE | {"marker_y": [4, 0]}, "collinear"),
        ({}, "kind is one of"),
        ([], "expected a table"),
        ({"kind": "chessboard", "columns": 8, "rows": 5}, "square_mm is missing"),
        ({"kind": "chessboard", "columns": 2, "rows": 5, "square_mm": 1}, "columns"),
        (CHARUCO.model_dump() | {"dictionary": "DICT_9X9"}, "expected one of DICT_"),
        (CHARUCO.model_dump() | {"marker_mm": 12.0}, "less than square_mm"),
        (CHARUCO.model_dump() | {"columns": 30, "rows": 20}, "needs 300 markers"),
    ],
)
def test_impossible_targets_are_refused(mapping, message):
    with pytest.raises(DescriptionError, match=message):
        parse_target(mapping)


def test_a_line_of_pixels_in_the_noise_is_no_blob():
    # The area within its outline is zero.
    mask = np.zeros((120, 160), np.uint8)
    mask[30, 20:60] = mask[50:90, 100] = mask[np.arange(60, 90), np.arange(20, 50)] = 1
    cv2.circle(mask, (120, 30), 12, 1, -1)
    assert np.allclose(_select_ellipses(mask, bright=True).centres, [[120, 30]])
