"""Ground truth of the twin: stripe centres by least time, points on surfaces, and shadows by geometry."""

import numpy as np
import pytest
import trimesh
from matplotlib.tri import LinearTriInterpolator, Triangulation
from scipy.spatial.transform import Rotation
from scipy.special import ndtr

from tests.virtual_sensors import (
    altered,
    block,
    camera_axes,
    clear,
    cropped,
    laser_origin,
    oracle_fan,
    oracle_paths,
    plate,
    scene_of,
    seen_at,
    sensor_at,
    stripe_on_plate,
)
from twin.light.renderer import Renderer
from twin.recording.frame_truth import (
    FrameTruth,
    find_crossings,
    find_true_stripe,
    find_visible_surfaces,
    mark_run,
    measure_line_light,
    project_points,
)
from twin.rendering_options import NONE, Effects
from twin.scene.forms.triangles import add_relief, bowed_plate
from twin.scene.objects import _RELIEF_STREAM
from twin.scene.surfaces import FinishProperties
from uwlts.model.sensor import Sensor
from uwlts.storage.truth import TruthStatus

CENTRE_PX = 1e-3
"""A coordinate of 1000 px is rounded to 6e-5 px, and 1e-4 mm of a ray in 32 bits are 5e-4 px at 0.2 mm per pixel."""
SURFACE_MM = 1e-3
"""Ten times the error of a ray in 32 bits: hits on curved and turned surfaces go through the surface's own frame."""


def coarse(thesis: Sensor) -> Sensor:
    """The thesis's view in 320 x 256 pixels."""
    return altered(thesis, {"camera": {"width_px": 320, "height_px": 256, "pixel_size_um": 21.2}})


SENSORS = {
    "thesis": {},
    "distorted": {
        "distortion": {"k1": -0.15, "k2": 0.1, "p1": 0.002, "p2": -0.003},
        "principal_point_px": (640.3, 519.2),
    },
    "oblong": {"pixel_aspect": 1.05},
    "upright": {"stripe_along": "height"},
}


@pytest.mark.parametrize("name", SENSORS)
def test_true_centres_are_where_light_of_least_time_shows_the_sheet(thesis, name):
    sensor, medium = altered(thesis, {"camera": SENSORS[name]}), clear(0.3)
    renderer = Renderer(sensor, medium, scene_of(plate()))
    for z in (-45.0, 60.0):
        truth = find_true_stripe(renderer, sensor_at(-z))
        lines = np.arange(100, sensor.camera.lines() - 100, 11).astype(float)
        y, across = stripe_on_plate(sensor, medium, lines, z)
        chosen = lines.astype(int)
        assert (truth.status[chosen] == TruthStatus.VISIBLE).all()
        assert (truth.crossings[chosen] == 1).all()
        np.testing.assert_allclose(truth.centre_px[chosen], across, rtol=0, atol=CENTRE_PX)
        expected = np.stack([0 * y, y, 0 * y], axis=1)
        np.testing.assert_allclose(truth.point_mm[chosen], expected, rtol=0, atol=SURFACE_MM / 2)
        np.testing.assert_allclose(truth.normal[chosen], [[0.0, 0.0, -1.0]] * len(lines), atol=1e-6)
        # A window 0.05 mm farther away would be noticed.
        wrong = altered(sensor, {"camera": {"window": {"distance_mm": 62.85}}})
        assert np.abs(stripe_on_plate(wrong, medium, lines, z)[1] - across).max() > 3 * CENTRE_PX


