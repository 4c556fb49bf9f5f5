"""A measured point cloud: points with their attributes and uncertainty. `cloud_files` reads and writes it."""

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, assert_never

import numpy as np

from uwlts.argument_types import check_arguments
from uwlts.errors import CaptureError
from uwlts.files.reading import require_plain
from uwlts.model.sensor import Table
from uwlts.model.short_text import Brief
from uwlts.pages.cloud_figure import CloudField

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Stored elements of the symmetric 3x3 covariance matrix: xx, xy, xz, yy, yz, zz."""

FOOTPRINT, FOOTPRINT_STD = "footprint_mm", "footprint_std"
"""Metadata of clouds of sensors at rest: standard deviations of the footprint, the surface area that a point averages,
across the sheet (X) and along the stripe (Y), mm; and the relative standard uncertainty of their squares."""

VERIFIED = "calibration_verified_until"
"""Metadata of clouds whose calibration's file has a valid verification: its end."""
STEP = "coordinate_step_mm"
"""Metadata of clouds of other programs: step of the stored coordinates, mm, if it is more than a micrometre."""
_FINEST_STEP_MM = 1e-3
"""Finer steps are below the uncertainty of any scanner."""
_COARSE_STEP = 0.1
"""Ratio of the step to the point spacing from which there is a warning: the noise of scanners is about as large."""

NO_INDEX = -1
"""Frame and line of points whose file does not state them."""

PER_POINT = ("points_mm", "intensity", "frame", "line")
"""Columns of every cloud."""
KINDS = dict(zip(PER_POINT, (np.float64, np.float32, np.int32, np.int32), strict=True)) | {"deviation_mm": np.float32}
KINDS |= {"time_s": np.float64, "random_std_mm": np.float32, "common_std_mm": np.float32}
"""Types of all columns."""
OPTIONAL = tuple(KINDS)[len(PER_POINT) :]
"""Columns that clouds may lack."""
WATER = "water"
"""Prefix of error names for a medium's index, which may drift between scans."""
_BLOCK = 8192
"""Points whose covariances are summed together: their parts fit in the processor's cache."""
FARTHEST_SINGLE_MM = 16_000.0
"""Beyond this distance 32-bit numbers are coarser than a micrometre."""
FEW_ZEROS = 3
"""Largest number of measured points at exactly 0 0 0."""
_SAMPLE = 2000
"""Points among which a recurring coordinate is searched first, and of the median distance between neighbours: a share
of 0.5 % occurs ten times."""
_STEPS_STD = 20.0
"""Ratio of the distance between the points that give a direction and their noise: 0.07 rad of error, whose cosine
changes the result by 0.3 %."""
_MIXED = np.sqrt([2.0, 3.0, 5.0])
"""Weights whose sum of coordinates differs between places."""
_FARTHEST_MM = 1e12
"""Coordinates of maps in mm reach 1e10; squares and products of larger ones would overflow."""
_LARGEST_ERROR_MM = 1e6
"""A kilometre: no scan is so uncertain, and squares of larger numbers would lose the noise of others."""


