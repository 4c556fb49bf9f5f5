"""References of a comparison: earlier cloud, mesh with the sides that a scan saw, or ideal shape; and datums."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, assert_never

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError, model_validator
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from uwlts.comparison.local_means import OPTIONS
from uwlts.errors import DescriptionError, EvaluationError, describe_problems
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.files.reading import read_toml
from uwlts.fitting.least_squares import fit_robustly, thin_evenly
from uwlts.fitting.local_surface import POINTS_PER_DISC
from uwlts.model.sensor import Description, Positive, Vector
from uwlts.registration.surface_registration import Registration, SurfaceSample, shape_registration
from uwlts.shapes.cylinder import Cylinder
from uwlts.shapes.flat import Plane
from uwlts.shapes.sphere import Sphere
from uwlts.storage.cloud import PointCloud, rounding_std_mm
from uwlts.storage.cloud_files import is_readable_cloud, load_cloud
from uwlts.storage.mesh_file import has_faces, load_triangles
from uwlts.storage.number_tables import MM_PER_UNIT, Unit

_MOST_FITTED = 50_000  # number of points above which a cloud is thinned for a fit; more take longer without a benefit
_MISFIT_STD = 5.0  # distance of a place from a fitted shape, in standard deviations, beyond which it departs from it
_MISFIT_SIZE = 0.002
"""Least such distance, divided by the radius, or by half the extent of a plane: out of roundness of usual parts."""
_MISFIT_SHARE = 0.4
"""A surface is no such shape if this share of its places or more departs: local changes cover less of it. Judged on the
tubes and bells of tests/uwlts/comparison/test_ideal_misfit.py."""


class _Shape(Description):
    """Ideal shape, fitted to the cloud unless it has a position; ``way`` is the name of its field of a direction."""

    way: ClassVar[str] = ""

    kind: Any  # the literal of each shape
    point_mm: Vector | None = None

    @property
    def radius_mm(self) -> float | None:
        """Known radius; 0 for a plane."""
        size = getattr(self, "diameter_mm", 0.0)
        return None if size is None else size / 2

    @model_validator(mode="after")
    def _check_placed(self) -> Self:
        given = getattr(self, self.way, None)
        if self.way and (self.point_mm is None) != (given is None):
            raise ValueError(f"give both point_mm and {self.way} of the {self.kind}, or neither to fit it")
        if self.point_mm is not None and self.radius_mm is None:
            raise ValueError(f"a {self.kind} with a given {self.way or 'centre'} also needs diameter_mm")
        if given is not None and not any(given):
            raise ValueError(f"the {self.way} is (0, 0, 0); expected a direction")
        return self


class IdealPlane(_Shape):
    """Plane through a point; distances are positive on the side of the normal."""

    way = "normal"

    kind: Literal["plane"] = "plane"
    normal: Vector | None = None


class IdealSphere(_Shape):
    """Sphere; fitted with a free or known diameter unless its centre ``point_mm`` is given."""

    kind: Literal["sphere"] = "sphere"
    diameter_mm: Positive | None = None


class IdealCylinder(_Shape):
    """Cylinder; fitted with a free or known diameter unless ``point_mm`` on its axis and ``axis`` are given."""

    way = "axis"

    kind: Literal["cylinder"] = "cylinder"
    diameter_mm: Positive | None = None
    axis: Vector | None = None


IdealShape = IdealPlane | IdealSphere | IdealCylinder

KINDS: dict[str, IdealShape] = {"plane": IdealPlane(), "sphere": IdealSphere(), "cylinder": IdealCylinder()}
"""Shapes of free size and position, by name."""


def read_shape(path: Path) -> IdealShape:
    """Read an ideal shape from a TOML file; CaptureError or DescriptionError if this fails."""
    return _read_description(path, Annotated[IdealShape, Field(discriminator="kind")], called="ideal shape")


def _read_description(path: Path, kind: Any, *, called: str) -> Any:
    table = read_toml(path, called=called)
    try:
        return TypeAdapter(kind).validate_python(table)
    except ValidationError as error:
        raise DescriptionError(f"{path} contains no valid {called}: {describe_problems(error)}") from error


@dataclass(frozen=True, eq=False)
class PlacedShape:
    """Shape at a position."""

    kind: str
    point_mm: np.ndarray  # (3,); point of the plane, centre of the sphere, or point on the axis
    direction: np.ndarray | None  # (3,) or None; unit normal or axis; None for a sphere
    radius_mm: float  # radius; 0 for a plane
    registration: Registration | None = None  # uncertainty of a fitted shape; None for a given one

    def nearest(self, points_mm: np.ndarray, *, reach_mm: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Return signed distances (N,) and normals (N, 3) of points (N, 3), outwards or along a plane's normal.

        Distances beyond ``reach_mm`` are NaN.
        """
        offset, direction = points_mm - self.point_mm, self.direction
        if self.kind == "plane" and direction is not None:
            normals, distance = np.broadcast_to(direction, offset.shape), offset @ direction
        else:
            if direction is not None:
                offset = offset - np.outer(offset @ direction, direction)
            length = np.linalg.norm(offset, axis=1)
            normals, distance = offset / np.maximum(length, 1e-300)[:, None], length - self.radius_mm
        return np.where(np.abs(distance) <= reach_mm, distance, np.nan), normals

    def note_misfit(self, places_mm: np.ndarray, distance_mm: np.ndarray, variance_mm2: np.ndarray) -> str:
        """Return a note if most of a surface departs from this fitted shape; empty otherwise.

        ``distance_mm`` (P,) are local means at places (P, 3), NaN if farther away than searched, with their variance.
        A local change covers the smaller part of a surface, so that it does not count.
        """
        size = self.radius_mm or 0.5 * float(np.linalg.norm(np.ptp(places_mm, axis=0)))
        limit = np.maximum(_MISFIT_STD * np.sqrt(variance_mm2), _MISFIT_SIZE * size)
        share = float(np.mean(~(np.abs(distance_mm) <= limit)))
        if self.registration is None or share < _MISFIT_SHARE:
            return ""
        return (
            f"; {100 * share:.0f} % of the surface departs by more than {float(np.nanmedian(limit)):.2g} mm: it is no "
            f"{self.kind}, and distances are no local changes"
        )

    def describe(self) -> str:
        """Describe kind, size and position as text."""
        size = f" of {2 * self.radius_mm:.4f} mm diameter" if self.radius_mm else ""
        place = ", ".join(f"{value:.3f}" for value in self.point_mm)
        way = "" if self.direction is None else f", direction ({', '.join(f'{v:.5f}' for v in self.direction)})"
        return f"{self.kind}{size} at ({place}) mm{way}{'' if self.registration is None else ', fitted'}"


