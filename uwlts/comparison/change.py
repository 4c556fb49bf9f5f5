"""Change of a surface against an earlier cloud, a mesh or an ideal shape, and where it is more than the uncertainty."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.comparison.change_reference import (
    Reference,
    ReferencePoints,
    local_normals,
    read_datums,
    read_reference,
    require_enough,
    require_same_unit,
)
from uwlts.comparison.ideal_shapes import IdealShape, place_shape
from uwlts.comparison.local_means import TWO_SIDED, LocalMeans, local_means
from uwlts.errors import EvaluationError
from uwlts.fitting.point_spacing import disc_of
from uwlts.model.brief import Brief
from uwlts.model.sensor import Table
from uwlts.registration.surface_registration import Registration, SampledSurface, register_to_surface
from uwlts.storage.cloud import WATER, PointCloud, PointUncertainty, turned_pairs
from uwlts.storage.cloud_files import loaded_cloud
from uwlts.storage.pose_files import Unit

_MOST_PLACES = 20_000
_DEEP = 3.0
"""Times the disc's diameter: how far along the normal the other surface is looked for unless that is given."""
_AREA_NEIGHBOURS = 12
_FEWEST_OF_REGION = 4
"""Places of a region that is listed; discs of neighbouring places overlap, so that chance also makes pairs."""