def test_the_rendered_stripe_lies_about_its_true_centre(thesis):
    sensor = cropped(thesis, 64, 512)
    renderer = Renderer(sensor, clear(0.3), scene_of(plate()), effects=NONE)
    for z in (-40.0, 0.0, 40.0):
        image = renderer.laser_frame(sensor_at(-z), spp=256).irradiance().astype(float)
        truth = find_true_stripe(renderer, sensor_at(-z))
        assert (truth.status == TruthStatus.VISIBLE).all()
        centroid = np.arange(512) @ image / image.sum(axis=0)
        # The sum covers the stripe to 4.5 sigma. Scale and brightness of the picture change by some 5e-3 per mm across
        # the stripe, which shifts the centroid by that times sigma squared, 1e-4 mm or 7e-4 px; the samples' noise at
        # 256 per pixel is of the same size.
        assert np.abs((centroid - truth.centre_px).mean()) < 2e-3
        np.testing.assert_allclose(centroid, truth.centre_px, rtol=0, atol=0.01)


def test_truth_on_a_relief_is_that_of_the_displaced_surface(thesis):
    """Points lie on the facets, by interpolation in them, and are seen where light of least time shows them."""
    rough = plate(side=200.0) | {"relief_mm": 0.3, "relief_length_mm": 4.0}
    renderer = Renderer(thesis, clear(0.3), scene_of(rough), effects=NONE, seed=3)
    truth = true_points(renderer, sensor_at(), 800)
    half = np.array([100.0, 100.0])
    own = FinishProperties("diffuse", relief_mm=0.3, relief_length_mm=4.0)
    drawn = add_relief(
        bowed_plate(-half, half, bow_mm=0.0, cells=1), own, np.random.default_rng((3, 0, _RELIEF_STREAM))
    )
    (x, y, z), facets = drawn[0].T, Triangulation(*drawn[0][:, :2].T, drawn[1])
    height = LinearTriInterpolator(facets, z)(*truth.point_mm[:, :2].T)
    assert height.std() > 0.2 and np.ptp(x) == np.ptp(y)
    np.testing.assert_allclose(truth.point_mm[:, 2], height, rtol=0, atol=3 * SURFACE_MM)
    seen = seen_at(thesis, clear(0.3), truth.point_mm)
    np.testing.assert_allclose(seen[:, 1], truth.centre_px, rtol=0, atol=3 * CENTRE_PX)


def distance_to_sphere(points: np.ndarray, centre: np.ndarray, diameter: float) -> np.ndarray:
    return np.abs(np.linalg.norm(points - centre, axis=1) - diameter / 2)


def true_points(renderer: Renderer, pose: np.ndarray, at_least: int) -> FrameTruth:
    """Return the points of a frame's visible lines; every point must be in the plane of the sheet."""
    truth = find_true_stripe(renderer, pose)
    visible = truth.status == TruthStatus.VISIBLE
    assert visible.sum() >= at_least
    assert np.isnan(truth.centre_px[~visible]).all()
    assert np.isnan(truth.point_mm[~visible]).all()
    assert (truth.crossings[~visible] == 0).all()
    np.testing.assert_allclose(truth.point_mm[visible][:, 0], pose[0, 3], rtol=0, atol=SURFACE_MM)
    return FrameTruth(**{name: value[visible] for name, value in vars(truth).items()})


def test_true_points_lie_on_a_sphere(thesis):
    centre = np.array([4.0, -12.0, 20.0])
    renderer = Renderer(
        coarse(thesis), clear(), scene_of({"kind": "sphere", "diameter_mm": 50.12, "position_mm": tuple(centre)})
    )
    for x in (-6.0, 4.0, 15.0):
        truth = true_points(renderer, sensor_at(x=x), at_least=40)
        assert distance_to_sphere(truth.point_mm, centre, 50.12).max() < SURFACE_MM
        outward = (truth.point_mm - centre) / 25.06
        np.testing.assert_allclose(truth.normal, outward, rtol=0, atol=1e-4)


