"""Change of a surface relative to an earlier cloud, a mesh or an ideal shape, with its level of detection."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, replace
from itertools import chain

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from uwlts.comparison.change_reference import (
    IdealShape,
    Reference,
    fit_local_normals,
    place_shape,
    read_datums,
    read_reference,
    require_enough,
    require_same_unit,
    sample_cloud,
    select_seen_side,
    stated_variance,
)
from uwlts.comparison.local_means import OPTIONS, TWO_SIDED, average_locally
from uwlts.errors import EvaluationError
from uwlts.fitting.local_surface import choose_disc_diameter, number_cubes
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief
from uwlts.registration.surface_registration import Registration, SurfaceSample, register_to_surface, select_within
from uwlts.storage.cloud import WATER, PointCloud, PointUncertainty, rotate_covariances
from uwlts.storage.cloud_files import load_cloud
from uwlts.storage.pose_files import Unit


@dataclass(frozen=True)
class ChangedRegion:
    """Neighbouring places with a significant change of the same sign.

    Distances are signed. ``level_mm`` is the median level of detection, ``extent_mm`` the longest extent.
    """

    centre_mm: tuple[float, float, float]
    places: int
    area_mm2: float
    mean_mm: float
    largest_mm: float
    level_mm: float
    volume_mm3: float
    extent_mm: float


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceChange(Brief):
    """Change at P places of a cloud.

    Attributes
    ----------
    points_mm, normals : (P, 3) float64
        Places in the reference's frame and unit normals of the reference there. Normals point to the sensor (-Z), or
        outwards for a mesh, a sphere or a cylinder.
    distance_mm : (P,) float64
        Local mean of the cloud minus that of the reference, along the normal; NaN where either has fewer than five
        points.
    level_mm : (P,) float64
        Level of detection: 1.96 times the standard uncertainty of the distance.
    area_mm2 : (P,) float64
        Surface area that each place represents.
    apart_mm : float
        Approximate spacing of the places.
    disc_mm, deep_mm : float
        Diameter of the averaging disc and search depth along the normal.
    registration : Registration or None
        Registration that moved the cloud; None without.
    reference : str
        Description of the reference.
    warnings : tuple of str
        Doubts about the clouds, such as unknown uncertainties that the level does not contain.
    stated_std_mm : (float or None, float or None)
        Stated standard uncertainties of systematic errors of the cloud and of the reference, which the level contains.
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
    warnings: tuple[str, ...] = ()
    stated_std_mm: tuple[float | None, float | None] = (None, None)

    @property
    def compared(self) -> np.ndarray:
        """Mask (P,) of places where both surfaces have enough points."""
        return np.isfinite(self.distance_mm)

    @property
    def significant(self) -> np.ndarray:
        """Mask (P,) of places where the distance exceeds its level of detection."""
        return np.abs(self.distance_mm) > self.level_mm

    def regions(self) -> list[ChangedRegion]:
        """Find regions of significant change with at least four places, in descending order of volume."""
        found = []
        for sign in (-1, 1):
            chosen = np.flatnonzero(self.significant & (np.sign(self.distance_mm) == sign))
            if not len(chosen):
                continue
            # Each cube holds one place, so the distance between places of adjacent cubes is up to about two cube sides.
            pairs = KDTree(self.points_mm[chosen]).query_pairs(2 * self.apart_mm, output_type="ndarray")
            links = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(len(chosen),) * 2)
            owner = connected_components(links, directed=False)[1]
            for number in np.flatnonzero(np.bincount(owner) >= OPTIONS.fewest_of_region):
                found.append(self._describe_region(chosen[owner == number]))
        return sorted(found, key=lambda region: -abs(region.volume_mm3))

    def _describe_region(self, members: np.ndarray) -> ChangedRegion:
        distance, area, points = self.distance_mm[members], self.area_mm2[members], self.points_mm[members]
        # Scattered points without neighbours have no area.
        area = area if area.any() else np.ones_like(area)
        centre = np.average(points, axis=0, weights=area)
        extent = np.ptp((points - centre) @ np.linalg.svd(points - centre, full_matrices=False)[2][0])
        return ChangedRegion(
            (float(centre[0]), float(centre[1]), float(centre[2])),
            len(members),
            float(area.sum()),
            float(np.average(distance, weights=area)),
            float(distance[np.argmax(np.abs(distance))]),
            float(np.median(self.level_mm[members])),
            float(distance @ area),
            float(extent),
        )

    def record(self) -> Table:
        """Return everything except the places as JSON."""
        distance, level = self.distance_mm[self.compared], self.level_mm[self.compared]
        area = self.area_mm2[self.compared]
        changed = distance[np.abs(distance) > level]
        found = self.registration
        return {
            "reference": self.reference,
            "warnings": list(self.warnings),
            "cloud_std_mm": self.stated_std_mm[0],
            "reference_std_mm": self.stated_std_mm[1],
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
            "regions": [asdict(region) for region in self.regions()],
            "registration": None
            if found is None
            else {
                "transform": found.transform.tolist(),
                "covariance": found.covariance.tolist(),
                "middle_mm": found.middle_mm.tolist(),
                "open_directions": list(found.open_directions),
                "rms_mm": found.rms_mm,
                "patches": found.counted,
            },
        }

    def lines(self) -> list[str]:
        """Return a summary as text."""
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
            f"regions of change         {len(regions)} with at least {OPTIONS.fewest_of_region} places, "
            f"spacing {self.apart_mm:.3g} mm; "
            f"{np.count_nonzero(self.significant) - sum(each.places for each in regions)} places are in no region",
        ]
        if (found := self.registration) is not None:
            before = np.linalg.inv(found.transform) @ np.append(found.middle_mm, 1)
            shift = np.linalg.norm(found.middle_mm - before[:3])
            turn = np.degrees(Rotation.from_matrix(found.transform[:3, :3]).magnitude())
            lines.append(
                f"registration              moved by {shift:.3f} mm and {turn:.4f} deg, rms {found.rms_mm:.4f} mm"
            )
            lines += [f"  undetermined, not moved: {name}" for name in found.open_directions]
        for name, std in zip(("cloud", "reference"), self.stated_std_mm, strict=True):
            if std is not None:
                lines.append(f"systematic errors         {std:.4g} mm standard uncertainty stated for the {name}")
        return [*lines, *(f"warning: {each}" for each in self.warnings)]


