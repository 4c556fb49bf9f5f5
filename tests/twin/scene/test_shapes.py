"""Procedural shapes: topology, orientation towards the sensor, and requested sizes."""

import numpy as np
import pytest
import trimesh
from pydantic import ValidationError
from scipy.signal import argrelmin

from twin.scene import scene_object
from twin.scene.forms import Head, PittedPipe, Weld
from twin.scene.forms.head import _compute_front, _compute_outline
from twin.scene.forms.parts import pit_depths, pit_places, pitted_radius, undercut_depths, weld_height
from twin.scene.forms.triangles import bowed_plate
from uwlts.errors import DescriptionError

HEIGHT = 160.0


def head_depth(x: np.ndarray, y: np.ndarray, *, height_mm: float) -> np.ndarray:
    """Return z of the front of a head at ``x``, ``y`` (N,), all in mm; NaN outside its outline."""
    x, y = x / height_mm, y / height_mm
    half_width, front, _ = _compute_outline(y)
    with np.errstate(divide="ignore", invalid="ignore"):
        facing = np.sqrt(1 - np.square(x / half_width))
    return height_mm * np.where(np.abs(y) <= 0.5, _compute_front(x, y, front, facing), np.nan)


def mesh_of(surface: tuple[np.ndarray, np.ndarray]) -> trimesh.Trimesh:
    return trimesh.Trimesh(*surface, process=False)


def inner_points(mesh: trimesh.Trimesh) -> np.ndarray:
    """Middles of all faces and of their sides (4, F, 3), where facets deviate most from a smooth surface."""
    corners = mesh.triangles
    return np.stack([corners.mean(axis=1), *((corners[:, i] + corners[:, i - 1]) / 2 for i in range(3))])


@pytest.fixture(scope="module")
def head() -> trimesh.Trimesh:
    return mesh_of(Head(kind="head", height_mm=HEIGHT).surface())


def test_a_head_is_closed_and_its_normals_point_outwards(head):
    assert head.is_watertight
    assert head.is_winding_consistent
    assert head.volume > 0
    assert head.area_faces.min() > 0
    front = head.triangles_center[:, 2] < -0.2 * HEIGHT
    assert front.sum() > 10000
    assert head.face_normals[front, 2].max() < 0.2  # of the nose's underside, which alone may look back


def test_a_head_has_the_size_that_was_asked_for(head):
    low, high = head.bounds
    np.testing.assert_allclose([low[1], high[1]], [-80, 80], atol=1e-9)
    np.testing.assert_allclose((high - low)[[0, 2]] / HEIGHT, [0.57, 0.79], atol=0.005)
    half, _ = Head(kind="head", height_mm=HEIGHT / 2).surface()
    np.testing.assert_allclose(2 * half, head.vertices, rtol=0, atol=1e-9)


def test_a_heads_facets_follow_its_smooth_face(head):
    lit = (head.face_normals[:, 2] < -0.2) & (head.triangles_center[:, 2] < 0)
    assert lit.sum() > 500_000
    corners = head.triangles[lit].reshape(-1, 3)
    np.testing.assert_allclose(head_depth(*corners.T[:2], height_mm=HEIGHT), corners[:, 2], rtol=0, atol=1e-8)
    x, y, z = np.moveaxis(inner_points(head)[:, lit], -1, 0)
    away = np.abs((head_depth(x, y, height_mm=HEIGHT) - z) * head.face_normals[lit, 2])
    # Facets some 0.25 mm wide, and 0.4 mm along the nose's flanks: over radii of 2 mm h^2 / 8 r is 0.004 to 0.01 mm.
    assert away.max() < 0.01
    assert np.quantile(away, 0.99) < 0.003


def test_the_profile_is_that_of_a_face():
    y = np.linspace(-0.4, 0.2, 1201)
    profile = head_depth(np.zeros_like(y), y * HEIGHT, height_mm=HEIGHT) / HEIGHT
    summits = y[argrelmin(profile)[0]]
    chin, lower_lip, upper_lip, nose = summits[:4]
    assert -0.35 < chin < -0.25 < lower_lip < -0.18 < upper_lip < -0.12 < nose < 0
    assert profile.argmin() == np.searchsorted(y, nose)
    sockets = head_depth(np.array([-0.095, 0.095]) * HEIGHT, np.array([0.1, 0.1]) * HEIGHT, height_mm=HEIGHT) / HEIGHT
    brows = head_depth(np.array([-0.095, 0.095]) * HEIGHT, np.array([0.15, 0.15]) * HEIGHT, height_mm=HEIGHT) / HEIGHT
    assert (sockets > brows + 0.005).all()
    # Flanks steeper than the line of sight at 35 deg to the laser's axis hide adjacent points.
    x = np.linspace(0, 0.1, 401)
    flank = np.gradient(head_depth(x * HEIGHT, np.full_like(x, nose * HEIGHT), height_mm=HEIGHT) / HEIGHT, x)
    assert flank.max() > 1 / np.tan(np.radians(35))


