"""Thin parts: the side that the scan saw, and triangles with consistent normals."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import uwlts
from uwlts.comparison.change_reference import orient_triangles
from uwlts.storage.cloud import make_foreign_cloud

NOISE_MM = 0.02


def plate(thickness):
    return trimesh.creation.box((60.0, 40.0, thickness))


def scan(rng, thickness, *, spacing, sides, wear=0.0):
    """Return points (N, 3) on faces of the plate, with a worn disc of 12 mm diameter on each."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-27, 27, spacing), np.arange(-17, 17, spacing)))
    x, y = (each + rng.uniform(-0.2, 0.2, each.size) * spacing for each in (x, y))
    z = thickness / 2 - wear * (np.hypot(x, y) < 6) + NOISE_MM * rng.normal(size=x.size)
    return np.concatenate([np.column_stack([x, y, side * z]) for side in sides])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sides", [(-1,), (1,), (-1, 1)])
def test_a_thin_part_is_compared_with_the_side_that_was_seen(seed, sides, tmp_path):
    """Distances beside the wear are zero, and in it the wear, for any thickness, spacing and pose."""
    rng = np.random.default_rng(seed)
    spacing, both = rng.uniform(0.5, 0.9), len(sides) == 2
    # Of points of both sides a disc of several millimetres holds the opposite ones, too; wear is then below a quarter.
    thickness = np.exp(rng.uniform(np.log(1.0), np.log(12.0)))
    wear = (0.2 if both else rng.uniform(0.3, 0.9)) * thickness
    turn, shift = Rotation.from_rotvec(rng.normal(size=3)), rng.uniform(-100, 100, 3)
    mesh = plate(thickness)
    if seed % 2:
        # Some triangles are wound the other way, or all.
        turned = slice(None) if seed % 4 == 1 else slice(3, 4)
        mesh.faces[turned] = mesh.faces[turned][:, ::-1]
    mesh.vertices = turn.apply(mesh.vertices) + shift
    mesh.export(tmp_path / "plate.stl")
    points = turn.apply(scan(rng, thickness, spacing=spacing, sides=sides, wear=wear)) + shift
    change = uwlts.compare_clouds(make_foreign_cloud(points), tmp_path / "plate.stl")
    place = turn.inv().apply(change.points_mm - shift)
    radius, half = np.hypot(place[:, 0], place[:, 1]), change.disc_mm / 2
    beside = change.compared & (radius > 6 + half) & (np.abs(place[:, 0]) < 26) & (np.abs(place[:, 1]) < 16)
    worn = change.compared & (radius < max(6 - half, 1.0))
    assert beside.sum() > 50 and worn.any()
    # Means of 30 points have a standard deviation of 0.004 mm, and 2000 places stay within five of them.
    assert np.abs(change.distance_mm[beside]).max() < 0.03
    if half < 5:
        np.testing.assert_allclose(np.median(change.distance_mm[worn]), -wear, atol=0.03)


def test_triangles_of_a_closed_mesh_are_turned_outwards():
    ball = trimesh.creation.icosphere(subdivisions=3)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        faces, turned = ball.faces.copy(), rng.random(len(ball.faces)) < rng.uniform(0, 1)
        faces[turned] = faces[turned][:, ::-1]
        # Vertices are repeated for every triangle, as in STL.
        vertices = ball.vertices[faces].reshape(-1, 3)
        found = orient_triangles(vertices, np.arange(len(vertices)).reshape(-1, 3))
        corners = vertices[found]
        outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert turned.any() or seed == 0
        assert (np.einsum("fi,fi->f", outwards, corners.mean(axis=1)) > 0).all()
