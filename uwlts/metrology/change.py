"""Change of a surface between two clouds, or from a mesh: distances, and whether they are more than the uncertainty."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.metrology.registration import Registration, register_to_surface
from uwlts.model.errors import CaptureError, EvaluationError
from uwlts.model.input_file import require_regular_file
from uwlts.model.sensor import Table
from uwlts.storage.cloud import PAIRS, PointCloud, PointUncertainty, read_cloud
from uwlts.storage.pose_files import MM_PER_UNIT, Unit, checked_unit

_POINTS_PER_DISC = 30
"""Neighbours in the disc over which points are averaged unless its size is given: their mean's noise is a fifth."""
_FEWEST = 5
"""Points in a disc of each side; with fewer the roughness is not known."""
_MOST_PLACES = 20_000
_DEEP = 3.0
"""Times the disc's diameter: how far along the normal the other surface is looked for unless that is given."""
_TWO_SIDED = 1.96
"""Standard normal quantile of 97.5 %."""
_PAIRS_AT_A_TIME = 2_000_000
_SAMPLES_PER_DISC = 60
_MOST_SAMPLES = 3_000_000
_OTHER_UNIT = 50.0
"""Ratio of sizes from which two things are given in other units; a metre is a thousand millimetres."""


@dataclass(frozen=True, eq=False)
class SurfaceChange:
    """Change at P places of a cloud.

    Attributes
    ----------
    points_mm, normals : (P, 3) float64
        Places in the reference's frame, and unit normals of the reference there, towards the sensor (-Z) or outwards of
        a mesh.
    distance_mm : (P,) float64
        Mean of the cloud less that of the reference along the normal; NaN where either has fewer than five points.
    level_mm : (P,) float64
        Level of detection: 1.96 times the standard uncertainty of the distance.
    disc_mm, deep_mm : float
        Diameter of the disc of which points are averaged, and how far along the normal they are looked for.
    registration : Registration or None
    """

    points_mm: np.ndarray
    normals: np.ndarray
    distance_mm: np.ndarray
    level_mm: np.ndarray
    disc_mm: float
    deep_mm: float
    registration: Registration | None

    @property
    def compared(self) -> np.ndarray:
        """(P,) bool: where both surfaces were seen."""
        return np.isfinite(self.distance_mm)

    @property
    def significant(self) -> np.ndarray:
        """(P,) bool: where the distance exceeds its level of detection."""
        return np.abs(self.distance_mm) > self.level_mm

    def record(self) -> Table:
        """All but the places as JSON."""
        distance, level = self.distance_mm[self.compared], self.level_mm[self.compared]
        changed = distance[np.abs(distance) > level]
        found = self.registration
        return {
            "places": len(self.distance_mm),
            "compared": len(distance),
            "significant_share": float(np.mean(np.abs(distance) > level)) if len(distance) else None,
            "mean_mm": float(np.mean(distance)) if len(distance) else None,
            "rms_mm": float(np.sqrt(np.mean(distance**2))) if len(distance) else None,
            "level_median_mm": float(np.median(level)) if len(distance) else None,
            "largest_rise_mm": float(max(changed.max(initial=0.0), 0.0)),
            "largest_loss_mm": float(min(changed.min(initial=0.0), 0.0)),
            "disc_mm": self.disc_mm,
            "deep_mm": self.deep_mm,
            "registration": None
            if found is None
            else {
                "transform": found.transform.tolist(),
                "covariance": found.covariance.tolist(),
                "middle_mm": found.middle_mm.tolist(),
                "open_directions": list(found.open_directions),
                "rms_mm": found.rms_mm,
                "points": found.points,
            },
        }

    def lines(self) -> list[str]:
        """The summary as text."""
        known = self.record()
        if not known["compared"]:
            return ["the cloud and the reference do not overlap anywhere"]
        lines = [
            f"places compared           {known['compared']} of {known['places']}, means over {self.disc_mm:.3g} mm",
            f"distance, mm              mean {known['mean_mm']:+.4f}, rms {known['rms_mm']:.4f}",
            f"level of detection, mm    {known['level_median_mm']:.4f} (median; 95 %)",
            f"significant change        {100 * float(str(known['significant_share'])):.1f} % of the places, "
            f"{known['largest_loss_mm']:+.3f} to {known['largest_rise_mm']:+.3f} mm",
        ]
        if (found := self.registration) is not None:
            before = np.linalg.inv(found.transform) @ np.append(found.middle_mm, 1)
            shift = np.linalg.norm(found.middle_mm - before[:3])
            turn = np.degrees(Rotation.from_matrix(found.transform[:3, :3]).magnitude())
            lines.append(
                f"registration              moved by {shift:.3f} mm and {turn:.4f} deg, rms {found.rms_mm:.4f} mm"
            )
            lines += [f"  open, left as it was: {name}" for name in found.open_directions]
        return lines