@dataclass(frozen=True, eq=False)
class PointUncertainty:
    """Standard uncertainty of points in the OCS, mm.

    Attributes
    ----------
    random_mm2 : (N, 6) float32
        Covariance of each point due to the stripe's noise, independent between points; see `PAIRS`.
    position_mm : (N, 3) float32
        Displacement of each point for one standard deviation of its image's stage position, independent between images.
    patterns_mm : (M, N, 3) float32
        Displacement of each point for one standard deviation of each independent error of calibration, stage and path.
    poses_mm : (K, N, 3) float32 or None
        Displacement of each point for one standard deviation of each independent part of its image's pose, which is
        independent between images.
    shared : dict of str to (M, Q) float64
        Errors shared by clouds, by the name of a calibration of sensor or mount, or of its water (`WATER`): the weight
        of Q independent errors of unit standard deviation in each pattern. Clouds with the same name share them.
    """

    random_mm2: np.ndarray
    position_mm: np.ndarray
    patterns_mm: np.ndarray
    poses_mm: np.ndarray | None = None
    shared: dict[str, np.ndarray] = field(default_factory=dict)

    def __getitem__(self, selection: Any) -> "PointUncertainty":
        """Return the uncertainty of selected points, by a slice, indices or a mask."""
        poses = None if self.poses_mm is None else self.poses_mm[:, selection]
        patterns = self.patterns_mm[:, selection]
        return PointUncertainty(self.random_mm2[selection], self.position_mm[selection], patterns, poses, self.shared)

    def image_errors_mm(self) -> np.ndarray:
        """Return the displacements (1 + K, N, 3) common to an image's points and independent between images."""
        position = self.position_mm[None]
        return position if self.poses_mm is None else np.concatenate([position, self.poses_mm])

    def independent_mm2(self) -> np.ndarray:
        """Return the covariance (N, 6) of each point due to noise and to errors of its image's position and pose."""
        return self.random_mm2 + _sum_pairs(self.image_errors_mm())

    def systematic_mm2(self) -> np.ndarray:
        """Return the covariance (N, 6) of each point due to calibration and stage."""
        return _sum_pairs(self.patterns_mm)

    def covariance_mm2(self) -> np.ndarray:
        """Return the total covariance (N, 3, 3) of each point's coordinates."""
        return expand_covariances(self.independent_mm2() + self.systematic_mm2())

    def std_mm(self) -> np.ndarray:
        """Return the total standard uncertainty (N, 3) of each coordinate."""
        return np.sqrt(np.einsum("nii->ni", self.covariance_mm2()))


def _sum_pairs(parts_mm: np.ndarray) -> np.ndarray:
    """Return the covariances (N, 6) of points displaced by independent parts (M, N, 3); see `PAIRS`."""
    blocks = (parts_mm[:, start : start + _BLOCK] for start in range(0, max(1, parts_mm.shape[1]), _BLOCK))
    axes = (np.ascontiguousarray(block.transpose(2, 0, 1)) for block in blocks)
    return np.concatenate([np.stack([np.einsum("mn,mn->n", x[i], x[j]) for i, j in PAIRS], axis=1) for x in axes])


def expand_covariances(pairs: np.ndarray) -> np.ndarray:
    """Return the symmetric matrices (N, 3, 3) of six numbers each (N, 6), in the order of `PAIRS`."""
    return pairs[:, [PAIRS.index((min(i, j), max(i, j))) for i in range(3) for j in range(3)]].reshape(-1, 3, 3)


def rotate_covariances(pairs: np.ndarray, rotations: np.ndarray) -> np.ndarray:
    """Return covariances (N, 6), in the order of `PAIRS`, after rotations (3, 3) or (N, 3, 3)."""
    matrices = rotations @ expand_covariances(pairs) @ np.swapaxes(rotations, -1, -2)
    return np.stack([matrices[:, i, j] for i, j in PAIRS], axis=1)


def project_image_errors(known: PointUncertainty, normals: np.ndarray) -> np.ndarray:
    """Return the displacements (1 + K, N) along normals (N, 3) for one standard deviation of each error of an image."""
    return np.einsum("kni,ni->kn", known.image_errors_mm(), normals)