def test_beside_a_head_there_is_nothing():
    x = np.array([0.0, 60.0, 0.0, 0.0])
    y = np.array([0.0, 0.0, 81.0, -81.0])
    np.testing.assert_array_equal(np.isnan(head_depth(x, y, height_mm=HEIGHT)), [False, True, True, True])


@pytest.mark.parametrize("along", ["x", "y"])
def test_a_weld_is_an_open_sheet_that_faces_the_sensor(along):
    plate = (80.0, 120.0) if along == "x" else (120.0, 80.0)
    weld = Weld(kind="weld", along=along, plate_mm=plate)
    mesh = mesh_of(weld.surface())
    assert mesh.is_winding_consistent
    assert mesh.face_normals[:, 2].max() < 0
    # One closed rim and no hole: V - E + F of a disk is 1.
    assert mesh.euler_number == 1
    np.testing.assert_allclose(mesh.bounds[:, :2], [[-plate[0] / 2, -plate[1] / 2], [plate[0] / 2, plate[1] / 2]])
    assert mesh.bounds[1, 2] == 0
    # A crown of 2 mm that changes by up to 6 %, and half a ripple of 0.25 mm.
    assert 0.94 * 2.0 < -mesh.bounds[0, 2] < 1.06 * 2.0 + 0.125
    x, y, z = np.moveaxis(inner_points(mesh), -1, 0)
    # 0.004 mm by the second derivatives, and a quarter of it for the fourth ones.
    assert np.abs(z + weld_height(weld, x, y)).max() < 0.005


def test_beads_lie_where_they_should_on_a_flat_plate():
    weld = Weld(kind="weld", beads=2, spacing_mm=20.0)
    x, y = np.meshgrid(np.linspace(-40, 40, 401), np.linspace(-60, 60, 601))
    height = weld_height(weld, x, y)
    on_bead = height > 0
    assert on_bead.mean() > 0.1
    assert (np.abs(x[on_bead]) <= 28.0).all()
    assert (np.abs(np.abs(y[on_bead]) - 10.0) <= weld.bead_reach_mm()).all()
    for side in (-1, 1):
        middle = np.average(y[side * y > 0], weights=height[side * y > 0])
        assert middle == pytest.approx(side * 10.0, abs=weld.irregularity * weld.width_mm)


@pytest.mark.parametrize(("along", "pitch"), [("x", 3.0), ("y", 2.0)])
def test_ripples_have_their_pitch_and_height(along, pitch):
    plate = (80.0, 120.0) if along == "x" else (120.0, 80.0)
    weld = Weld(kind="weld", along=along, plate_mm=plate, ripple_pitch_mm=pitch, irregularity=0.0)
    place = np.arange(-18, 18, 0.05)  # whole pitches on the even part of the middle bead
    zero = np.zeros_like(place)
    crown = weld_height(weld, *((place, zero) if along == "x" else (zero, place)))
    spectrum = np.abs(np.fft.rfft(crown - crown.mean()))
    assert 1 / np.fft.rfftfreq(len(place), 0.05)[spectrum.argmax()] == pytest.approx(pitch)
    assert np.ptp(crown) == pytest.approx(weld.ripple_height_mm)
    assert crown.mean() == pytest.approx(weld.height_mm)
    # At half the way to the toes the crescents trail by a third of the width over four, and the envelope is 9/16.
    beside = weld_height(weld, *((place, zero + 2.5) if along == "x" else (zero + 2.5, place)))
    shift = np.angle(np.fft.rfft(beside)[spectrum.argmax()] / np.fft.rfft(crown)[spectrum.argmax()])
    assert np.exp(1j * shift) == pytest.approx(np.exp(2j * np.pi * 10.0 / 12 / pitch))
    assert np.ptp(beside) == pytest.approx(9 / 16 * weld.ripple_height_mm, rel=2e-3)