def compare_clouds(
    cloud: PointCloud | str | os.PathLike[str],
    reference: Reference,
    *,
    register: bool = False,
    datums: np.ndarray | str | os.PathLike[str] | None = None,
    disc_mm: float | None = None,
    deep_mm: float | None = None,
    same_water: bool = False,
    reference_unit: Unit | None = None,
    cloud_unit: Unit | None = None,
    cloud_std_mm: float | None = None,
    reference_std_mm: float | None = None,
) -> SurfaceChange:
    """Find where a surface differs from an earlier cloud, a mesh or an ideal shape by more than the uncertainty.

    At each place, the points of both surfaces in a disc perpendicular to the reference's normal are averaged (M3C2:
    Lague, Brodu and Leroux, ISPRS J. 82, 2013). The variance of the distance follows M3C2-EP (Winiwarter, Anders and
    Höfle, ISPRS J. 178, 2021). It has three parts: noise or roughness divided by the number of points, stage position
    errors of each image, and systematic calibration errors, which averaging does not reduce.

    Clouds of one calibration, medium and stage direction share errors of calibration, stage and sheet. These errors
    cancel in the difference. The water's refractive index may drift between the scans and does not cancel, unless
    ``same_water`` is set. A registration or the fit of an ideal shape adds its own uncertainty. It also absorbs
    systematic errors that resemble a rigid motion.

    Parameters
    ----------
    cloud
        Cloud of the surface, or its file (.ply, .h5; from other programs .las, .laz, .e57, or text in mm).
    reference
        Earlier cloud; mesh file (.stl, .obj, .off, or .ply with faces); or ideal shape. "plane", "sphere" or "cylinder"
        fits a shape. A TOML file states its kind and known sizes (docs: compare scans).
    register
        Register the cloud to the reference first; by default both have the same frame. An ideal shape without a
        position is always fitted.
    datums
        Spheres around unchanged areas: a TOML file (tables [[datum]] with centre_mm and radius_mm), or an array (K, 4)
        of centres and radii, mm. Only points in these spheres are used for the registration or fit.
    disc_mm
        Disc diameter; by default the disc holds about 30 points of the sparser surface.
    deep_mm
        Search depth along the normal; by default three disc diameters.
    same_water
        Both clouds were scanned in water of the same temperature and salinity. The error of its refractive index then
        cancels for clouds of one calibration.
    reference_unit
        Unit of the reference, mm or m, if its file does not state it; by default mm.
    cloud_unit
        The same of the cloud.
    cloud_std_mm
        Standard uncertainty of distances by systematic errors of the cloud's scanner, for a cloud without uncertainty.
        It is common to all points, so that averaging does not reduce it.
    reference_std_mm
        The same of the reference, if it is a cloud.

    Returns
    -------
    SurfaceChange
        Distance and level of detection in mm at each compared place of the cloud.

    Raises
    ------
    CaptureError
        A file cannot be read.
    DescriptionError
        A description of an ideal shape or of datums is not valid.
    EvaluationError
        Clouds do not overlap, are too small, seem to have different units, or do not determine the ideal shape.

    Examples
    --------
    >>> change = uwlts.compare_clouds("after.cloud.h5", "before.cloud.h5")
    >>> change.significant.mean(), change.distance_mm[change.significant].min()
    >>> uwlts.compare_clouds("pipe.cloud.h5", "cylinder").regions()
    """
    new = load_cloud(cloud, unit=cloud_unit)
    for name, length in (("disc_mm", disc_mm), ("deep_mm", deep_mm)):
        if length is not None and not 0 < length < np.inf:
            raise EvaluationError(f"{name} is {length:g}; expected a positive length in mm")
    sample = sample_cloud(new)
    disc = disc_mm or choose_disc_diameter(require_enough(new.points_mm, "cloud"), new.frame)
    surface = read_reference(reference, unit=reference_unit, disc_mm=disc)
    exact = not isinstance(surface, SurfaceSample) or surface.meshed or surface.uncertainty is not None
    cloud_variance, own_warnings = stated_variance(cloud_std_mm, known=new.uncertainty is not None, of="cloud")
    other, other_warnings = stated_variance(reference_std_mm, known=exact, of="reference")
    fixed = None if datums is None else read_datums(datums)
    if isinstance(surface, SurfaceSample):
        require_same_unit(new.points_mm, require_enough(surface.points_mm, "reference"))
        if disc_mm is None and not surface.meshed:
            disc = max(disc, choose_disc_diameter(surface.points_mm, surface.frame))
        if fixed is not None and not register:
            raise EvaluationError("datums were given without a registration; set `register`")
    deep = deep_mm or OPTIONS.depth_per_disc * disc
    if isinstance(surface, SurfaceSample):
        sides = _compare_with_points(
            sample, surface, fixed, register=register, disc=disc, deep=deep, same_water=same_water
        )
    else:
        sides = _compare_with_shape(sample, surface, fixed, register=register, disc=disc, deep=deep)
    variance, found = sides.variance_mm2, sides.registration
    if found is not None:
        variance = variance + found.std_along(sides.places, sides.normals) ** 2
    # Rounding errors of neighbouring points are equal where a surface is parallel to an axis, and do not average out.
    samples = [sample, surface] if isinstance(surface, SurfaceSample) else [sample]
    variance = variance + sum(each.rounding_std_mm**2 for each in samples) + cloud_variance + other
    if not np.isfinite(sides.distance_mm).any():
        raise EvaluationError(
            f"the cloud and the reference do not overlap within {deep:g} mm. Check that both have the same frame and "
            "unit, give a larger deep_mm, or register them"
        )
    level, area = TWO_SIDED * np.sqrt(variance), _estimate_areas(sides.places)
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
        tuple(dict.fromkeys([*chain(*(each.warnings for each in samples)), *own_warnings, *other_warnings])),
        (cloud_std_mm, reference_std_mm),
    )