def place_shape(shape: IdealShape, cloud: SurfaceSample) -> PlacedShape:
    """Return a given shape, or fit it robustly to the points of a cloud.

    EvaluationError if the points do not determine the shape.
    """
    radius = shape.radius_mm
    if shape.point_mm is not None:
        way = getattr(shape, shape.way, None)
        direction = None if way is None else np.array(way, float) / np.linalg.norm(way)
        return PlacedShape(shape.kind, np.array(shape.point_mm, float), direction, radius or 0.0)
    chosen = thin_evenly(np.arange(len(cloud.points_mm)), _MOST_FITTED)
    points = cloud.points_mm[chosen]
    match shape:
        case IdealPlane():
            robust = fit_robustly(Plane.fit, points, towards=TOWARDS_SENSOR)
            placed = PlacedShape(shape.kind, robust.fit.point_mm, robust.fit.normal, 0.0)
        case IdealSphere():
            robust = fit_robustly(Sphere.fit, points, radius_mm=radius)
            placed = PlacedShape(shape.kind, robust.fit.centre_mm, None, robust.fit.radius_mm)
        case IdealCylinder():
            start = Cylinder.fit(thin_evenly(points, 2000), radius_mm=radius).axis
            robust = fit_robustly(Cylinder.fit, points, radius_mm=radius, axis_start=start)
            placed = PlacedShape(shape.kind, robust.fit.point_mm, robust.fit.axis, robust.fit.radius_mm)
        case _:
            assert_never(shape)
    used = cloud.select(chosen[robust.inliers])
    registration = shape_registration(used, *placed.nearest(used.points_mm), sized=radius is None)
    return replace(placed, registration=registration)


_OPPOSITE = -0.5
"""Largest cosine between the normals of opposite sides: 120 deg, beyond the angle of two faces at an edge."""
_SMOOTH = 0.7  # least absolute cosine between normals of one face: orientation is not carried across an edge of 90 deg
_NEARER = 0.25  # ratio of the distances to both sides below which a place clearly belongs to the nearer one
_BOTH = 0.25
"""Fraction of the places on the other side from which the scan contains both sides. Wear nearly as deep
as the part is thick must cover more than this fraction of a face to be mistaken for its other side."""


