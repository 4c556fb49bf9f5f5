"""Screened Poisson reconstruction by Open3D of the points that docs/studies/rendered_mesh.py saved.

Runs where `pip install open3d` is, apart from the project's environment; normals are Open3D's own from 30 neighbours,
the depth of its octree gives cells of about half a millimetre.
"""

import sys
from pathlib import Path

import numpy as np
import open3d

CELL_MM = 0.5


def main(folder: Path) -> None:
    for path in sorted(folder.glob("mesh-*.npz")):
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(np.load(path)["points"]))
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
        cloud.orient_normals_to_align_with_direction(np.array([0.0, 0.0, -1.0]))
        size = 1.1 * float(np.max(cloud.get_max_bound() - cloud.get_min_bound()))
        depth = int(np.ceil(np.log2(size / CELL_MM)))
        made, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth)
        np.save(path.with_suffix(".poisson.npy"), np.asarray(made.vertices))
        print(path.name, len(made.vertices), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