@dataclass(frozen=True, eq=False)
class _Distances:
    """Distances (P,) at places with a spacing ``apart_mm``, and their variance without that of the registration.

    ``registration`` is that of a cloud or a fitted shape; ``moved`` is the one that moved the cloud, if any.
    """

    places: np.ndarray
    apart_mm: float
    normals: np.ndarray
    distance_mm: np.ndarray
    variance_mm2: np.ndarray
    registration: Registration | None
    moved: Registration | None
    reference: str


def _compare_with_points(
    cloud: SurfaceSample,
    surface: SurfaceSample,
    datums: np.ndarray | None,
    *,
    register: bool,
    disc: float,
    deep: float,
    same_water: bool,
) -> _Distances:
    depths: float | np.ndarray = deep
    chosen, spacing = _thin_points(cloud.points_mm, disc / 2)
    if surface.normals is not None:
        seen, depths = select_seen_side(
            cloud.points_mm[chosen], surface.points_mm, surface.normals, deep_mm=deep, apart_mm=spacing
        )
        surface = replace(surface, points_mm=surface.points_mm[seen], normals=surface.normals[seen])
    found = register_to_surface(cloud, surface, reach_mm=deep, datums=datums) if register else None
    if found is not None:
        cloud = _move_cloud(cloud, found)
        if surface.uncertainty is not None:
            # The registration follows systematic errors of the reference.
            followed = found.follow(surface.uncertainty, -found.by_reference, surface.points_mm)
            surface = replace(surface, uncertainty=followed)
    places = cloud.points_mm[chosen]
    normals = fit_local_normals(places, surface.points_mm, disc_mm=disc, given=surface.normals)
    here, there = (average_locally(places, normals, each, disc_mm=disc, deep_mm=depths) for each in (cloud, surface))
    # The samples of a mesh are exact, so their scatter is no noise.
    variance = here.variance_mm2 + (0.0 if surface.meshed else there.variance_mm2)
    variance += np.sum(here.patterns_mm**2, axis=1) + np.sum(there.patterns_mm**2, axis=1)
    known, other = cloud.uncertainty, surface.uncertainty
    if known is not None and other is not None:
        for name in known.shared.keys() & other.shared.keys():
            if same_water or not name.startswith(WATER):
                ours, theirs = here.patterns_mm @ known.shared[name], there.patterns_mm @ other.shared[name]
                variance -= 2 * np.sum(ours * theirs, axis=1)
    text = "mesh" if surface.meshed else "cloud"
    return _Distances(places, spacing, normals, here.mean_mm - there.mean_mm, variance, found, found, text)