def orient_triangles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return faces (F, 3) whose normals agree across edges, in each connected part with most of its area unchanged.

    Parts that have only one side, such as a Moebius strip, are unchanged. Normals of a closed mesh point outwards.
    """
    joined = np.unique(vertices, axis=0, return_inverse=True)[1].reshape(-1)[faces]
    edges, face = joined[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), np.repeat(np.arange(len(faces)), 3)
    forward, edges = edges[:, 0] < edges[:, 1], np.sort(edges, axis=1)
    owner, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)[1:]
    order = np.argsort(owner, kind="stable")
    # Edges of more than two triangles do not determine which of them continue each other.
    order = order[(count == 2)[owner.reshape(-1)[order]]].reshape(-1, 2)
    (one, other), turned = face[order].T, forward[order[:, 0]] == forward[order[:, 1]]
    # Each triangle is two nodes, as it is and turned. Consistent triangles are connected.
    many = len(faces)
    starts, ends = np.concatenate([one, one + many]), np.concatenate([other + many * turned, other + many * ~turned])
    part = connected_components(coo_array((np.ones(len(starts)), (starts, ends)), shape=(2 * many,) * 2))[1]
    one, two = (vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))
    area = np.linalg.norm(np.cross(one, two), axis=1)
    kept = np.bincount(part[:many], area, minlength=part.max() + 1)
    turn = kept[part[many:]] > kept[part[:many]]
    result = faces.copy()
    result[turn] = faces[turn][:, ::-1]
    corners = vertices[result] - vertices[faces].mean(axis=(0, 1))
    return result[:, ::-1] if (count == 2).all() and np.linalg.det(corners).sum() < 0 else result


def select_seen_side(
    places: np.ndarray, samples: np.ndarray, normals: np.ndarray, *, deep_mm: float, apart_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask (M,) of the samples of a mesh on the side that a scan saw, and search depths (P,) at its places.

    If the opposite side lies within the search depth, neighbouring places of a face decide together: the scan saw
    the side to which more of them are nearer. A scan of both sides keeps all samples, and the depth is half of the
    thickness there.

    ``places`` (P, 3) of the scan have a spacing ``apart_mm``; ``samples`` and ``normals`` (M, 3) are those of the mesh.
    """
    nearest = np.asarray(KDTree(samples).query(places, workers=-1)[1])
    facing = normals[nearest]
    # With normals as further coordinates, the nearest sample within the depth has the opposite normal if there is one.
    reach = deep_mm + apart_mm  # a place may lie in a worn part, or between the sides
    six = KDTree(np.hstack([samples, reach * normals]))
    other = np.asarray(six.query(np.hstack([places, -reach * facing]), workers=-1)[1])
    double = np.einsum("pi,pi->p", normals[other], facing) < _OPPOSITE
    double &= np.linalg.norm(samples[other] - places, axis=1) <= reach
    deep = np.full(len(places), deep_mm)
    if not double.any():
        return np.ones(len(samples), bool), deep
    here, there = (np.abs(np.einsum("pi,pi->p", places - samples[index], normals[index])) for index in (nearest, other))
    sign, part = _orient_places(places, facing, apart_mm)
    clear = ~double | (here < _NEARER * there)
    sure = np.bincount(part, clear)
    outwards = np.bincount(part, clear * (sign > 0))
    both = np.minimum(outwards, sure - outwards) > _BOTH * sure
    side = np.where(np.bincount(part, sign) >= 0, 1, -1)
    keeps = np.where(both[part], 1, side[part] * sign)
    nearby, place = KDTree(places).query(samples, workers=-1)
    seen = np.einsum("mi,mi->m", normals, keeps[place, None] * facing[place]) > 0
    # With both sides, the nearest place of a sample may be on the other one.
    seen |= (nearby > reach) | both[part[place]]
    limited = double & seen[np.where(keeps > 0, other, nearest)]
    deep[limited] = (here + there)[limited] / 2
    return seen, deep


