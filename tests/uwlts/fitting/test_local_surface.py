"""Normals of local surfaces against those of a plane and of a sphere."""

import numpy as np
from scipy.spatial.transform import Rotation

from uwlts.fitting.local_surface import surface_normals

RADIUS_MM = 2.0
TURN = Rotation.from_rotvec([0.3, 2.5, -0.8]).as_matrix()


def test_normals_of_points_are_those_of_planes_towards_the_sensor() -> None:
    """A plane is exact; of a sphere, about 30 points each give the direction within the slope over a tenth radius."""
    # 31 places in a disc of the radius.
    flat = np.random.default_rng(5).uniform(-10, 10, (2500, 2))
    plane = np.column_stack([flat, np.full(len(flat), 3.0)]) @ TURN.T
    for sign in (1.0, -1.0):
        found = surface_normals(plane, radius_mm=RADIUS_MM, towards=sign * TURN[:, 2])
        np.testing.assert_allclose(found, np.broadcast_to(sign * TURN[:, 2], plane.shape), atol=1e-9)
    way = np.random.default_rng(6).normal(size=(5000, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    way = way[way[:, 2] > 0.3]
    found = surface_normals(20.0 * way, radius_mm=RADIUS_MM, towards=np.array([0.0, 0.0, 1.0]))
    inner = way[:, 2] > 0.5
    assert np.median(np.einsum("ni,ni->n", found, way)[inner]) > np.cos(0.2 * RADIUS_MM / 20.0)