def test_true_points_lie_on_a_turned_pipe_and_block(thesis):
    turned = (3.0, 8.0, 25.0)
    rotation = Rotation.from_euler("xyz", turned, degrees=True)
    pipe = {
        "kind": "pipe",
        "diameter_mm": 60.0,
        "length_mm": 90.0,
        "position_mm": (0.0, -45.0, 30.0),
        "rotation_deg": turned,
    }
    box = {"kind": "block", "size_mm": (50.0, 30.0, 20.0), "position_mm": (0.0, 40.0, 0.0), "rotation_deg": turned}
    renderer = Renderer(coarse(thesis), clear(), scene_of(pipe, box))
    truth = true_points(renderer, sensor_at(), at_least=120)
    on_pipe = truth.point_mm[:, 1] < 5
    in_pipe = rotation.inv().apply(truth.point_mm[on_pipe] - pipe["position_mm"])
    assert len(in_pipe) > 50
    assert np.abs(np.hypot(in_pipe[:, 1], in_pipe[:, 2]) - 30.0).max() < SURFACE_MM
    assert np.abs(in_pipe[:, 0]).max() < 45.0 + SURFACE_MM
    in_box = rotation.inv().apply(truth.point_mm[~on_pipe] - box["position_mm"])
    assert len(in_box) > 30
    beyond = np.abs(in_box) - [25.0, 15.0, 10.0]
    assert np.abs(beyond.max(axis=1)).max() < SURFACE_MM


def test_true_points_lie_on_a_mesh(thesis, tmp_path):
    surface = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    surface.vertices *= [30.0, 20.0, 10.0]
    surface.export(tmp_path / "potato.stl")
    place = {"position_mm": (0.0, 5.0, 10.0), "rotation_deg": (20.0, -10.0, 30.0), "scale": 1.5}
    renderer = Renderer(
        coarse(thesis), clear(), scene_of({"kind": "mesh", "path": str(tmp_path / "potato.stl")} | place)
    )
    truth = true_points(renderer, sensor_at(x=3.0), at_least=40)
    local = (
        Rotation.from_euler("xyz", place["rotation_deg"], degrees=True)
        .inv()
        .apply(truth.point_mm - place["position_mm"])
        / 1.5
    )
    pairs = len(local), len(surface.faces)
    on_faces = trimesh.triangles.closest_point(
        np.tile(surface.triangles, (pairs[0], 1, 1)), np.repeat(local, pairs[1], axis=0)
    )
    distance = np.linalg.norm(on_faces - np.repeat(local, pairs[1], axis=0), axis=1).reshape(pairs)
    assert distance.min(axis=1).max() * 1.5 < SURFACE_MM
    assert len(set(distance.argmin(axis=1))) > 20, "the stripe crosses many faces"
    ellipsoid = np.abs(np.linalg.norm(local / [30.0, 20.0, 10.0], axis=1) - 1).max()
    assert ellipsoid > 1e-3, "the facets, not the ellipsoid they approximate, are what is seen"


def test_the_depth_map_is_the_camera_frame_z_of_what_pixels_see(thesis):
    sensor, medium = coarse(thesis), clear()
    renderer = Renderer(sensor, medium, scene_of(plate(25.0, side=100.0)))
    depth = find_visible_surfaces(renderer, sensor_at())[0]
    assert depth.shape == (256, 320)
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-45, 45, 13), np.linspace(-45, 45, 13)))
    points = np.stack([x, y, np.full_like(x, 25.0)], axis=1)
    uv = seen_at(sensor, medium, points)
    axes, standoff = camera_axes(sensor)
    z = (points @ axes.T + standoff)[:, 2]
    column, row = np.rint(uv).astype(int).T
    # A pixel's centre is up to half a pixel from the point. The plate's depth is extrapolated with the slope between
    # its neighbours: its change over half a pixel, 0.1 mm, is nonlinear by 1e-3 only.
    slope_v, slope_u = np.gradient(depth)
    there = depth[row, column] + slope_u[row, column] * (uv[:, 0] - column) + slope_v[row, column] * (uv[:, 1] - row)
    inner = np.isfinite(there)
    assert inner.sum() > 150
    np.testing.assert_allclose(there[inner], z[inner], rtol=0, atol=1e-3)
    corners = seen_at(sensor, medium, np.array([(sx * 50.0, sy * 50.0, 25.0) for sx in (-1, 1) for sy in (-1, 1)]))
    seen = np.isfinite(depth)
    assert seen.any(axis=0).sum() == pytest.approx(np.ptp(corners[:, 0]), abs=2.0)
    assert not seen[:, : int(corners[:, 0].min()) - 1].any()


