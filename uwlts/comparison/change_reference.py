"""References of a comparison (earlier cloud, mesh or ideal shape), the sides of a mesh that a scan saw, and datums."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from uwlts.comparison.ideal_shapes import KINDS, IdealShape, read_shape
from uwlts.comparison.local_means import OPTIONS
from uwlts.errors import DescriptionError, EvaluationError, describe_problems
from uwlts.evaluation.figures import TOWARDS_SENSOR
from uwlts.files.reading import MOST_TOML_BYTES, parse_toml, read_text
from uwlts.fitting.local_surface import POINTS_PER_DISC
from uwlts.model.sensor import Description, Positive, Vector
from uwlts.storage.cloud import PointCloud, PointUncertainty, rounding_std_mm
from uwlts.storage.cloud_files import is_readable_cloud, load_cloud
from uwlts.storage.mesh_file import has_faces, load_triangles
from uwlts.storage.number_tables import MM_PER_UNIT, Unit

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


# --- sides of a mesh --------------------------------------------------------------------------------------------------


_SAMPLES_PER_DISC = 60  # samples of a mesh in a disc: twice the points of a cloud, so that the cloud's noise dominates
_MOST_SAMPLES = 3_000_000  # limit of memory for samples of a mesh
_AT_A_TIME = 20_000  # places, to limit memory

Reference = PointCloud | IdealShape | str | os.PathLike[str]


@dataclass(frozen=True, eq=False)
class ReferencePoints:
    """Points (M, 3) of a cloud with their uncertainty, or samples of a mesh with its normals (M, 3)."""

    points_mm: np.ndarray
    normals: np.ndarray | None = None
    uncertainty: PointUncertainty | None = None
    frame: np.ndarray | None = None
    rounding_std_mm: float = 0.0
    warnings: tuple[str, ...] = ()

    @property
    def meshed(self) -> bool:
        """True for samples of a mesh, which are free of noise."""
        return self.normals is not None


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
        text = read_text(Path(datums), most_bytes=MOST_TOML_BYTES, called="datums", foreign="is not valid TOML")
        try:
            known = _Datums.model_validate(parse_toml(text)).datum
        except ValidationError as error:
            raise DescriptionError(f"{datums} contains no valid datums: {describe_problems(error)}") from error
        except ValueError as error:
            raise DescriptionError(f"{datums} is not valid TOML: {error}") from error
        datums = np.array([(*each.centre_mm, each.radius_mm) for each in known]).reshape(-1, 4)
    given = np.asarray(datums, float)
    if (
        given.ndim != 2
        or given.shape[1] != 4
        or not len(given)
        or not (np.isfinite(given).all() and (given[:, 3] > 0).all())
    ):
        raise EvaluationError(f"datums are rows of x, y, z and a positive radius in mm; found the shape {given.shape}")
    return given


def read_reference(reference: Reference, *, unit: Unit | None, disc_mm: float) -> ReferencePoints | IdealShape:
    """Read a reference as points in mm, or as an ideal shape from its name (plane, sphere, cylinder) or TOML file."""
    scale = MM_PER_UNIT[unit or "mm"]
    if isinstance(reference, str) and reference in KINDS:
        reference = KINDS[reference]
    if isinstance(reference, str | os.PathLike):
        path = Path(reference)
        if path.suffix.lower() == ".toml":
            reference = read_shape(path)
        elif path.suffix.lower() == ".h5" or (is_readable_cloud(path) and not has_faces(path)):
            return _points_of(load_cloud(path, unit=unit), 1.0)
        else:
            mesh = load_triangles(path, unit=unit)
            return sample_mesh(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), disc_mm=disc_mm)
    if not isinstance(reference, PointCloud):
        return reference
    if scale != 1.0 and reference.uncertainty is not None:
        raise EvaluationError("the unit is m, but clouds with uncertainty are always in mm; omit the unit")
    return _points_of(load_cloud(reference), scale)


def _points_of(cloud: PointCloud, scale: float) -> ReferencePoints:
    points, rounding = scale * cloud.points_mm, scale * rounding_std_mm(cloud)
    return ReferencePoints(points, None, cloud.uncertainty, cloud.frame, rounding, tuple(cloud.warnings))


def stated_variance(std_mm: float | None, *, known: bool, of: str) -> tuple[float, list[str]]:
    """Return the variance of a stated systematic error of a surface, and a warning if its uncertainty is not known.

    ``known`` states whether the surface contains its uncertainty; ``of`` is "cloud" or "reference".

    Raises EvaluationError if the standard deviation is negative or not finite, or would count twice.
    """
    name = f"{of}_std_mm"
    if std_mm is None:
        text = (
            f"no uncertainty of the {of} is known: the level of detection contains its scatter only, not the errors of "
            f"the scanner's calibration. State their standard uncertainty ({name})"
        )
        return 0.0, [] if known else [text]
    if not 0 <= std_mm < np.inf:
        raise EvaluationError(f"`{name}` is {std_mm:g}; expected a standard uncertainty in mm, at least 0")
    if known:
        raise EvaluationError(f"the {of} contains its uncertainty, or has none, as a mesh: omit `{name}`")
    return std_mm**2, []


def sample_mesh(vertices: np.ndarray, faces: np.ndarray, *, disc_mm: float) -> ReferencePoints:
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
    return ReferencePoints(points, across[chosen] / (2 * area[chosen, None] + 1e-300))


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
        away, neighbours = tree.query(middles[here], k=min(2 * POINTS_PER_DISC, len(surface)), workers=-1)
        kept = ((away <= np.maximum(disc_mm, away[:, 7:8])) | (np.arange(away.shape[1]) < 8))[..., None]
        near = surface[neighbours]
        about = kept * (near - (kept * near).sum(axis=1, keepdims=True) / kept.sum(axis=1, keepdims=True))
        result[here] = np.linalg.eigh(np.einsum("pki,pkj->pij", about, about))[1][:, :, 0]
    return np.where(result @ TOWARDS_SENSOR[:, None] < 0, -result, result)