@dataclass(frozen=True)
class ChangedRegion:
    """Neighbouring places that all rose or all sank significantly.

    Distances are signed, the level of detection is the median of the places', the extent the longest.
    """

    centre_mm: tuple[float, float, float]
    places: int
    area_mm2: float
    mean_mm: float
    largest_mm: float
    level_mm: float
    volume_mm3: float
    extent_mm: float

    def record(self) -> Table:
        """As JSON."""
        return {**asdict(self), "centre_mm": list(self.centre_mm)}


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceChange(Brief):
    """Change at P places of a cloud.

    Attributes
    ----------
    points_mm, normals : (P, 3) float64
        Places in the reference's frame, and unit normals of the reference there, towards the sensor (-Z), or outwards
        of a mesh, a sphere or a cylinder.
    distance_mm : (P,) float64
        Mean of the cloud less that of the reference along the normal; NaN where either has fewer than five points.
    level_mm : (P,) float64
        Level of detection: 1.96 times the standard uncertainty of the distance.
    area_mm2 : (P,) float64
        Area of the surface that each place stands for.
    apart_mm : float
        Distance of the places from each other, about.
    disc_mm, deep_mm : float
        Diameter of the disc of which points are averaged, and how far along the normal they are looked for.
    registration : Registration or None
    reference : str
        What the cloud was compared with, in words.
    """

    points_mm: np.ndarray
    normals: np.ndarray
    distance_mm: np.ndarray
    level_mm: np.ndarray
    area_mm2: np.ndarray
    apart_mm: float
    disc_mm: float
    deep_mm: float
    registration: Registration | None
    reference: str

    @property
    def compared(self) -> np.ndarray:
        """(P,) bool: where both surfaces were seen."""
        return np.isfinite(self.distance_mm)

    @property
    def significant(self) -> np.ndarray:
        """(P,) bool: where the distance exceeds its level of detection."""
        return np.abs(self.distance_mm) > self.level_mm

    def regions(self) -> list[ChangedRegion]:
        """Regions of significant change of at least four places, the largest volumes first."""
        found = []
        for sign in (-1, 1):
            chosen = np.flatnonzero(self.significant & (np.sign(self.distance_mm) == sign))
            if not len(chosen):
                continue
            # One place in each cube: those of neighbouring cubes are up to about two sides apart.
            pairs = KDTree(self.points_mm[chosen]).query_pairs(2 * self.apart_mm, output_type="ndarray")
            links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(chosen),) * 2)
            owner = connected_components(links, directed=False)[1]
            for number in np.flatnonzero(np.bincount(owner) >= _FEWEST_OF_REGION):
                found.append(self._region(chosen[owner == number]))
        return sorted(found, key=lambda region: -abs(region.volume_mm3))

    def _region(self, own: np.ndarray) -> ChangedRegion:
        distance, area, points = self.distance_mm[own], self.area_mm2[own], self.points_mm[own]
        centre = np.average(points, axis=0, weights=area)
        extent = np.ptp((points - centre) @ np.linalg.svd(points - centre, full_matrices=False)[2][0])
        return ChangedRegion(
            (float(centre[0]), float(centre[1]), float(centre[2])),
            len(own),
            float(area.sum()),
            float(np.average(distance, weights=area)),
            float(distance[np.argmax(np.abs(distance))]),
            float(np.median(self.level_mm[own])),
            float(distance @ area),
            float(extent),
        )

    def record(self) -> Table:
        """All but the places as JSON."""
        distance, level = self.distance_mm[self.compared], self.level_mm[self.compared]
        area = self.area_mm2[self.compared]
        changed = distance[np.abs(distance) > level]
        found = self.registration
        return {
            "reference": self.reference,
            "places": len(self.distance_mm),
            "compared": len(distance),
            "compared_area_mm2": float(area.sum()),
            "significant_share": float(np.average(np.abs(distance) > level, weights=area)) if len(distance) else None,
            "mean_mm": float(np.average(distance, weights=area)) if len(distance) else None,
            "rms_mm": float(np.sqrt(np.average(distance**2, weights=area))) if len(distance) else None,
            "level_median_mm": float(np.median(level)) if len(distance) else None,
            "largest_rise_mm": float(max(changed.max(initial=0.0), 0.0)),
            "largest_loss_mm": float(min(changed.min(initial=0.0), 0.0)),
            "apart_mm": self.apart_mm,
            "disc_mm": self.disc_mm,
            "deep_mm": self.deep_mm,
            "regions": [region.record() for region in self.regions()],
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
        known, regions = self.record(), self.regions()
        if not known["compared"]:
            return ["the cloud and the reference do not overlap anywhere"]
        lines = [
            f"reference                 {self.reference}",
            f"places compared           {known['compared']} of {known['places']}, means over {self.disc_mm:.3g} mm",
            f"distance, mm              mean {known['mean_mm']:+.4f}, rms {known['rms_mm']:.4f}",
            f"level of detection, mm    {known['level_median_mm']:.4f} (median; 95 %)",
            f"significant change        {100 * float(str(known['significant_share'])):.1f} % of the area, "
            f"{known['largest_loss_mm']:+.3f} to {known['largest_rise_mm']:+.3f} mm",
            f"regions of change          {len(regions)}, of {_FEWEST_OF_REGION} places or more, {self.apart_mm:.3g} mm "
            f"apart; {np.count_nonzero(self.significant) - sum(each.places for each in regions)} places are in none",
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
    reference: Reference,
    *,
    register: bool = False,
    datums: np.ndarray | str | os.PathLike[str] | None = None,
    disc_mm: float | None = None,
    deep_mm: float | None = None,
    same_water: bool = False,
    unit: Unit = "mm",
) -> SurfaceChange:
    """Find where a surface differs from an earlier cloud, a mesh or an ideal shape by more than the uncertainty.

    At each place the points of both within a disc across the reference's normal are averaged (M3C2: Lague, Brodu and
    Leroux, ISPRS J. 82, 2013). The variance of the distance is that of M3C2-EP (Winiwarter, Anders and Höfle, ISPRS J.
    178, 2021) with the parts that this sensor's points have: noise of single points, or their roughness where that is
    larger, over their number; the stage's position of each image; and what all points share by calibration, which no
    averaging lowers. Of two clouds of one calibration, medium and direction of the stage, what both share of
    calibration, stage and sheet cancels in the difference. The water's index, which may have drifted between them,
    does not, unless ``same_water`` says so. A registration, or the fit of an ideal shape, adds its own, and takes up
    what of the shared errors looks like a movement.

    Parameters
    ----------
    cloud
        Cloud of the surface, or its file (.ply, .h5, .copc.laz; of other programs .las, .e57, and text in mm).
    reference
        Earlier cloud; the file of a mesh (.stl, .obj, .off, or .ply with faces); or an ideal shape: "plane",
        "sphere" or "cylinder" to fit one, or a TOML file with its kind and what is known of it
        (docs/how-to/compare-scans.md).
    register
        Move the cloud onto the reference first; else both have one frame. An ideal shape without a place is fitted
        anyway.
    datums
        TOML file with spheres that hold what has not changed (tables [[datum]] with centre_mm and radius_mm), or these
        as (K, 4) centre and radius in mm: only points in them count for the registration or fit.
    disc_mm
        Diameter of the disc; about 30 points of the sparser side unless given.
    deep_mm
        Largest distance that is looked for; three diameters unless given.
    same_water
        Both clouds were scanned in water of the same temperature and salinity, so that of one calibration its index is
        off by the same.
    unit
        Unit of the reference, mm or m.

    Raises
    ------
    CaptureError
        A file cannot be read.
    DescriptionError
        A description of an ideal shape or of datums is not valid.
    EvaluationError
        Clouds do not overlap, are too small, have sizes as of other units, or do not determine the ideal shape.

    Examples
    --------
    >>> change = uwlts.compare_clouds("after.ply", "before.ply")
    >>> change.significant.mean(), change.distance_mm[change.significant].min()
    >>> uwlts.compare_clouds("pipe.ply", "cylinder").regions()
    """
    new = loaded_cloud(cloud)
    for name, length in (("disc_mm", disc_mm), ("deep_mm", deep_mm)):
        if length is not None and not 0 < length < np.inf:
            raise EvaluationError(f"{name} is {length:g}; expected a positive length in mm")
    disc = disc_mm or disc_of(require_enough(new.points_mm, "cloud"), new.frame)
    surface = read_reference(reference, unit=unit, disc_mm=disc)
    fixed = None if datums is None else read_datums(datums)
    if isinstance(surface, ReferencePoints):
        require_same_unit(new.points_mm, require_enough(surface.points_mm, "reference"))
        if disc_mm is None and not surface.meshed:
            disc = max(disc, disc_of(surface.points_mm, surface.frame))
        if fixed is not None and not register:
            raise EvaluationError("datums hold a registration: ask for that, too (`register`)")
        deep = deep_mm or _DEEP * disc
        sides = _against_points(new, surface, fixed, register=register, disc=disc, deep=deep, same_water=same_water)
    else:
        sides = _against_shape(new, surface, fixed, register=register, disc=disc, deep=deep_mm or _DEEP * disc)
    deep = deep_mm or _DEEP * disc
    variance, found = sides.variance_mm2, sides.registration
    if found is not None:
        variance = variance + found.std_along(sides.places, sides.normals) ** 2
    if not np.isfinite(sides.distance_mm).any():
        raise EvaluationError(
            f"the cloud and the reference do not overlap within {deep:g} mm: do both have the same frame and unit? "
            "Give a larger deep_mm, or register them"
        )
    level, area = TWO_SIDED * np.sqrt(variance), _areas(sides.places)
    return SurfaceChange(
        sides.places,
        sides.normals,
        sides.distance_mm,
        level,
        area,
        sides.apart_mm,
        disc,
        deep,
        sides.moved,
        sides.reference,
    )


@dataclass(frozen=True, eq=False)
class _Sides:
    """Distances (P,) at places that are ``apart_mm``, and their variance without that of the estimate.

    ``moved`` is the registration if it moved the cloud.
    """

    places: np.ndarray
    apart_mm: float
    normals: np.ndarray
    distance_mm: np.ndarray
    variance_mm2: np.ndarray
    registration: Registration | None
    moved: Registration | None
    reference: str


def _against_points(
    new: PointCloud,
    surface: ReferencePoints,
    datums: np.ndarray | None,
    *,
    register: bool,
    disc: float,
    deep: float,
    same_water: bool,
) -> _Sides:
    points, known, other, found = new.points_mm, new.uncertainty, surface.uncertainty, None
    if register:
        target = surface.points_mm
        normals = local_normals(target, target, disc_mm=disc) if surface.normals is None else surface.normals
        sampled = SampledSurface(target, normals, uncertainty=other, frame=surface.frame)
        found = register_to_surface(points, sampled, reach_mm=deep, uncertainty=known, frame=new.frame, datums=datums)
        points, known = _moved(points, known, found)
        if other is not None:
            # The cloud follows what the reference's points share.
            followed = [found.moves_mm(step, target) for step in found.by_reference]
            other = replace(other, patterns_mm=other.patterns_mm - np.array(followed, np.float32))
    chosen, apart = _spread(points, disc / 2)
    places = points[chosen]
    normals = local_normals(places, surface.points_mm, disc_mm=disc, given=surface.normals)
    here = local_means(places, normals, points, uncertainty=known, frame=new.frame, disc_mm=disc, deep_mm=deep)
    there = local_means(
        places, normals, surface.points_mm, uncertainty=other, frame=surface.frame, disc_mm=disc, deep_mm=deep
    )
    # A mesh is what it is: between its samples nothing scatters.
    variance = here.variance_mm2 + (0.0 if surface.meshed else there.variance_mm2)
    variance += np.sum(here.patterns_mm**2, axis=1) + np.sum(there.patterns_mm**2, axis=1)
    if known is not None and other is not None:
        variance -= 2 * _common(here.patterns_mm, known, there.patterns_mm, other, same_water=same_water)
    words = "mesh" if surface.meshed else "cloud"
    return _Sides(places, apart, normals, here.mean_mm - there.mean_mm, variance, found, found, words)


def _against_shape(
    new: PointCloud, shape: IdealShape, datums: np.ndarray | None, *, register: bool, disc: float, deep: float
) -> _Sides:
    points, known, chosen = new.points_mm, new.uncertainty, slice(None)
    if datums is not None:
        if not (register or shape.fitted):
            raise EvaluationError("datums hold a registration or a fit, and this shape has a place: add `register`")
        away = np.linalg.norm(points[:, None] - datums[:, :3], axis=2)
        if shape.fitted:
            chosen = np.flatnonzero(np.any(away <= datums[:, 3], axis=1))
    placed = place_shape(
        shape, points[chosen], uncertainty=None if known is None else known[chosen], frame=new.frame[chosen]
    )
    found, moved = placed.registration, None
    if found is not None and known is not None:
        normals = placed.nearest(points).normals
        followed = [found.moves_mm(step, points, normals) for step in found.by_cloud]
        known = replace(known, patterns_mm=known.patterns_mm + np.array(followed, np.float32))
    elif found is None and register:
        found = moved = register_to_surface(
            points, placed, reach_mm=deep, uncertainty=known, frame=new.frame, datums=datums
        )
        points, known = _moved(points, known, found)
    spread, apart = _spread(points, disc / 2)
    places = points[spread]
    here: LocalMeans = local_means(
        places,
        normals := placed.nearest(places).normals,
        points,
        distance_mm=placed.nearest(points, reach_mm=deep).distance_mm,
        uncertainty=known,
        frame=new.frame,
        disc_mm=disc,
        deep_mm=deep,
    )
    variance = here.variance_mm2 + np.sum(here.patterns_mm**2, axis=1)
    return _Sides(places, apart, normals, here.mean_mm, variance, found, moved, placed.words())


def _common(
    here: np.ndarray, known: PointUncertainty, there: np.ndarray, other: PointUncertainty, *, same_water: bool
) -> np.ndarray:
    """Covariance (P,) of the means of two clouds by what both share, from the moves (P, M) by the patterns of each."""
    result = np.zeros(len(here))
    for name in known.shared.keys() & other.shared.keys():
        if same_water or not name.startswith(WATER):
            result += np.sum((here @ known.shared[name]) * (there @ other.shared[name]), axis=1)
    return result


def _areas(places: np.ndarray) -> np.ndarray:
    """Area (P,) that each place stands for, from the disc about it that holds a dozen others."""
    count = min(_AREA_NEIGHBOURS, len(places) - 1)
    if count < 1:
        return np.zeros(len(places))
    away = np.asarray(KDTree(places).query(places, k=count + 1, workers=-1)[0])[:, -1]
    return np.pi * away**2 / (count + 0.5)


def _spread(points: np.ndarray, apart: float) -> tuple[np.ndarray, float]:
    """Indices of one point in each cube of a size, and that size, larger where there would be too many places."""
    while True:
        cells = np.floor((points - points.min(axis=0)) / apart).astype(np.int64)
        first = np.sort(np.unique(cells, axis=0, return_index=True)[1])
        if len(first) <= _MOST_PLACES:
            return first, apart
        # The number of cubes that a surface meets goes with the square of their size.
        apart *= max(np.sqrt(len(first) / _MOST_PLACES), 1.02)


def _moved(
    points: np.ndarray, known: PointUncertainty | None, found: Registration
) -> tuple[np.ndarray, PointUncertainty | None]:
    """Points after a registration, and their uncertainty with what of the shared errors it takes up."""
    rotation = found.transform[:3, :3]
    points = points @ rotation.T + found.transform[:3, 3]
    if known is None:
        return points, None
    patterns = known.patterns_mm @ rotation.T
    followed = [found.moves_mm(step, points) for step in found.by_cloud]
    patterns = patterns + np.array(followed, np.float32).reshape(patterns.shape)
    poses = None if known.poses_mm is None else known.poses_mm @ rotation.T
    position = known.position_mm @ rotation.T
    random = turned_pairs(known.random_mm2, rotation)
    return points, PointUncertainty(random, position, patterns.astype(np.float32), poses, known.shared)