def test_points_are_seen_where_light_of_least_time_shows_them(thesis):
    sensor, medium = altered(thesis, {"camera": SENSORS["distorted"]}), clear(0.3)
    renderer = Renderer(sensor, medium, scene_of(plate(30.0, side=120.0), block((20.0, 20.0, 20.0), (0.0, 0.0, 10.0))))
    x, y = (g.ravel() for g in np.meshgrid(np.linspace(-70, 70, 9), np.linspace(-70, 70, 9)))
    points = np.stack([x, y, np.full_like(x, 30.0)], axis=1)
    found, expected = project_points(renderer, sensor_at(), points), seen_at(sensor, medium, points)
    known = np.isfinite(found).all(axis=1)
    # 0.05 px are 0.01 mm: within the rounding of Newton's last step and of coordinates in 32 bits.
    np.testing.assert_allclose(found[known], expected[known], rtol=0, atol=2 * CENTRE_PX)
    on_plate, middle = np.maximum(np.abs(x), np.abs(y)) < 60, np.maximum(np.abs(x), np.abs(y)) < 1
    assert known.sum() > 30
    assert not known[~on_plate].any(), "beside the plate nothing is met at the point's depth"
    assert not known[middle].any(), "the block hides the middle"


def test_pixels_know_the_object_that_they_see(thesis):
    renderer = Renderer(
        coarse(thesis), clear(), scene_of(plate(30.0, side=120.0), block((60.0, 60.0, 20.0), (0.0, 0.0, 0.0)))
    )
    depth, number = find_visible_surfaces(renderer, sensor_at())
    assert set(np.unique(number)) == {-1, 0, 1}
    np.testing.assert_array_equal(number < 0, np.isnan(depth))
    # Of both things the block is nearer wherever it is seen, by its 20 mm less what tilts by 35 deg do to depths.
    assert depth[128, 160] < np.nanmin(depth[number == 0]) + 60.0 and number[128, 160] == 1
    truth = find_crossings(renderer, sensor_at())
    np.testing.assert_array_equal(truth.thing, np.where(truth.point_mm[:, 2] > 20.0, 0, 1))
    assert set(truth.thing) == {0, 1}