def test_irregular_beads_follow_their_seed():
    place = np.linspace(-18, 18, 200)

    def crowns(seed: int, irregularity: float = 0.06) -> np.ndarray:
        weld = Weld(kind="weld", seed=seed, irregularity=irregularity)
        return np.stack([weld_height(weld, place, np.full_like(place, middle)) for middle in (-18.0, 0.0, 18.0)])

    first = crowns(1)
    np.testing.assert_array_equal(first, crowns(1))
    assert np.abs(first - crowns(2)).max() > 0.01
    assert np.abs(first[0] - first[1]).max() > 0.01
    np.testing.assert_array_equal(crowns(1, 0.0), crowns(2, 0.0))


def test_surfaces_are_the_same_every_time_and_kept_unharmed():
    for make in (lambda: Head(kind="head", height_mm=20.0).surface(), lambda: Weld(kind="weld", beads=1).surface()):
        first = make()
        scene_object._cache_triangles.cache_clear()
        for old, new in zip(first, make(), strict=True):
            assert old is not new
            np.testing.assert_array_equal(old, new)
            with pytest.raises(ValueError, match="read-only"):
                new[0] = 0


def test_a_weld_too_fine_to_be_meshed_is_refused():
    with pytest.raises(DescriptionError, match=r"a surface in steps of 0\.0\d+ mm needs \d+ vertices"):
        Weld(kind="weld", ripple_pitch_mm=0.2).surface()


def test_an_undercut_runs_along_both_toes_of_a_bead():
    straight = {"kind": "weld", "beads": 1, "irregularity": 0.0, "ripple_height_mm": 0.0}
    plain, cut = (Weld(**straight, undercut_depth_mm=depth, undercut_width_mm=2.0) for depth in (0.0, 0.6))
    across = np.linspace(-10, 10, 2001)
    lost = weld_height(plain, np.zeros_like(across), across) - weld_height(cut, np.zeros_like(across), across)
    # A bead 10 mm wide has its toes 5 mm beside its middle.
    assert lost.max() == pytest.approx(0.6, abs=1e-4)
    np.testing.assert_allclose(np.abs(across[lost > 0.599]), 5.0, atol=0.03)
    np.testing.assert_allclose([np.abs(across[lost > 0]).min(), np.abs(across[lost > 0]).max()], [4.0, 6.0], atol=0.02)
    assert weld_height(cut, np.array([29.0]), np.array([5.0])) == 0, "it ends with the bead"
    mesh = mesh_of(cut.surface())
    x, y, z = np.moveaxis(inner_points(mesh), -1, 0)
    assert np.abs(weld_height(cut, x, y) + z).max() < 0.015
    with pytest.raises(ValidationError, match="do not fit on plate_mm"):
        Weld(**straight, plate_mm=(80.0, 11.0), undercut_depth_mm=0.5)


PITTED = PittedPipe(kind="pitted_pipe", ovality=0.04, pits=5, seed=1)


def test_a_pitted_pipe_has_the_diameters_and_pits_that_were_asked_for():
    mesh = mesh_of(PITTED.surface())
    assert mesh.is_winding_consistent
    axial = np.stack([mesh.triangles_center[:, 0], *np.zeros((2, len(mesh.faces)))], axis=1)
    outwards = np.sum((mesh.triangles_center - axial) * mesh.face_normals, axis=1)
    assert outwards.min() > 0
    # Without pits, at the back, the smallest diameter is across, the largest along z.
    end = mesh.vertices[np.isclose(mesh.vertices[:, 0], -60.0)]
    assert 2 * end[:, 2].max() == pytest.approx(102.0, abs=0.02)
    assert np.ptp(end[:, 1]) == pytest.approx(98.0, abs=0.02)
    places = pit_places(PITTED)
    assert places.shape == (5, 2) and np.abs(places[:, 1]).max() < np.radians(60)
    x, y, z = np.moveaxis(mesh.vertices, -1, 0)
    angle, radius = np.arctan2(y, -z), np.hypot(y, z)
    missing = 50.0 * (1 + 0.02 * np.cos(2 * angle)) - radius
    assert missing.max() == pytest.approx(2.0, abs=0.02)
    near = np.min([np.hypot(x - px, 50 * (angle - pa)) for px, pa in places], axis=0)
    assert missing[near > 5.0].max() < 1e-9
    # A quarter of the depth is left where t^2 is one half.
    assert missing[(near > 3.4) & (near < 3.6)] == pytest.approx(2.0 * (1 - 0.49) ** 2, abs=0.06)
    assert missing[near < 0.5].min() > 1.95