def project_variance(pairs: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the variance (N,) along unit directions (N, 3) for covariances (N, 6) in the order of `PAIRS`."""
    parts = [(1 if i == j else 2) * directions[:, i] * directions[:, j] for i, j in PAIRS]
    return np.einsum("ni,in->n", pairs, np.stack(parts))


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud(Brief):
    """Points in the object coordinate system (OCS) and their attributes.

    OCS: X normal to the laser sheet (the direction of the scan), Y along the stripe, Z parallel to the laser's axis,
    away from the sensor.

    Attributes
    ----------
    points_mm : (N, 3) float64
        Position, mm, OCS; finite.
    intensity : (N,) float32
        Brightness of the stripe, in the units of the image; NaN where unknown.
    frame, line : (N,) int32
        Image of the scan and row (or column) of that image; -1 where unknown.
    deviation_mm : (N,) float32 or None
        Signed distance to the fitted or true surface; NaN where not evaluated.
    time_s : (N,) float64 or None
        Time of each point's image on the camera's clock, for scans by a moving platform.
    uncertainty : PointUncertainty or None
        Uncertainty of the points.
    metadata : dict
        Medium, sensor, artefact, capture, digest of the calibration; for a foreign cloud any JSON.
    lines_by_status : dict
        For the cloud of a whole capture, not kept in files: number of profile lines by the name of their
        `StripeStatus`, and ``blurred`` with a joint calibration.
    rays_by_status : dict
        The same for stripe centres by the name of their `RayStatus`.
    warnings : list of str
        Evidence that the calibration is not that of the sensor; and omissions and doubts of the reader of a file.
    random_std_mm, common_std_mm : (N,) float32 or None
        Standard deviations along the surface normal, of clouds whose file holds no more of the uncertainty: by noise
        and errors of single images, and by errors of the calibration that all points share.

    Raises
    ------
    CaptureError
        The shapes of the arrays do not match, points or uncertainties are not finite, variances are negative, or the
        metadata is not JSON.
    """

    points_mm: np.ndarray
    intensity: np.ndarray
    frame: np.ndarray
    line: np.ndarray
    deviation_mm: np.ndarray | None = None
    uncertainty: PointUncertainty | None = None
    time_s: np.ndarray | None = None
    metadata: Table = field(default_factory=dict)
    lines_by_status: dict[str, int] = field(default_factory=dict)
    rays_by_status: dict[str, int] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    random_std_mm: np.ndarray | None = None
    common_std_mm: np.ndarray | None = None
    writer: ClassVar[Callable[..., None]]
    """Function that writes clouds; `uwlts.storage.cloud_files`, which knows the formats, sets it."""

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            if (values := getattr(self, name)) is not None:
                try:
                    column = np.asarray(values, dtype=kind).view()
                except (TypeError, ValueError) as error:
                    raise CaptureError(f"`{name}` of a cloud needs an array of numbers: {error}") from error
                column.flags.writeable = False
                object.__setattr__(self, name, column)
        points = self.points_mm
        if points.ndim != 2 or points.shape[1] != 3:
            raise CaptureError(f"the points of a cloud have the shape (N, 3), not {points.shape}")
        if unusable := np.count_nonzero(~np.isfinite(points).all(axis=1)):
            raise CaptureError(f"{unusable} of {len(points)} points of the cloud are not finite; leave them out")
        if len(points) and (farthest := np.abs(points).max()) > _FARTHEST_MM:
            raise CaptureError(f"a point is {farthest:g} mm from the origin; expected at most {_FARTHEST_MM:g} mm")
        for name in (*PER_POINT[1:], *OPTIONAL):
            column = getattr(self, name)
            if column is not None and column.shape != (len(points),):
                raise CaptureError(f"{name} has the shape {column.shape}; the cloud has {len(points)} points")
        if self.uncertainty is not None:
            known = self.uncertainty
            shapes = known.random_mm2.shape, known.position_mm.shape, known.patterns_mm.shape[1:]
            by_pose = None if known.poses_mm is None else known.poses_mm.shape[1:]
            if shapes != ((len(points), 6), points.shape, points.shape) or by_pose not in (None, points.shape):
                raise CaptureError(f"the uncertainty of {len(points)} points has the shapes {shapes}")
            _require_sound(known)
        metadata_json(self.metadata)

    def __len__(self) -> int:
        return len(self.points_mm)

    @check_arguments
    def save(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the cloud in the format of the ending; raises the errors of `uwlts.storage.cloud_files.write_cloud`.

        .ply, .h5, .xyz (text), .laz, .las, .e57 or .mcap (ROS 2).
        """
        self.writer(path, self, overwrite=overwrite)

    def select(self, selection: slice | np.ndarray) -> "PointCloud":
        """Return the cloud of selected points, by a slice, indices or a mask."""
        known, kept = self.uncertainty, [name for name in KINDS if getattr(self, name) is not None]
        return PointCloud(
            **{name: getattr(self, name)[selection] for name in kept},
            uncertainty=None if known is None else known[selection],
            metadata=self.metadata,
            warnings=self.warnings,
        )

    @check_arguments
    def show(self, colour: CloudField = "depth") -> None:
        """Show the points in 3D, in the output of a notebook's cell, or from a script in the browser.

        The view contains everything that it needs, at most 200,000 points: `select` the part of a large cloud. A script
        writes it to a temporary file, whose path is printed. OutputError if that cannot be written.

        Parameters
        ----------
        colour
            Quantity shown by colour: "depth" Z; "intensity", the brightness of the stripe; "random" or "common", the
            standard uncertainty along the surface normal by noise, or by errors that all points share; or "deviation"
            from the fitted or true surface, limited to two standard deviations.
        """
        # Templates are only needed here.
        from uwlts.pages.cloud_display import display_points, show

        show(display_points(self.points_mm, colour, self.field_values(colour)))

    def field_values(self, field: CloudField) -> np.ndarray | None:
        """Return a quantity (N,) that colours can show, NaN where unknown, in mm or grey values; None if unknown.

        "random" and "common" are standard deviations along the surface normal (`PointCloud.random_std_mm`).
        """
        match field:
            case "depth":
                return self.points_mm[:, 2]
            case "intensity":
                return self.intensity.astype(np.float64)
            case "deviation":
                return None if self.deviation_mm is None else self.deviation_mm.astype(np.float64)
            case "random" | "common":
                std = compute_normal_std(self)[0 if field == "random" else 1]
                return None if std is None else std.astype(np.float64)
            case _:
                assert_never(field)

    @property
    def covariance_mm2(self) -> np.ndarray | None:
        """Total covariance (N, 3, 3) of each point's coordinates, mm2; None if unknown."""
        return None if self.uncertainty is None else self.uncertainty.covariance_mm2()


def _require_sound(known: PointUncertainty) -> None:
    """Raise CaptureError if numbers of an uncertainty are not finite or too large, or variances are negative."""
    parts = {
        "random_mm2": (known.random_mm2, _LARGEST_ERROR_MM**2),
        "position_mm": (known.position_mm, _LARGEST_ERROR_MM),
        "patterns_mm": (known.patterns_mm, _LARGEST_ERROR_MM),
        "poses_mm": (known.poses_mm, _LARGEST_ERROR_MM),
    } | {f"shared_errors of {name}": (each, _LARGEST_ERROR_MM) for name, each in known.shared.items()}
    for name, (values, most) in parts.items():
        # Comparisons with NaN are false.
        if values is not None and values.size and not (values.max() <= most and values.min() >= -most):
            raise CaptureError(f"{name} of the cloud's uncertainty has numbers that are not finite, or above {most:g}")
    if (known.random_mm2[:, [PAIRS.index((axis, axis)) for axis in range(3)]] < 0).any():
        raise CaptureError("the cloud's uncertainty has negative variances (random_mm2)")
    if any(each.ndim != 2 or len(each) != len(known.patterns_mm) for each in known.shared.values()):
        raise CaptureError(f"the shared_errors of the cloud do not belong to its {len(known.patterns_mm)} patterns")


def compute_normal_std(cloud: PointCloud) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the random and the common standard deviation (N,) in mm along the surface normal; None if unknown.

    The random one is by noise and by errors of single images, the common one by errors that all points share. Those
    stored with a cloud are returned if it contains no more.

    The normal is that of the directions to a point on the same image line in another image, and to another point of the
    same image. Of both sides the nearer point is used, which is on the same side of an edge. For a point without such
    neighbours, the direction of its largest standard deviation is used.
    """
    known = cloud.uncertainty
    if known is None:
        return cloud.random_std_mm, cloud.common_std_mm
    normals = np.cross(_find_directions(cloud, known, "frame"), _find_directions(cloud, known, "line"))
    length = np.linalg.norm(normals, axis=1)
    lost = length == 0
    normals = normals / np.where(lost, 1.0, length)[:, None]
    normals[lost] = np.linalg.eigh(known[lost].covariance_mm2().astype(np.float64))[1][:, :, -1]
    random, common = (
        np.sqrt(np.maximum(project_variance(pairs, normals), 0)).astype(np.float32)
        for pairs in (known.independent_mm2(), known.systematic_mm2())
    )
    return random, common


def _find_directions(cloud: PointCloud, known: PointUncertainty, along: str) -> np.ndarray:
    """Return vectors (N, 3) to a neighbour whose ``along`` ("frame" or "line") alone differs; 0 without neighbours."""
    frame, line = cloud.frame.astype(np.int64), cloud.line.astype(np.int64)
    if not len(cloud) or (frame == NO_INDEX).any() or (line == NO_INDEX).any():
        return np.zeros((len(cloud), 3))
    # Lines beyond the last one keep neighbours of the next image apart.
    count = 2 * int(line.max() + 1)
    keys = frame * count + line
    order = np.argsort(keys, kind="stable")
    ordered, unit = keys[order], count if along == "frame" else 1

    def to_neighbours(step: int, lag: int) -> np.ndarray:
        """Return vectors (K, 3) from every ``step``-th point to that whose key differs by ``lag``, else infinite."""
        wanted = keys[::step] + lag
        place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
        found = (ordered[place] == wanted)[:, None]
        return np.where(found, cloud.points_mm[order[place]] - cloud.points_mm[::step], np.inf)

    noise = float(np.sqrt(np.median(known.random_mm2[:, [0, 3, 5]].sum(axis=1))))
    near = np.linalg.norm(to_neighbours(max(1, len(cloud) // _SAMPLE), unit), axis=1)
    spacing = float(np.median(near[near < np.inf])) if (near < np.inf).any() else 0.0
    steps = max(1, int(np.ceil(_STEPS_STD * noise / spacing))) if spacing else 1
    steps = min(steps, max(1, count // 4 if along == "line" else int(np.ptp(frame))))
    sides = [to_neighbours(1, side * steps * unit) for side in (1, -1)]
    lengths = [np.linalg.norm(side, axis=1) for side in sides]
    chosen = np.where((lengths[0] <= lengths[1])[:, None], sides[0], sides[1])
    return np.where(np.isfinite(chosen), chosen, 0.0)


def make_foreign_cloud(
    points_mm: np.ndarray,
    *,
    omitted: Mapping[str, np.ndarray] | None = None,
    step_mm: float = 0.0,
    **columns: np.ndarray | None,
) -> PointCloud:
    """Make a cloud of another program, without uncertainty; raises CaptureError like `PointCloud`.

    ``columns`` (N,) are those of `PointCloud`; None and missing ones are unknown. ``omitted`` maps reasons to masks
    (N,) of points that are omitted, with a warning. Unmeasured points are omitted as well (`omit_points`). ``step_mm``
    is the step of the stored coordinates (`note_step`).
    """
    chosen, warnings = omit_points(points_mm, omitted or {})
    unknown = {"intensity": np.nan, "frame": NO_INDEX, "line": NO_INDEX}
    known = {name: np.full(len(points_mm), value) for name, value in unknown.items()}
    known |= {name: values for name, values in columns.items() if values is not None}
    selected: dict[str, Any] = {name: values[chosen] for name, values in known.items()}
    return note_step(PointCloud(points_mm[chosen], **selected, warnings=warnings), step_mm)


def find_float_step(numbers: np.ndarray) -> float:
    """Return the largest step of numbers (N, 3) that are stored, or were once rounded, in 32 bits; 0 for others."""
    # Far numbers become infinite, and are no 32-bit numbers then.
    with np.errstate(over="ignore"):
        single = numbers.astype(np.float32)
    if not len(numbers) or not np.array_equal(single, numbers, equal_nan=True):
        return 0.0
    return float(np.spacing(np.abs(single).max(initial=0, where=np.isfinite(single))))


def note_step(cloud: PointCloud, step_mm: float) -> PointCloud:
    """Return a cloud with the step of its stored coordinates in its metadata, and with a warning if it is coarse."""
    if step_mm < _FINEST_STEP_MM or not len(cloud):
        return cloud
    sides = np.sort(np.ptp(cloud.points_mm, axis=0))
    spacing = float(np.sqrt(sides[1] * sides[2] / len(cloud)))
    warnings = cloud.warnings
    if step_mm > _COARSE_STEP * spacing:
        warnings = [
            *warnings,
            f"coordinates are stored in steps of {step_mm:.3g} mm, and points are about {spacing:.3g} mm apart: "
            "details are lost, and uncertainties contain the steps. Export with more digits, or with a smaller offset",
        ]
    return replace(cloud, metadata=cloud.metadata | {STEP: step_mm}, warnings=warnings)


def rounding_std_mm(cloud: PointCloud) -> float:
    """Return the standard deviation of a uniform error of one step of the stored coordinates (JCGM 100, 4.3.7)."""
    step = cloud.metadata.get(STEP)
    return step / np.sqrt(12) if isinstance(step, float) and 0 < step < np.inf else 0.0


def omit_points(points_mm: np.ndarray, omitted: Mapping[str, np.ndarray]) -> tuple[slice | np.ndarray, list[str]]:
    """Return the selection of points (N, 3) that are not omitted or unmeasured, and a warning for each reason.

    Programs mark unmeasured points by NaN, infinity, or the place 0 0 0. Points at 0 0 0 are omitted if there are more
    than a few, and many more than at any other place. Other values of z that recur like this have a warning only.
    """
    x, y, z = points_mm.T
    finite, zero = np.isfinite(x) & np.isfinite(y) & np.isfinite(z), (x == 0) & (y == 0) & (z == 0)
    reasons = {"without finite coordinates": ~finite, **omitted}
    if (count := np.count_nonzero(zero)) > FEW_ZEROS:
        # Points in rounded coordinates may coincide anywhere.
        repeated = np.unique(np.sort(points_mm[finite & ~zero] @ _MIXED), return_counts=True)[1].max(initial=1)
        if count > FEW_ZEROS * repeated:
            reasons["at exactly 0 0 0"] = zero
    unwanted, warnings = np.zeros(len(points_mm), bool), []
    for reason, mask in reasons.items():
        if count := int(np.count_nonzero(mask)):
            warnings.append(f"{count} of {len(points_mm)} points {reason} are omitted")
            unwanted |= mask
    chosen = ~unwanted if warnings else slice(None)
    return chosen, [*warnings, *_doubt_recurrence(z[chosen])]


def _doubt_recurrence(z: np.ndarray) -> list[str]:
    """Return a warning if a value of z (N,) occurs more than a few times, and many more times than any other."""
    if not len(z):
        return []
    values, counts = np.unique(z[:: max(1, len(z) // _SAMPLE)], return_counts=True)
    for value in {values[np.argmax(counts)], z.min(), z.max()}:
        count = int(np.count_nonzero(z == value))
        others = z[z != value] if FEW_ZEROS < count < len(z) else z[:0]
        if len(others) and count > FEW_ZEROS * np.unique(others, return_counts=True)[1].max():
            return [
                f"{count} of {len(z)} points have exactly z = {value:.9g}: if this marks unmeasured points, remove them"
            ]
    return []


def concatenate_clouds(parts: Sequence[PointCloud]) -> PointCloud:
    """Concatenate the parts of one cloud."""
    known = [part.uncertainty for part in parts if part.uncertainty is not None]
    poses = [each.poses_mm for each in known if each.poses_mm is not None]
    kept = [name for name in KINDS if all(getattr(part, name) is not None for part in parts)]
    columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in kept}
    return PointCloud(
        **columns,
        uncertainty=PointUncertainty(
            np.concatenate([each.random_mm2 for each in known]),
            np.concatenate([each.position_mm for each in known]),
            np.concatenate([each.patterns_mm for each in known], axis=1),
            np.concatenate(poses, axis=1) if len(poses) == len(parts) else None,
            known[0].shared,
        )
        if len(known) == len(parts)
        else None,
        metadata=parts[0].metadata,
        warnings=list(dict.fromkeys(warning for part in parts for warning in part.warnings)),
    )


def metadata_json(metadata: Table) -> str:
    """Return metadata as text; raises CaptureError if it is not plain JSON."""
    try:
        require_plain(metadata)
        text = json.dumps(metadata, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise CaptureError(f"the metadata of a cloud must be plain JSON without NaN: {error}") from error
    if not isinstance(metadata, dict) or json.loads(text) != metadata:
        raise CaptureError("the metadata of a cloud must be a dict of strings, numbers, booleans, lists and dicts")
    return text