def intervals_overlap(start: np.ndarray, end: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the signed fraction (N,) of segments (N, 3) inside a box; negative if they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (low - start) / (end - start), (high - start) / (end - start)
    enter = np.nanmax(np.concatenate([np.minimum(first, second), np.zeros((len(start), 1))], axis=1), axis=1)
    leave = np.nanmin(np.concatenate([np.maximum(first, second), np.ones((len(start), 1))], axis=1), axis=1)
    return leave - enter


BLOCKS = {
    # The camera stands on the side of -X: a thin block in the sheet shades the plate, one beside it hides the stripe.
    "shadow": ((4.0, 30.0, 10.0), (0.0, 15.0, -40.0)),
    "occlusion": ((6.0, 36.0, 30.0), (-20.0, -10.0, -5.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BLOCKS)
def test_lines_whose_stripe_is_shaded_or_hidden_have_none(thesis, name):
    sensor, medium, z = coarse(thesis), clear(), 20.0
    size, position = BLOCKS[name]
    low, high = (np.array(position) + sign * np.array(size) / 2 for sign in (-1, 1))
    renderer = Renderer(sensor, medium, scene_of(plate(z), block(size, position)))
    truth = find_true_stripe(renderer, sensor_at())
    lines = np.arange(30.0, 290.0, 2.0)
    y, _ = stripe_on_plate(sensor, medium, lines, z)
    on_plate = np.stack([0 * y, y, np.full_like(y, z)], axis=1)
    fan, origin = oracle_fan(sensor, medium), laser_origin(sensor)
    leaves = fan.exit_y(fan.angle_through(y, z - origin[2]))
    exits = np.stack([0 * y, leaves, np.full_like(y, origin[2] + fan.outer_face)], axis=1)
    shaded = intervals_overlap(on_plate, exits, low, high)
    hidden = intervals_overlap(on_plate, oracle_paths(sensor, medium, on_plate)[1], low, high)
    assert ((shaded > 0).sum() > 10, (hidden > 0).sum() > 10) == (name == "shadow", name == "occlusion")
    blocked = np.maximum(shaded, hidden)
    clear_cut = np.abs(blocked) > 1e-5  # a part of 4 um of the way; rays are known to 0.1 um
    assert clear_cut.sum() > 125
    status = truth.status[lines.astype(int)]
    expected = np.where(blocked > 0, TruthStatus.NO_STRIPE, TruthStatus.VISIBLE)
    np.testing.assert_array_equal(status[clear_cut], expected[clear_cut])
    image = renderer.laser_frame(sensor_at(), spp=4).irradiance()
    bright = image[:, 30:290:2].max(axis=0) > 0.05 * image.max()
    # A pixel at the edge of the shadow is partly lit, and the lit half of the stripe is visible beside a hidden point.
    inner = np.convolve(blocked > 0, np.ones(3), "same")
    assert not bright[inner == 3].any()
    assert bright[inner == 0].all()
    assert truth.crossings[lines.astype(int)].max() == 1
    # Points in the shadow are visible, hidden ones are not.
    found = find_crossings(renderer, sensor_at())
    on_the_plate = found.line[np.abs(found.point_mm[:, 2] - z) < 0.1]
    seen = np.isin(lines, on_the_plate)
    np.testing.assert_array_equal(seen[clear_cut], hidden[clear_cut] <= 0)


def test_of_two_crossings_on_a_line_the_brighter_is_given(thesis):
    # A thin block is in front of another. As the laser is beside the camera, some image columns see past the edge of
    # the near block and show both stripes.
    laser = {
        "baseline_mm": None,
        "triangulation_angle_deg": None,
        "origin_mm": (-150.0, -265.0, 0.0),
        "axis": (150.0, 265.0, 378.5),
    }
    sensor = altered(coarse(thesis), {"laser": laser})
    for near_reflectance, far_reflectance, brighter_z in ((0.9, 0.05, -20.0), (0.05, 0.9, 20.0)):
        near = block((6.0, 40.0, 10.0), (0.0, 20.0, -15.0), reflectance=near_reflectance)
        far = block((200.0, 100.0, 10.0), (0.0, -30.0, 25.0), reflectance=far_reflectance)
        truth = true_points(Renderer(sensor, clear(), scene_of(near, far)), sensor_at(), at_least=150)
        z = truth.point_mm[:, 2]
        faces = np.stack([np.abs(z + 20.0), np.abs(z - 20.0)])
        assert (faces.min(axis=0) < SURFACE_MM).all()
        assert (truth.crossings == 2).sum() >= 3
        np.testing.assert_allclose(z[truth.crossings == 2], brighter_z, rtol=0, atol=SURFACE_MM)


WIDE = {"laser": {"waist_radius_mm": 2.0, "waist_distance_mm": 360.0}}
"""A sheet with a standard deviation of 1 mm, which is 5 px."""


def middle_line(sensor: Sensor, x: np.ndarray, z: float) -> np.ndarray:
    """Return the coordinate across the stripe (N,) of points (x, 0, z) by least time; they are on the middle line."""
    seen = seen_at(sensor, clear(), np.stack([x, 0 * x, np.full_like(x, z)], axis=1))
    return seen[:, 1 if sensor.camera.stripe_along == "width" else 0]


@pytest.mark.parametrize("along", ["width", "height"])
def test_light_cut_by_an_edge_is_a_truncated_gaussian(thesis, along):
    sensor = altered(cropped(thesis, 96, 96), WIDE | {"camera": {"stripe_along": along}})
    x = np.linspace(-6.0, 6.0, 1201)
    across = middle_line(sensor, x, 0.0)
    for edge in (0.3, 1.0, 2.0, 20.0):
        renderer = Renderer(sensor, clear(), scene_of(plate(side=100.0, x=edge - 50.0)), effects=NONE)
        truth = find_true_stripe(renderer, sensor_at())
        light = measure_line_light(renderer, sensor_at(), truth, spp=64)
        np.testing.assert_array_equal(light.centre_px, truth.centre_px)
        seen = np.where(x < edge, np.exp(-0.5 * x**2), 0.0)
        # Brightness and scale change by 5e-3 per mm, and the sheet's width is that of the waist within 1e-3. The
        # samples resolve the edge to an eighth of a pixel, 0.03 of the visible light of 5 px.
        assert light.visible_fraction[48] == pytest.approx(ndtr(edge), abs=0.02)
        expected = (seen * across).sum() / seen.sum()
        assert light.centroid_px[48] == pytest.approx(expected, abs=0.06)
        assert light.mixed_fraction[48] == 0.0
        if edge < 2:
            assert np.abs(light.centroid_px[48] - light.centre_px[48]) > 0.2


def test_light_of_a_surface_behind_the_edge_is_mixed_in(thesis):
    sensor = altered(cropped(thesis, 64, 128), WIDE)
    depth = 1.2
    for edge, share in ((0.3, 0.8), (0.8, 0.4)):
        behind = plate(depth, reflectance=share)
        renderer = Renderer(
            sensor, clear(), scene_of(plate(side=100.0, x=edge - 50.0, reflectance=0.8), behind), effects=NONE
        )
        light = measure_line_light(renderer, sensor_at(), find_true_stripe(renderer, sensor_at()), spp=64)
        # Map pixels to X on both planes. The laser shines along Z, the camera stands at smaller X.
        x, pixel = np.linspace(-8.0, 8.0, 3201), np.linspace(0.0, 127.0, 12701)
        front, back = (np.interp(pixel, middle_line(sensor, x[::-1], z), x[::-1]) for z in (0.0, depth))
        near = np.where(front < edge, np.exp(-0.5 * front**2), 0.0)
        far = np.where((front >= edge) & (back > edge), share / 0.8 * np.exp(-0.5 * back**2), 0.0)
        mixed = far.sum() / (near + far).sum()
        assert 0.01 < mixed < 0.5
        assert light.mixed_fraction[32] == pytest.approx(mixed, abs=0.02)
        assert light.centroid_px[32] == pytest.approx(((near + far) * pixel).sum() / (near + far).sum(), abs=0.1)
        assert light.visible_fraction[32] == pytest.approx(ndtr(edge), abs=0.02)


def test_whole_stripes_are_visible_and_their_centroid_is_that_of_the_image(thesis):
    sensor = cropped(thesis, 64, 512)
    tilted = plate() | {"rotation_deg": (0.0, 35.0, 0.0)}
    renderer = Renderer(sensor, clear(0.3), scene_of(tilted), effects=Effects())
    light = measure_line_light(renderer, sensor_at(), find_true_stripe(renderer, sensor_at()), spp=16)
    image = renderer.laser_frame(sensor_at(), spp=16).direct().astype(float)
    np.testing.assert_allclose(light.centroid_px, np.arange(512) @ image / image.sum(axis=0), atol=2e-3)
    assert light.visible_fraction.min() > 0.98 and light.mixed_fraction.max() == 0.0


def test_a_run_ends_where_its_light_fades():
    light = np.array([[0.0, 5.0, 9.0, 4.0, 0.001, 3.0, 7.0]] * 2).T
    marked = mark_run(light, np.array([2.2, 6.0]), 1e-3)
    assert marked[:, 0].tolist() == [False, True, True, True, False, False, False]
    assert marked[:, 1].tolist() == [False] * 5 + [True] * 2
    assert not mark_run(np.zeros((5, 1)), np.array([2.0]), 1e-3).any()