def test_a_pitted_pipes_facets_follow_its_smooth_surface():
    mesh = mesh_of(PITTED.surface())
    x, y, z = np.moveaxis(inner_points(mesh), -1, 0)
    away = np.abs(pitted_radius(PITTED, x, np.arctan2(y, -z)) - np.hypot(y, z))
    # Chords deviate by 0.01 mm along each side, the middles of faces by up to twice that.
    assert away.max() < 0.03
    assert np.quantile(away, 0.99) < 0.015


def test_a_pipe_without_pits_is_a_plain_one_and_too_many_vertices_are_refused():
    plain = mesh_of(PittedPipe(kind="pitted_pipe", pits=0).surface())
    assert len(plain.vertices) < 500
    np.testing.assert_allclose(np.hypot(*plain.vertices.T[1:]), 50.0, rtol=1e-12)
    with pytest.raises(DescriptionError, match="make its pits wider or flatter"):
        PittedPipe(kind="pitted_pipe", diameter_mm=400, length_mm=600, pit_diameter_mm=2, pit_depth_mm=5).triangles()


def test_pits_of_drawn_depths_stand_apart_and_cover_their_range():
    size = {"pits": 30, "pit_diameter_mm": 5.0, "pit_depth_mm": (0.01, 0.4), "pit_gap_mm": 2.0}
    pipe = PittedPipe(kind="pitted_pipe", length_mm=60.0, **size)
    places = pit_places(pipe) * (1.0, 50.0)
    apart = np.linalg.norm(places[:, None] - places, axis=2)[~np.eye(30, dtype=bool)]
    assert apart.min() >= 7.0
    depths = pit_depths(pipe)
    # One depth in each of 30 equal steps of the logarithm, in random order.
    steps = np.floor(30 * np.log(depths / 0.01) / np.log(40)).astype(int)
    assert sorted(steps) == list(range(30)) and list(steps) != list(range(30))
    middle = pitted_radius(pipe, places[:, 0], places[:, 1] / 50.0)
    np.testing.assert_allclose(50.0 - middle, depths, rtol=1e-9)
    assert not np.allclose(pit_depths(pipe.model_copy(update={"seed": 1})), depths)
    with pytest.raises(ValidationError, match="would cover 72 % of their area; at most 45 % can be placed"):
        PittedPipe(kind="pitted_pipe", length_mm=60.0, **size | {"pits": 108})
    with pytest.raises(ValidationError, match=r"the range \[0.4, 0.01\] must begin with its smaller end"):
        PittedPipe(kind="pitted_pipe", pit_depth_mm=(0.4, 0.01))


def test_undercuts_of_drawn_depths_differ_on_both_sides():
    weld = Weld(kind="weld", beads=1, irregularity=0.0, ripple_height_mm=0.0, undercut_depth_mm=(0.1, 0.8))
    ((left, right),) = undercut_depths(weld)
    assert 0.1 <= min(left, right) < max(left, right) <= 0.8
    along = np.zeros(1)
    assert -weld_height(weld, along, np.array([-5.0])) == pytest.approx(left)
    assert -weld_height(weld, along, np.array([5.0])) == pytest.approx(right)
    mesh = mesh_of(weld.surface())
    x, y, z = np.moveaxis(inner_points(mesh), -1, 0)
    assert np.abs(weld_height(weld, x, y) + z).max() < 0.015


def test_a_bowed_plate_is_a_paraboloid_between_its_corners():
    vertices, _, _ = bowed_plate(np.array([10.0, 0.0]), np.array([210.0, 100.0]), bow_mm=2.0)
    away_mm = np.hypot(*(vertices[:, :2] - (110.0, 50.0)).T)
    corner_mm = np.hypot(100.0, 50.0)
    np.testing.assert_allclose(vertices[:, 2], 2.0 * (away_mm / corner_mm) ** 2, atol=1e-12)
    assert away_mm.min() == 0 and away_mm.max() == pytest.approx(corner_mm)