def _compare_with_shape(
    cloud: SurfaceSample, shape: IdealShape, datums: np.ndarray | None, *, register: bool, disc: float, deep: float
) -> _Distances:
    fitted = shape.point_mm is None
    if datums is not None and not (register or fitted):
        raise EvaluationError(
            "datums were given without a registration, and this shape has a given position; set `register`"
        )
    chosen = slice(None) if datums is None or not fitted else select_within(cloud.points_mm, datums)
    placed = place_shape(shape, cloud.select(chosen))
    found, moved = placed.registration, None
    if found is not None and cloud.uncertainty is not None:
        normals = placed.nearest(cloud.points_mm)[1]
        cloud = replace(cloud, uncertainty=found.follow(cloud.uncertainty, found.by_cloud, cloud.points_mm, normals))
    elif found is None and register:
        distance, normals = placed.nearest(cloud.points_mm, reach_mm=deep)
        below = cloud.points_mm - distance[:, None] * normals
        target = SurfaceSample(below[np.isfinite(distance)])
        found = moved = register_to_surface(cloud, target, reach_mm=deep, datums=datums)
        cloud = _move_cloud(cloud, found)
    spread, spacing = _thin_points(cloud.points_mm, disc / 2)
    places = cloud.points_mm[spread]
    normals, distance = placed.nearest(places)[1], placed.nearest(cloud.points_mm, reach_mm=deep)[0]
    here = average_locally(places, normals, cloud, distance_mm=distance, disc_mm=disc, deep_mm=deep)
    variance = here.variance_mm2 + np.sum(here.patterns_mm**2, axis=1)
    reference = placed.describe() + placed.note_misfit(places, here.mean_mm, variance)
    return _Distances(places, spacing, normals, here.mean_mm, variance, found, moved, reference)


def _estimate_areas(places: np.ndarray) -> np.ndarray:
    """Return the area (P,) that each place represents, from the disc that holds its nearest neighbours."""
    count = min(OPTIONS.area_neighbours, len(places) - 1)
    if count < 1:
        return np.zeros(len(places))
    distance = np.asarray(KDTree(places).query(places, k=count + 1, workers=-1)[0])[:, -1]
    return np.pi * distance**2 / (count + 0.5)


def _thin_points(points: np.ndarray, spacing: float) -> tuple[np.ndarray, float]:
    """Select one point in each cube of side ``spacing``; return the indices and the side.

    The side grows if there would be too many places.
    """
    while True:
        first = np.sort(np.unique(number_cubes(points - points.min(axis=0), spacing), return_index=True)[1])
        if len(first) <= OPTIONS.most_places:
            return first, spacing
        # The number of cubes on a surface is inversely proportional to the square of their side.
        spacing *= max(np.sqrt(len(first) / OPTIONS.most_places), 1.02)


def _move_cloud(cloud: SurfaceSample, found: Registration) -> SurfaceSample:
    """Move a cloud by a registration; its response to systematic errors is added to their patterns."""
    rotation, known = found.transform[:3, :3], cloud.uncertainty
    points = cloud.points_mm @ rotation.T + found.transform[:3, 3]
    if known is None:
        return replace(cloud, points_mm=points)
    poses = None if known.poses_mm is None else known.poses_mm @ rotation.T
    turned = rotate_covariances(known.random_mm2, rotation), known.position_mm @ rotation.T
    known = PointUncertainty(*turned, known.patterns_mm @ rotation.T, poses, known.shared)
    return replace(cloud, points_mm=points, uncertainty=found.follow(known, found.by_cloud, points))