def compare_clouds(
    cloud: PointCloud | str | os.PathLike[str],
    reference: PointCloud | str | os.PathLike[str],
    *,
    register: bool = False,
    disc_mm: float | None = None,
    deep_mm: float | None = None,
    unit: Unit = "mm",
) -> SurfaceChange:
    """Find where a surface differs from an earlier cloud or a mesh by more than the uncertainty.

    At each place the points of both within a disc across the reference's normal are averaged (M3C2: Lague, Brodu and
    Leroux, ISPRS J. 82, 2013). The variance of the distance is that of M3C2-EP (Winiwarter, Anders and Höfle, ISPRS J.
    178, 2021) with the parts that this sensor's points have: noise of single points, or their roughness where that is
    larger, over their number; the stage's position of each image; and what all points share by calibration, which no
    averaging lowers. The two clouds count as calibrated independently, so that of one calibration the level is too
    large rather than too small. The registration adds its own.

    Parameters
    ----------
    cloud
        What was measured; a cloud or its file.
    reference
        An earlier cloud, or the file of a mesh (.stl, .obj, .off, or .ply with faces).
    register
        Move the cloud onto the reference first (`uwlts.metrology.registration`); else their frames are taken as common.
    disc_mm
        Diameter of the disc; about 30 points of the sparser side unless given.
    deep_mm
        Largest distance that is looked for; three diameters unless given.
    unit
        Unit of the reference, mm or m.

    Raises
    ------
    CaptureError
        A file cannot be read.
    EvaluationError
        Clouds do not overlap, are too small, or have sizes as of other units.

    Examples
    --------
    >>> change = uwlts.compare_clouds("after.ply", "before.ply")
    >>> change.significant.mean(), change.distance_mm[change.significant].min()
    """
    new = cloud if isinstance(cloud, PointCloud) else read_cloud(cloud)
    for name, length in (("disc_mm", disc_mm), ("deep_mm", deep_mm)):
        if length is not None and not 0 < length < np.inf:
            raise EvaluationError(f"{name} is {length:g}; expected a positive length in mm")
    disc = disc_mm or _disc_of(_enough(new.points_mm, "cloud"))
    surface = _surface(reference, unit, disc)
    _require_same_unit(new.points_mm, _enough(surface.points_mm, "reference"))
    if disc_mm is None and not surface.meshed:
        disc = max(disc, _disc_of(surface.points_mm))
    deep = deep_mm or _DEEP * disc
    found, points, known = None, new.points_mm, new.uncertainty
    if register:
        target, normals = surface.points_mm, surface.normals
        normals = _normals(target, target, disc) if normals is None else normals
        variance = np.ones(len(points)) if known is None else known.random_mm2[:, [0, 3, 5]].mean(axis=1)
        std = np.sqrt(np.maximum(variance, 1e-6))
        found = register_to_surface(points, target, normals, reach_mm=deep, std_mm=std)
        rotation = found.transform[:3, :3]
        points, known = points @ rotation.T + found.transform[:3, 3], _turned(known, rotation)
    places = points[_spread(points, disc / 2)]
    normals = _normals(places, surface.points_mm, disc, given=surface.normals)
    parts = [
        _side(places, normals, each, uncertainty, frame, disc=disc, deep=deep)
        for each, uncertainty, frame in (
            (points, known, new.frame),
            (surface.points_mm, surface.uncertainty, surface.frame),
        )
    ]
    distance = parts[0][0] - parts[1][0]
    # A mesh is what it is: between its samples nothing scatters.
    variance = parts[0][1] + (0.0 if surface.meshed else parts[1][1])
    if found is not None:
        variance = variance + found.std_along(places, normals) ** 2
    if not np.isfinite(distance).any():
        raise EvaluationError(
            f"the cloud and the reference do not overlap within {deep:g} mm: do both have the same frame and unit? "
            "Give a larger deep_mm, or register them"
        )
    return SurfaceChange(places, normals, distance, _TWO_SIDED * np.sqrt(variance), disc, deep, found)


@dataclass(frozen=True, eq=False)
class _Surface:
    """Points (M, 3) of a reference, their normals where a mesh gives them, and how well they are known."""

    points_mm: np.ndarray
    normals: np.ndarray | None = None
    uncertainty: PointUncertainty | None = None
    frame: np.ndarray | None = None

    @property
    def meshed(self) -> bool:
        return self.normals is not None