def _orient_places(places: np.ndarray, normals: np.ndarray, apart_mm: float) -> tuple[np.ndarray, np.ndarray]:
    """Return signs (P,) that make normals of neighbours on a face agree, and the number (P,) of the face.

    Orientations spread along the minimum spanning tree of the angles (Hoppe et al., SIGGRAPH 1992).
    """
    pairs = KDTree(places).query_pairs(2 * apart_mm, output_type="ndarray")
    cosine = np.einsum("pi,pi->p", normals[pairs[:, 0]], normals[pairs[:, 1]])
    pairs, cosine = pairs[np.abs(cosine) > _SMOOTH], cosine[np.abs(cosine) > _SMOOTH]
    # A weight of zero would be no edge.
    weight = np.maximum(1 - np.abs(cosine), 0) + 1e-6
    tree = minimum_spanning_tree(coo_array((weight, pairs.T), shape=(len(places),) * 2).tocsr())
    count, part = connected_components(tree, directed=False)
    sign = np.ones(len(places))
    for first in np.unique(part, return_index=True)[1] if count else ():
        order, before = breadth_first_order(tree, first, directed=False)
        for place in order[1:]:
            sign[place] = sign[before[place]] * np.sign(normals[place] @ normals[before[place]])
    return sign, part


_SAMPLES_PER_DISC = 60  # samples of a mesh in a disc: twice the points of a cloud, so that the cloud's noise dominates
_MOST_SAMPLES = 3_000_000  # limit of memory for samples of a mesh
_AT_A_TIME = 20_000  # places, to limit memory

Reference = PointCloud | IdealShape | str | os.PathLike[str]


class Datum(Description):
    """Sphere around an unchanged area in the reference's frame. Points in it are used for a registration."""

    centre_mm: Vector
    radius_mm: Positive


class _Datums(Description):
    datum: tuple[Datum, ...]


def read_datums(datums: np.ndarray | str | os.PathLike[str]) -> np.ndarray:
    """Read or check centres and radii (K, 4), mm, from a TOML file with tables [[datum]] or from an array.

    Raises CaptureError, DescriptionError if the file cannot be read or is not valid; EvaluationError if the array has
    another shape, is not finite, or has a radius that is not positive.
    """
    if isinstance(datums, str | os.PathLike):
        known = _read_description(Path(datums), _Datums, called="datums").datum
        datums = np.array([(*each.centre_mm, each.radius_mm) for each in known]).reshape(-1, 4)
    given = np.asarray(datums, float)
    if given.shape[1:] != (4,) or not len(given) or not (np.isfinite(given).all() and (given[:, 3] > 0).all()):
        raise EvaluationError(f"datums are rows of x, y, z and a positive radius in mm; found the shape {given.shape}")
    return given


def read_reference(reference: Reference, *, unit: Unit | None, disc_mm: float) -> SurfaceSample | IdealShape:
    """Read a reference as points in mm, or as an ideal shape from its name (plane, sphere, cylinder) or TOML file."""
    scale = MM_PER_UNIT[unit or "mm"]
    if isinstance(reference, str) and reference in KINDS:
        reference = KINDS[reference]
    if isinstance(reference, str | os.PathLike):
        path = Path(reference)
        if path.suffix.lower() == ".toml":
            reference = read_shape(path)
        elif path.suffix.lower() == ".h5" or (is_readable_cloud(path) and not has_faces(path)):
            return sample_cloud(load_cloud(path, unit=unit))
        else:
            mesh = load_triangles(path, unit=unit)
            return sample_mesh(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), disc_mm=disc_mm)
    if not isinstance(reference, PointCloud):
        return reference
    if scale != 1.0 and reference.uncertainty is not None:
        raise EvaluationError("the unit is m, but clouds with uncertainty are always in mm; omit the unit")
    return sample_cloud(load_cloud(reference), scale)


def sample_cloud(cloud: PointCloud, scale: float = 1.0) -> SurfaceSample:
    points, rounding = scale * cloud.points_mm, scale * rounding_std_mm(cloud)
    return SurfaceSample(points, cloud.uncertainty, cloud.frame, None, rounding, tuple(cloud.warnings))


