"""Agreement of the project's M3C2-EP with that of py4dgeo on the same clouds; needs `pip install py4dgeo`.

py4dgeo models the covariance of a point by range and angles of a terrestrial scanner, with lengths in m. The clouds
have these errors, so both programs get the same input: a scanner 2 m before a wavy surface with a dent of 0.5 mm, and
noise of 0.03 mm along the beam and 15 urad across. Prints the differences of distances and standard uncertainties.
"""

import numpy as np
from cyclopts import App

import uwlts
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty

RANGE_MM, ANGLE, ORIGIN = 0.03, 1.5e-5, np.array([0.0, 0.0, -2000.0])
TURNED = [2, 0, 1]
"""Order of coordinates for py4dgeo, whose scanner has a pole along its z."""
DISC_MM, DEEP_MM = 4.0, 6.0


def scanned(rng: np.random.Generator, *, dent: float) -> PointCloud:
    """Return a cloud with the errors of a scanner and their covariance."""
    x, y = rng.uniform(-30, 30, (2, 14_000))
    z = 2.0 * np.sin(x / 9.0) + 1.5 * np.cos(y / 7.0) + dent * (np.hypot(x - 10, y - 5) < 5)
    points = np.column_stack([x, y, z])
    away = points - ORIGIN
    length = np.linalg.norm(away, axis=1)[:, None]
    beam = away / length
    first = np.cross(beam, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(beam, first)
    # py4dgeo adds a part that grows with the range, in m: sigma^2 + 1e-6 sigma r^2.
    along = 1e3 * np.sqrt((1e-3 * RANGE_MM) ** 2 + 1e-6 * 1e-3 * RANGE_MM * (1e-3 * length) ** 2)
    steps = [(along, beam), (ANGLE * length, first), (ANGLE * length, second)]
    covariance = np.zeros((len(points), 3, 3))
    for size, way in steps:
        points = points + size * rng.standard_normal((len(points), 1)) * way
        covariance += np.asarray(size**2)[..., None] * np.einsum("ni,nj->nij", way, way)
    pairs = np.stack([covariance[:, i, j] for i, j in PAIRS], axis=1).astype(np.float32)
    nothing = np.zeros_like(points, np.float32)
    known = PointUncertainty(pairs, nothing, np.zeros((0, *points.shape), np.float32))
    count = len(points)
    return PointCloud(points, np.ones(count), np.arange(count), np.zeros(count, int), uncertainty=known)


def main() -> None:
    """Compare and print."""
    # Imported late: the help text does not need it.
    from py4dgeo import Epoch
    from py4dgeo.m3c2ep import M3C2EP

    rng = np.random.default_rng(1)
    before, after = scanned(rng, dent=0.0), scanned(rng, dent=0.5)
    own = uwlts.compare_clouds(after, before, disc_mm=DISC_MM, deep_mm=DEEP_MM)
    scanner = {"origin": 1e-3 * ORIGIN[TURNED], "sigma_range": 1e-3 * RANGE_MM, "sigma_scan": ANGLE, "sigma_yaw": ANGLE}
    epochs = []
    for cloud in (after, before):
        epoch = Epoch(
            1e-3 * cloud.points_mm[:, TURNED], additional_dimensions=np.zeros(len(cloud), [("scanpos_id", "i4")])
        )
        epoch.scanpos_info = [scanner]
        epochs.append(epoch)
    theirs = M3C2EP(
        epochs=tuple(epochs),
        corepoints=1e-3 * own.points_mm[:, TURNED],
        corepoint_normals=own.normals[:, TURNED].copy(),
        cyl_radius=1e-3 * DISC_MM / 2,
        max_distance=1e-3 * DEEP_MM,
        perform_trans=False,
    )
    distance, uncertainty, _ = theirs.run()
    distance = 1e3 * distance
    both = own.compared & np.isfinite(distance)
    count = np.minimum(uncertainty["num_samples1"], uncertainty["num_samples2"])[both]
    std, level = 1e3 * np.hypot(uncertainty["spread1"], uncertainty["spread2"])[both], 1e3 * uncertainty["lodetection"]
    apart, ratio = (own.distance_mm - distance)[both], own.level_mm[both] / 1.96 / std
    print(f"places {both.sum()} of {len(both)}; points of a disc {np.median(count):.0f}")
    print(
        f"distances differ by rms {1e3 * np.sqrt(np.mean(apart**2)):.3f} um, at most {1e3 * np.abs(apart).max():.3f} um"
    )
    print(f"own standard uncertainty over py4dgeo's: median {np.median(ratio):.3f}, times root of points", end=" ")
    print(np.round(np.quantile(ratio * np.sqrt(count), [0.05, 0.5, 0.95]), 3), "(5, 50, 95 %)")
    x, y = own.points_mm.T[:2]
    quiet, dent = both & (np.hypot(x - 10, y - 5) > 8), both & (np.hypot(x - 10, y - 5) < 3)
    error = np.sqrt(np.mean(own.distance_mm[quiet] ** 2))
    print(f"rms distance where nothing changed {error:.4f} mm")
    for name, far, limit in (("own", own.distance_mm, own.level_mm), ("py4dgeo", distance, level)):
        claimed = np.abs(far) > limit
        print(
            f"{name}: level {np.median(limit[both]):.4f} mm; claimed where nothing changed "
            f"{100 * claimed[quiet].mean():.1f} %, in the dent {100 * claimed[dent].mean():.1f} %"
        )


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