def _surface(reference: PointCloud | str | os.PathLike[str], unit: Unit, disc: float) -> _Surface:
    scale = MM_PER_UNIT[checked_unit(unit)]
    if not isinstance(reference, PointCloud):
        if (mesh := _mesh(Path(reference))) is not None:
            vertices, faces = scale * mesh[0], mesh[1]
            return _sampled(vertices, faces, disc)
        reference = read_cloud(reference)
    if scale != 1.0 and reference.uncertainty is not None:
        raise EvaluationError("a cloud with uncertainties is in mm: its unit cannot be m")
    return _Surface(scale * reference.points_mm, None, reference.uncertainty, reference.frame)


def _mesh(path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) and triangles (F, 3) of a file; None where it is a cloud."""
    if path.suffix.lower() == ".h5":
        return None
    import trimesh

    require_regular_file(path, error=CaptureError, called="reference")
    if path.suffix.lower() == ".ply":
        with path.open("rb") as file:
            header = file.read(1 << 20).partition(b"end_header")[0]
        if b"element face" not in header or b"element face 0" in header:
            return None
    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
    except Exception as error:
        # Trimesh raises whatever its parsers do.
        raise CaptureError(f"{path} is no mesh (.stl, .obj, .off, .ply) and no cloud: {error}") from error
    vertices, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces)
    if not len(faces) or not np.isfinite(vertices).all():
        raise CaptureError(f"{path} has no triangles, or vertices that are not finite")
    return vertices, faces


def _sampled(vertices: np.ndarray, faces: np.ndarray, disc: float) -> _Surface:
    """Points spread evenly over a mesh, with the normals of their triangles."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1) / 2
    total = float(area.sum())
    if total <= 0:
        raise EvaluationError("the mesh has no area")
    count = int(np.clip(total / (np.pi / 4 * disc**2) * _SAMPLES_PER_DISC, 1000, _MOST_SAMPLES))
    rng = np.random.default_rng(0)
    # Equal shares of the area, so that no triangle is forgotten by chance.
    chosen = np.searchsorted(np.cumsum(area) / total, (np.arange(count) + rng.random(count)) / count)
    chosen = np.minimum(chosen, len(faces) - 1)
    u, v = rng.random((2, count))
    inside = u + v > 1
    u[inside], v[inside] = 1 - u[inside], 1 - v[inside]
    first, second, third = corners[chosen].transpose(1, 0, 2)
    points = first + u[:, None] * (second - first) + v[:, None] * (third - first)
    return _Surface(points, across[chosen] / (2 * area[chosen, None] + 1e-300))


def _enough(points: np.ndarray, name: str) -> np.ndarray:
    if len(points) < _POINTS_PER_DISC:
        raise EvaluationError(f"the {name} has {len(points)} points; at least {_POINTS_PER_DISC} are needed")
    return points


def _require_same_unit(cloud: np.ndarray, reference: np.ndarray) -> None:
    sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in (cloud, reference)]
    if sizes[0] > _OTHER_UNIT * sizes[1]:
        raise EvaluationError(
            f"the cloud is {sizes[0]:.4g} mm across and the reference {sizes[1]:.4g}: is that in metres? Give --unit m"
        )
    if sizes[1] > 1000 * _OTHER_UNIT * sizes[0]:
        raise EvaluationError(f"the cloud is {sizes[0]:.4g} mm across, the reference {sizes[1]:.4g} mm: is it in mm?")


