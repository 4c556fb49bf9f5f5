"""Meshes by `uwlts mesh` and by Open3D's Poisson reconstruction, of the same exactly simulated scans.

Needs `pip install open3d`. Noise of 0.02 mm along the view, images 0.5 mm apart, points 0.25 mm apart along the stripe.
Prints the rows of the table in docs/how-to/make-a-mesh.md: error of the vertices against the true surface, and the area
of the mesh over that of the surface that was seen.
"""

import time

import numpy as np
import open3d as o3d
from scipy.spatial import KDTree

import uwlts
from uwlts.metrology.local_surface import surface_normals
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty

NOISE_MM = 0.02


def scan(rng, surface, *, half=15.0, turn=None):
    along = np.arange(-half, half, 0.5)
    x, y = np.meshgrid(along, np.arange(-half, half, 0.25), indexing="ij")
    frame = np.repeat(np.arange(len(along)), x.shape[1])
    x, y = x.ravel(), y.ravel() + rng.uniform(-0.1, 0.1, x.size)
    points = np.column_stack([x, y, surface(x, y)])
    seen = np.isfinite(points[:, 2])
    turn = np.eye(3) if turn is None else turn
    view, count = turn @ [0.0, 0.0, 1.0], np.count_nonzero(seen)
    points = points[seen] @ turn.T + NOISE_MM * rng.standard_normal((count, 1)) * view
    random = np.tile([NOISE_MM**2 * view[i] * view[j] for i, j in PAIRS], (count, 1)).astype(np.float32)
    nothing = np.zeros((count, 3), np.float32)
    known = PointUncertainty(random, nothing, nothing[None])
    return PointCloud(points, np.ones(count), frame[seen], np.zeros(count, int), uncertainty=known)


def about_y(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def poisson(clouds, towards, spacing):
    """Screened Poisson of the same points and normals, cut where its density is as low as far from all points."""
    points = np.concatenate([cloud.points_mm for cloud in clouds])
    normals = np.concatenate(
        [
            surface_normals(each.points_mm, radius_mm=1.5, towards=np.array(way, float))
            for each, way in zip(clouds, towards, strict=True)
        ]
    )
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    depth = int(np.ceil(np.log2(1.1 * np.ptp(points, axis=0).max() / spacing)))
    made, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    vertices, faces = np.asarray(made.vertices), np.asarray(made.triangles)
    # As open as the own mesh: what lies farther from points than their spacing was not seen.
    near = KDTree(points).query(vertices)[0] < 0.6
    faces = faces[near[faces].all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    made.compute_vertex_normals()
    return vertices[used], np.asarray(made.vertex_normals)[used], faces.reshape(-1, 3)


def area(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def main() -> None:
    rng, up = np.random.default_rng(1), [(0, 0, -1)]
    uwlts.mesh(scan(rng, lambda x, y: 0 * x, half=3.0))
    sphere = lambda x, y: -np.sqrt(np.where(np.hypot(x, y) < 14, 400 - x**2 - y**2, np.nan))  # noqa: E731
    tube = lambda x, y: -np.sqrt(np.where(np.abs(x) < 11, 144 - x**2, np.nan))  # noqa: E731
    plate = lambda x, y: np.where(np.hypot(x, y) > 4, 0.0, np.nan)  # noqa: E731
    side = 29.6 * 29.7
    cases = [
        (
            "sphere, radius 20 mm",
            [scan(rng, sphere)],
            up,
            lambda v: np.linalg.norm(v, axis=1) - 20,
            2 * np.pi * 20 * 5.717,
        ),
        (
            "step of 5 mm, its wall unseen",
            [scan(rng, lambda x, y: np.where(x < 0, 0.0, 5.0))],
            up,
            lambda v: np.where(v[:, 2] < 2.5, v[:, 2], v[:, 2] - 5),
            side,
        ),
        (
            "pipe of 24 mm from three sides",
            [scan(rng, tube, turn=about_y(a)) for a in (0, 120, 240)],
            [about_y(a) @ [0, 0, -1] for a in (0, 120, 240)],
            lambda v: np.hypot(v[:, 0], v[:, 2]) - 12,
            2 * np.pi * 12 * 29.7,
        ),
    ]
    for thick in (1.0, 0.4):
        back = scan(rng, lambda x, y, t=thick: plate(x, y) - t, turn=about_y(180))
        wall = lambda v, t=thick: np.where(v[:, 2] < t / 2, v[:, 2], v[:, 2] - t)  # noqa: E731
        name = f"plate of {thick} mm from both sides, hole of 8 mm"
        cases.append((name, [scan(rng, plate), back], [(0, 0, -1), (0, 0, 1)], wall, 2 * (side - np.pi * 16)))
    for name, clouds, towards, error, true_area in cases:
        start = time.process_time()
        own = uwlts.mesh(*clouds, towards=towards)
        middle = time.process_time()
        vertices, _, faces = poisson(clouds, towards, own.cube_mm)
        end = time.process_time()
        for method, v, f, took in (
            ("uwlts mesh", own.vertices_mm, own.faces, middle - start),
            ("Poisson", vertices, faces, end - middle),
        ):
            off = 1e3 * error(v)
            print(
                f"| {name} | {method} | {np.sqrt(np.mean(off**2)):.1f} | {np.quantile(np.abs(off), 0.99):.0f} | "
                f"{np.abs(off).max():.0f} | {100 * area(v, f) / true_area:.1f} % | {len(v)} | {took:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