def stated_variance(std_mm: float | None, *, known: bool, of: str) -> tuple[float, list[str]]:
    """Return the variance of a stated systematic error of a surface, and a warning if its uncertainty is not known.

    ``known`` states whether the surface contains its uncertainty; ``of`` is "cloud" or "reference".

    Raises EvaluationError if the standard deviation is negative or not finite, or would count twice.
    """
    name = f"{of}_std_mm"
    if std_mm is None:
        text = (
            f"no uncertainty of the {of} is known: the level of detection contains its scatter only, not the errors of "
            f"the scanner's calibration. State their standard uncertainty (`{name}`)"
        )
        return 0.0, [] if known else [text]
    if not 0 <= std_mm < np.inf:
        raise EvaluationError(f"`{name}` is {std_mm:g}; expected a standard uncertainty in mm, at least 0")
    if known:
        raise EvaluationError(f"the {of} contains its uncertainty, or has none, as a mesh: omit `{name}`")
    return std_mm**2, []


def sample_mesh(vertices: np.ndarray, faces: np.ndarray, *, disc_mm: float) -> SurfaceSample:
    """Sample points evenly over a mesh, with the normals of their triangles, which agree across edges."""
    corners = vertices[orient_triangles(vertices, faces)]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1) / 2
    total = float(area.sum())
    if total <= 0:
        raise EvaluationError("the total area of the mesh is zero")
    count = int(np.clip(total / (np.pi / 4 * disc_mm**2) * _SAMPLES_PER_DISC, 1000, _MOST_SAMPLES))
    rng = np.random.default_rng(0)
    # Stratified sampling over equal parts of the area, so that chance does not omit a triangle.
    chosen = np.searchsorted(np.cumsum(area) / total, (np.arange(count) + rng.random(count)) / count)
    chosen = np.minimum(chosen, len(faces) - 1)
    u, v = rng.random((2, count))
    inside = u + v > 1
    u[inside], v[inside] = 1 - u[inside], 1 - v[inside]
    first, second, third = corners[chosen].transpose(1, 0, 2)
    points = first + u[:, None] * (second - first) + v[:, None] * (third - first)
    return SurfaceSample(points, normals=across[chosen] / (2 * area[chosen, None] + 1e-300))


def require_enough(points: np.ndarray, name: str) -> np.ndarray:
    if len(points) < POINTS_PER_DISC:
        raise EvaluationError(f"the {name} has {len(points)} points; at least {POINTS_PER_DISC} are needed")
    return points


def require_same_unit(cloud: np.ndarray, reference: np.ndarray) -> None:
    sizes = [float(np.linalg.norm(np.ptp(points, axis=0))) for points in (cloud, reference)]
    if sizes[0] > OPTIONS.other_unit_ratio * sizes[1]:
        raise EvaluationError(
            f"the cloud is {sizes[0]:.4g} mm across and the reference {sizes[1]:.4g} mm. If the reference is in "
            "metres, give `reference_unit` m"
        )
    if sizes[1] > 1000 * OPTIONS.other_unit_ratio * sizes[0]:
        raise EvaluationError(
            f"the cloud is {sizes[0]:.4g} mm across and the reference {sizes[1]:.4g} mm. If the former is in metres, "
            "give `cloud_unit` m"
        )


def fit_local_normals(
    places: np.ndarray, surface: np.ndarray, *, disc_mm: float, given: np.ndarray | None = None
) -> np.ndarray:
    """Return unit normals (P, 3) of a surface near places.

    Normals are ``given`` (M, 3), for the nearest point, or fitted as planes. A plane is fitted to the points within one
    disc diameter, at least eight, and its normal points to the sensor (-Z).
    """
    tree = KDTree(surface)
    if given is not None:
        return given[tree.query(places, workers=-1)[1]]
    result = np.empty_like(places)
    # Neighbours are those of the nearest point. Beside the surface, those of the place itself would form a line.
    middles = surface[tree.query(places, workers=-1)[1]]
    for start in range(0, len(places), _AT_A_TIME):
        here = slice(start, start + _AT_A_TIME)
        distance, neighbours = tree.query(middles[here], k=min(2 * POINTS_PER_DISC, len(surface)), workers=-1)
        kept = ((distance <= np.maximum(disc_mm, distance[:, 7:8])) | (np.arange(distance.shape[1]) < 8))[..., None]
        near = surface[neighbours]
        about = kept * (near - (kept * near).sum(axis=1, keepdims=True) / kept.sum(axis=1, keepdims=True))
        result[here] = np.linalg.eigh(np.einsum("pki,pkj->pij", about, about))[1][:, :, 0]
    return np.where(result @ TOWARDS_SENSOR[:, None] < 0, -result, result)