def _disc_of(points: np.ndarray) -> float:
    """Diameter of discs that hold some thirty points, from the usual distance of the sixth neighbour."""
    sample = points[:: max(1, len(points) // 2000)]
    seventh = KDTree(points).query(sample, k=7)[0][:, 6]
    # A disc of radius r about a point holds six neighbours more: the area for thirty is five times as large.
    return float(2 * np.median(seventh) * np.sqrt(_POINTS_PER_DISC / 6.0))


def _spread(points: np.ndarray, apart: float) -> np.ndarray:
    """Indices of one point in each cube of a size, thinned to `_MOST_PLACES`."""
    cells = np.floor((points - points.min(axis=0)) / apart).astype(np.int64)
    first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
    return first[:: -(-len(first) // _MOST_PLACES)]


def _normals(places: np.ndarray, surface: np.ndarray, disc: float, *, given: np.ndarray | None = None) -> np.ndarray:
    """Unit normals (P, 3) of a surface near places: of the nearest sample of a mesh, or of the plane through points.

    Those of clouds look towards the sensor, to -Z. Points within one disc's diameter are taken, at least eight.
    """
    tree = KDTree(surface)
    if given is not None:
        return given[tree.query(places, workers=-1)[1]]
    result = np.empty_like(places)
    nearest: Any = tree.query(places, k=min(2 * _POINTS_PER_DISC, len(surface)), workers=-1)
    for number, (away, neighbours) in enumerate(zip(*nearest, strict=True)):
        kept = neighbours[(away <= max(disc, away[7])) | (np.arange(len(away)) < 8)]
        about = surface[kept] - surface[kept].mean(axis=0)
        result[number] = np.linalg.eigh(about.T @ about)[1][:, 0]
    return np.where(result[:, 2:] > 0, -result, result)


def _neighbours(tree: KDTree, places: np.ndarray, radius: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Numbers of places and of the points near them, pair by pair, some places at a time."""
    counts = tree.query_ball_point(places, radius, return_length=True, workers=-1)
    part = np.cumsum(counts) // _PAIRS_AT_A_TIME
    for number in np.unique(part):
        chosen = np.flatnonzero(part == number)
        found = tree.query_ball_point(places[chosen], radius, workers=-1)
        lengths = np.array([len(each) for each in found])
        if lengths.sum():
            yield np.repeat(chosen, lengths), np.concatenate([np.asarray(each, np.intp) for each in found])


def _side(
    places: np.ndarray,
    normals: np.ndarray,
    points: np.ndarray,
    known: PointUncertainty | None,
    frame: np.ndarray | None,
    *,
    disc: float,
    deep: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (P,) of the points of one side along the normals from the places, and its variance (P,)."""
    count, mean, variance = (np.zeros(len(places)) for _ in range(3))
    radius = float(np.hypot(disc / 2, deep))
    for place, point in _neighbours(KDTree(points), places, radius):
        away = points[point] - places[place]
        along = np.einsum("ni,ni->n", away, normals[place])
        across = np.einsum("ni,ni->n", away, away) - along**2
        inside = (across <= (disc / 2) ** 2) & (np.abs(along) <= deep)
        place, point, along = place[inside], point[inside], along[inside]
        here = np.unique(place)
        number = np.bincount(place, minlength=len(places))
        total = np.bincount(place, along, minlength=len(places))
        centre = total / np.maximum(number, 1)
        scatter = np.bincount(place, (along - centre[place]) ** 2, minlength=len(places)) / np.maximum(number - 1, 1)
        count[here], mean[here] = number[here], centre[here]
        variance[here] = (scatter / np.maximum(number, 1))[here]
        if known is not None:
            variance[here] = _variance(place, point, normals, known, frame, number, variance)[here]
    mean[count < _FEWEST] = np.nan
    return mean, variance


def _variance(
    place: np.ndarray,
    point: np.ndarray,
    normals: np.ndarray,
    known: PointUncertainty,
    frame: np.ndarray | None,
    number: np.ndarray,
    rough: np.ndarray,
) -> np.ndarray:
    """Variance (P,) of the mean of each place's points along the normal: single points, images, and what all share."""
    size, normal, many = len(number), normals[place], np.maximum(number, 1)
    pairs = known.random_mm2[point]
    single = sum(
        (1 if i == j else 2) * pairs[:, column] * normal[:, i] * normal[:, j] for column, (i, j) in enumerate(PAIRS)
    )
    result = np.maximum(rough, np.bincount(place, single, minlength=size) / many**2)
    image = np.arange(len(point)) if frame is None else frame[point].astype(np.int64)
    # Points of one image move together, those of different images do not.
    group, owner = np.unique(np.column_stack([place, image]), axis=0, return_inverse=True)
    for part in known.by_image_mm():
        moved = np.einsum("ni,ni->n", part[point], normal)
        together = np.bincount(owner.ravel(), moved / many[place])
        result += np.bincount(group[:, 0], together**2, minlength=size)
    for pattern in known.patterns_mm:
        along = np.einsum("ni,ni->n", pattern[point], normal)
        result += (np.bincount(place, along, minlength=size) / many) ** 2
    return result


def _matrices(pairs: np.ndarray) -> np.ndarray:
    """Symmetric matrices (N, 3, 3) of the six numbers each of `PAIRS`."""
    result = np.empty((len(pairs), 3, 3))
    for column, (i, j) in enumerate(PAIRS):
        result[:, i, j] = result[:, j, i] = pairs[:, column]
    return result


def _turned(known: PointUncertainty | None, rotation: np.ndarray) -> PointUncertainty | None:
    if known is None:
        return None
    matrices = rotation @ _matrices(known.random_mm2) @ rotation.T
    pairs = np.stack([matrices[:, i, j] for i, j in PAIRS], axis=1)
    turned = replace(known, random_mm2=pairs, position_mm=known.position_mm @ rotation.T)
    poses = None if known.poses_mm is None else known.poses_mm @ rotation.T
    return replace(turned, patterns_mm=known.patterns_mm @ rotation.T, poses_mm=poses)
