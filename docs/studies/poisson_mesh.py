"""Screened Poisson reconstruction, by Open3D, of the points saved by rendered_mesh.py and thin_wall.py.

Needs an environment with Open3D (`pip install open3d`), separate from that of the project. Normals are Open3D's own,
from 30 neighbours, and point towards the sensor. The depth of the octree gives cells of about half a millimetre.
"""

import argparse
from pathlib import Path

import numpy as np

CELL_MM = 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder with the saved points")
    folder = parser.parse_args().folder
    # Imported late: the help text does not need it.
    import open3d

    for path in sorted(folder.glob("mesh-*.npz")):
        if path.stem.endswith(".poisson"):
            continue
        saved = np.load(path)
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(saved["points"]))
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
        normals = np.asarray(cloud.normals)
        towards = saved["towards"] if "towards" in saved else np.array([0.0, 0.0, -1.0])
        away = np.sum(normals * towards, axis=1) < 0
        cloud.normals = open3d.utility.Vector3dVector(np.where(away[:, None], -normals, normals))
        size = 1.1 * float(np.max(cloud.get_max_bound() - cloud.get_min_bound()))
        depth = int(np.ceil(np.log2(size / CELL_MM)))
        made, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth)
        np.savez(path.with_suffix(".poisson.npz"), vertices=np.asarray(made.vertices), faces=np.asarray(made.triangles))
        print(path.name, len(made.vertices), flush=True)


if __name__ == "__main__":
    main()
