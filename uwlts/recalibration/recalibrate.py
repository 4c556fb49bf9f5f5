"""Recalibration of a sensor by overlapping passes over an unknown scene, with known motions between them."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from itertools import combinations
from pathlib import Path
from typing import Any, Self

import numpy as np

from uwlts.calibration.joint.observability import compute_lengths, project_sheet_points, sample_sheet
from uwlts.calibration.joint.stored_estimate import StoredEstimate, read_stored_estimate, require_joint
from uwlts.errors import CalibrationError, CaptureError, DescriptionError, RangeError
from uwlts.fitting.next_observation import CovarianceRoot, Forecast
from uwlts.fitting.patches import find_disc_radius
from uwlts.model.artefacts import Artefact, resolve_artefact
from uwlts.model.calibration import Calibration, KnownMedium, KnownStage, calibration_digest
from uwlts.model.library import load_sensor
from uwlts.model.mount import Mount
from uwlts.model.parameter_keys import ParameterKey
from uwlts.model.sensor import CaptureHeader, Medium, to_rows
from uwlts.model.short_text import Brief
from uwlts.model.trajectory import Trajectory
from uwlts.optics.brightness import select_sharp_lines
from uwlts.recalibration.as_built import as_built
from uwlts.recalibration.next_pass import rank_passes
from uwlts.recalibration.pass_check import split_passes
from uwlts.recalibration.pass_estimate import (
    POOR_FIT,
    MotionUncertainty,
    MountErrors,
    MovedMount,
    Pass,
    PassProblem,
    PassSolution,
    chance,
    move_mount,
    solve_passes,
)
from uwlts.recalibration.surface_cells import CELL, LINES, Cell
from uwlts.reconstruction.moving import add_platform_poses, find_platform_poses
from uwlts.reconstruction.point_uncertainty import estimate_stripe_noise_px, independent_components, window_shift_std_mm
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.calibration_file import read_calibration
from uwlts.storage.capture import Capture, FrameTable, open_captures, sensor_poses
from uwlts.storage.mount_files import read_mount
from uwlts.storage.number_tables import Unit
from uwlts.storage.pose_files import PoseFormat, read_poses, read_trajectory
from uwlts.stripe import StripeSettings, find_stripes

_LENGTH_MM = 100.0
_MOST_POINTS = 15_000
"""Points of a pass: more, of neighbouring lines, have almost the same errors."""
_SHIFTED = 1.0
"""Largest shift by blur or brightness relative to a centre's noise: both are wrong where they are large, at edges. Seen
on rendered pipes, flanges and welds (seeds 1 to 3 of the study), where such points alone contradicted each other."""
_FALSE_ALARM = 0.05
"""Probability of a doubt about right passes, by all tests together."""
_APART = 0.25
"""Least part of a pass's points that agree with a surface of another pass, relative to the best pass."""


@dataclass(frozen=True)
class StatedLength:
    """Standard uncertainty, mm, of 100 mm along an axis in the middle of the scene, before and after the passes."""

    axis: str
    before_mm: float
    after_mm: float


@dataclass(frozen=True)
class ParameterChange:
    """A parameter of the calibration before and after the passes, with standard uncertainties."""

    key: ParameterKey
    before: float
    std_before: float
    after: float
    std: float

    @property
    def determined(self) -> bool:
        """True if the passes halve the standard uncertainty."""
        return self.std < 0.5 * self.std_before

    def line(self) -> str:
        """Describe the change."""
        label = self.key.quantity
        after = label.format_with_std(self.after, self.std)
        return f"{label.words}: {label.format_with_std(self.before, self.std_before)}, now {after}"


@dataclass(frozen=True, eq=False)
class SurfaceParts:
    """Parts of the surface: middle (C, 3) in the frame of the poses, number of passes (C,), and distances (C,).

    ``apart_mm`` is the root mean square distance of the passes from the surface that they share.
    """

    middle_mm: np.ndarray
    passes: np.ndarray
    apart_mm: np.ndarray

    @classmethod
    def of(cls, cells: Sequence[Cell]) -> Self:
        """Return the parts of solved cells."""
        return cls(
            np.array([cell.middle_mm for cell in cells]),
            np.array([len(cell.passes) for cell in cells]),
            np.array([np.sqrt(np.mean(cell.apart_mm**2)) for cell in cells]),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Recalibrated(Brief):
    """Calibration from passes, what they changed, and doubts.

    Attributes
    ----------
    passes : tuple of str
        Names of the captures.
    calibration : Calibration
        The moved calibration with its new covariance.
    lengths : tuple of StatedLength
    parameters : tuple of ParameterChange
    spread : float
        Disagreement of the passes relative to their noise, at least 1.
    parts_before, parts : SurfaceParts
        Parts of the surface that two or more passes see, with the earlier and with the new calibration.
    next_passes : tuple of Forecast
        Further passes, the most helpful one first; ``candidate.pose`` is the pose in the common frame.
    doubts : tuple of str
        Reasons against the new calibration; it should not be used if there are any.
    warnings : tuple of str
        Doubts about single passes, as by `reconstruct`.
    mount : MovedMount or None
        The mount that belongs to the new calibration, if one was given.
    """

    passes: tuple[str, ...]
    calibration: Calibration
    lengths: tuple[StatedLength, ...]
    parameters: tuple[ParameterChange, ...]
    spread: float
    parts_before: SurfaceParts
    parts: SurfaceParts
    next_passes: tuple[Forecast, ...]
    doubts: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    mount: MovedMount | None = None

    def lines(self) -> list[str]:
        """Return a summary as text."""
        lines = [
            f"{len(self.parts.passes)} parts of the surface; the passes' distances scatter {self.spread:.2f} times as "
            "much as their noise (at least 1)"
        ]
        lines += [
            f"100 mm along {each.axis}: standard uncertainty {each.before_mm:.3f} mm before, {each.after_mm:.3f} mm now"
            for each in self.lengths
        ]
        lines += [each.line() for each in self.parameters if each.determined]
        if kept := [each.key.quantity.words for each in self.parameters if not each.determined]:
            lines.append(f"not determined by these passes, known from before: {', '.join(kept)}")
        lines += [] if self.mount is None else self.mount.lines()
        lines += self.advice()
        return lines

    def record(self) -> dict[str, Any]:
        """Return lengths, parameters, advice and doubts as JSON; values in the units of the calibration's estimate."""
        return {
            "lengths_100_mm": [asdict(each) for each in self.lengths],
            "parameters": [
                {"name": each.key.text, "before": each.before, "std_before": each.std_before}
                | {"after": each.after, "std": each.std, "determined": each.determined}
                for each in self.parameters
            ],
            "mount": None
            if self.mount is None
            else self.mount.mount.model_dump(mode="json", exclude={"poses", "inputs"}),
            "parts": len(self.parts.passes),
            "scatter_by_noise": self.spread,
            "next_passes": [
                {"words": each.candidate.words, "pose": each.candidate.pose.tolist()}
                | {"length_std_before_mm": each.before, "length_std_after_mm": each.after}
                for each in self.next_passes
            ],
            "doubts": self.doubts,
            "warnings": self.warnings,
        }

    def advice(self) -> list[str]:
        """Return the most helpful further pass, and the most helpful single motion, as text."""
        if not (self.next_passes and self.next_passes[0].helpful):
            return ["no single further pass would reduce the uncertainty of these lengths by a twentieth"]
        return [
            f"next pass: {each.candidate.words}: 100 mm then to {each.after:.3f} mm instead of {each.before:.3f} mm"
            for number, each in enumerate(self.next_passes)
            if number == 0 or each is next(one for one in self.next_passes if one.candidate.single)
        ]


def recalibrate(
    passes: Sequence[Capture | str | Path],
    *,
    calibration: Calibration | str | Path,
    pose_std_mm: float,
    pose_std_deg: float,
    poses: np.ndarray | str | Path | None = None,
    pose_format: PoseFormat = "matrix",
    pose_unit: Unit | None = None,
    mount: Mount | str | Path | None = None,
    trajectory: Trajectory | str | Path | None = None,
    artefact: Artefact | dict[str, object] | str | Path | None = None,
    stripe: StripeSettings = None,
    progress: ProgressListener = ignore_progress,
) -> Recalibrated:
    """Recalibrate a sensor by overlapping passes over an unknown scene, with known motions between the passes.

    All passes see one surface, so that their disagreement shows the errors of the sensor: index, window, sheet, focal
    length and stage. The earlier calibration is prior knowledge, and what the passes do not determine keeps it.

    Parameters
    ----------
    passes
        Captures of the same scene with one sensor in one medium.
    calibration
        Joint calibration, or the TOML description of a sensor as it was built: its table [uncertainty] is then the
        prior knowledge.
    pose_std_mm, pose_std_deg
        Standard uncertainty of each pass's pose: shift along each axis, and rotation about each axis through the middle
        of its points.
    poses : (K, 4, 4) or path, optional
        Pose of the sensor in each pass, as the transform from its OCS (stage at zero) to a common frame: an array or a
        table. By default the frames have poses, all in one frame; a single pass needs none.
    pose_format, pose_unit
        As for `reconstruct`; of ``poses`` or of the trajectory.
    mount : Mount or path, optional
        Pose of the sensor on its platform (uwlts mount). The poses of the images are then those of the platform, and
        the mount and the offset of the platform's clock are estimated too. By default the mount in a capture is exact.
    trajectory : Trajectory or path, optional
        File with times and poses of the platform, or of the sensor without a mount, as for `reconstruct`. A capture
        with poses is split where the motion turns by more than 90 deg: each part is a pass.
    artefact
        Pipe, step or spheres of known size that all the passes see, as for `evaluate`: known lengths of the job.
    stripe
        As for `reconstruct`.
    progress
        Called with the number of steps done and the total number.

    Returns
    -------
    Recalibrated
        New calibration, uncertainty of lengths before and after, the most helpful next pass, and doubts.

    Raises
    ------
    CaptureError
        A file cannot be read, or the passes are of different sensors or media, or two are the same.
    CalibrationError
        The calibration states no uncertainty or does not fit, or the passes do not overlap.
    EvaluationError
        The passes do not show the artefact.
    RangeError
        A standard uncertainty is not positive.

    Examples
    --------
    >>> found = uwlts.recalibrate(["a.h5", "b.h5", "c.h5"], calibration="old.json", poses="passes.csv",
    ...                           pose_std_mm=0.01, pose_std_deg=0.005)
    """
    artefact = resolve_artefact(artefact)
    given = (
        read_poses(Path(poses), pose_format=pose_format, unit=pose_unit)[0] if isinstance(poses, str | Path) else poses
    )
    if given is not None and len(given) != len(passes):
        raise CaptureError(f"{len(given)} poses are given for {len(passes)} passes: give one for each, in their order")
    if given is not None and (mount is not None or trajectory is not None):
        raise DescriptionError("`poses` are those of the sensor: give either them, or a mount or a trajectory")
    mount = read_mount(mount) if isinstance(mount, str | Path) else mount
    if isinstance(trajectory, str | Path):
        trajectory = read_trajectory(trajectory, pose_format=pose_format, unit=pose_unit)
    known = KnownPasses(
        calibration,
        pose_std_mm=pose_std_mm,
        pose_std_deg=pose_std_deg,
        mount=mount,
        trajectory=trajectory,
        stripe=stripe,
    )
    with open_captures(passes) as scans:
        for scan in scans:
            known.expect(scan)
        for number, scan in enumerate(scans):
            known.add(scan, None if given is None else given[number], alone=len(scans) == 1)
            progress(number + 1, len(scans) + 1)
    found = known.solve(artefact)
    progress(len(scans) + 1, len(scans) + 1)
    return found


class KnownPasses:
    """Passes whose stripes have been found, to be solved together; arguments as for `recalibrate`."""

    def __init__(
        self,
        calibration: Calibration | str | Path,
        *,
        pose_std_mm: float,
        pose_std_deg: float,
        mount: Mount | None = None,
        trajectory: Trajectory | None = None,
        stripe: StripeSettings = None,
    ):
        for name, std in (("pose_std_mm", pose_std_mm), ("pose_std_deg", pose_std_deg)):
            if not std > 0:
                raise RangeError(f"`{name}` is {std:g}; expected a positive number")
        self._given, self._mount, self._trajectory, self._stripe = calibration, mount, trajectory, stripe
        self._std = pose_std_mm, pose_std_deg
        self._first: tuple[str, CaptureHeader, Calibration] | None = None
        self._passes, self._warnings = list[Pass](), list[str]()

    def expect(self, scan: Capture) -> Calibration:
        """Return the earlier calibration; CaptureError if a capture is of another sensor or medium than the first."""
        if self._first is None:
            self._first = scan.path.name, scan.header, _read_prior(self._given, scan.header.medium)
        name, header, prior = self._first
        if scan.header.sensor != header.sensor or scan.header.medium != header.medium:
            raise CaptureError(f"{scan.path.name} is of another sensor or medium than {name}")
        return prior

    def add(self, scan: Capture, pose: np.ndarray | None, *, alone: bool = False) -> None:
        """Find the stripes of a capture; ``alone`` it needs no pose. Errors as `recalibrate`."""
        prior = self.expect(scan)
        if self._mount is None and self._trajectory is None:
            found, doubts = _gather(scan, scan, None, prior, pose, self._stripe, alone=alone)
        else:
            ride = find_platform_poses(scan, self._trajectory, mount=self._mount, clock_offset_s=None)
            posed = add_platform_poses(scan, ride, self._mount)
            found, doubts = _gather(scan, posed, ride.rates, prior, None, self._stripe)
            doubts = [*ride.doubts, *doubts]
        for one, other in combinations([*self._passes, *found], 2):
            if np.array_equal(one.centre_px, other.centre_px):
                raise CaptureError(f"{other.name} holds the same stripes as {one.name}: give each pass once")
        self._passes += found
        self._warnings += [text if scan.path.name in text else f"{scan.path.name}: {text}" for text in doubts]
        exact = "the mount counts as exact: give `mount`, or state poses whose uncertainty contains it"
        if self._mount is None and scan.header.T_platform_sensor is not None and exact not in self._warnings:
            self._warnings.append(exact)

    def solve(self, artefact: Artefact | None = None) -> Recalibrated:
        """Return the calibration by all passes so far, with advice; errors as `recalibrate`."""
        if self._first is None:
            raise CaptureError("no passes are given; a recalibration needs two or more")
        _, header, prior = self._first
        problem = _make_problem(self._passes, prior, header, self._mount, *self._std)
        start = problem.place(np.zeros(problem.unknowns), [np.zeros(len(each.line)) for each in self._passes])
        radius = max(find_disc_radius(start.places_mm[start.number == each]) for each in range(len(self._passes)))
        solution = solve_passes(problem, size_mm=CELL * radius, artefact=artefact)
        found = summarise(problem, solution, prior, header)
        moved = None if self._mount is None else move_mount(self._mount, problem, solution, found.calibration)
        return replace(found, warnings=tuple(self._warnings), mount=moved)


def _read_prior(given: Calibration | str | Path, medium: Medium) -> Calibration:
    """Return a joint calibration: as given, or of a sensor as it was built."""
    if isinstance(given, Calibration):
        prior = given
    else:
        built = Path(given).suffix == ".toml"
        prior = as_built(load_sensor(given), medium) if built else read_calibration(given)
    require_joint(prior)
    return prior


def _make_problem(
    gathered: Sequence[Pass],
    prior: Calibration,
    header: CaptureHeader,
    mount: Mount | None,
    pose_std_mm: float,
    pose_std_deg: float,
) -> PassProblem:
    known = read_stored_estimate(prior, header.sensor, header.medium)
    root, by_stage = independent_components(known, prior, header)
    stated, on_platform = header.sensor.uncertainty, None
    if mount is not None:
        root, by_stage, on_platform = _add_mount(mount, prior, root, by_stage)
    scale = stated.stage_scale if mount is None or mount.robot_scale_std is None else mount.robot_scale_std
    return PassProblem(
        gathered,
        known,
        root,
        by_stage,
        np.array(prior.stage_direction_of(header.stage_direction)),
        window_shift_std_mm(header.sensor),
        header.medium.index_per_kelvin(header.sensor.laser.wavelength_nm) * stated.drift_k,
        MotionUncertainty(pose_std_mm, float(np.radians(pose_std_deg)), scale, stated.stage_position_mm),
        np.vstack([each.pose[:, :3, 3] for each in gathered]).mean(axis=0),
        on_platform,
    )


def _gather(
    scan: Capture,
    table: Capture | FrameTable,
    rates: np.ndarray | None,
    prior: Calibration,
    pose: np.ndarray | None,
    stripe: StripeSettings,
    *,
    alone: bool = False,
) -> tuple[list[Pass], list[str]]:
    """Return the passes of a capture, and warnings.

    ``table`` are its images with the poses of a platform, if there is one, with its ``rates`` (F, 6). A capture
    ``alone`` needs no poses.
    """
    of_frames = sensor_poses(table)
    posed = np.asarray(np.isfinite(of_frames).all(axis=(1, 2)))
    if alone and pose is None and not posed.any():
        pose = np.eye(4)
    if pose is None and not posed[scan.laser_on].all():
        raise CaptureError(f"{scan.path.name} has no poses of its images: give the pose of each pass (`poses`)")
    stripes = find_stripes(scan, options=stripe)
    sharp, blur = select_sharp_lines(stripes)
    stripes = stripes[sharp]
    cloud = reconstruct_stripes(table, stripes, prior)
    key = stripes.frame.astype(np.int64) * (1 + int(stripes.line.max())) + stripes.line
    wanted = cloud.frame.astype(np.int64) * (1 + int(stripes.line.max())) + cloud.line
    chosen = np.flatnonzero(np.isin(key, wanted))
    kept, blur = stripes[chosen], blur[chosen]
    noise = estimate_stripe_noise_px(kept.frame, kept.line, kept.centre_px)
    pass_of = split_passes(cloud) if pose is None else np.zeros(len(cloud.frame), int)
    # At edges, blur and brightness shift the centres by amounts that are known roughly.
    few = np.flatnonzero((np.abs(blur) < _SHIFTED * noise) & (kept.line % LINES == 0) & (pass_of >= 0))
    few = few[:: max(1, len(few) // _MOST_POINTS)]
    kept, noise, points, pass_of = kept[few], noise[few], cloud.points_mm[few], pass_of[few]
    of_images = np.where(posed[:, None, None], of_frames, np.eye(4))
    travel = np.where(posed, 0.0, scan.stage_mm)[kept.frame]
    known = read_stored_estimate(prior, scan.header.sensor, scan.header.medium)
    found = known.triangulate(kept.line, kept.centre_px.astype(np.float64))
    if found is None:
        raise CalibrationError(f"{scan.path.name}: a stripe centre gives no point with this calibration")
    rotation, origin = of_images[kept.frame, :3, :3], of_images[kept.frame, :3, 3]
    direction = np.array(prior.stage_direction_of(scan.header.stage_direction))
    # `reconstruct` adds the shift to the origin of the light, and motion during the exposure.
    beside = np.einsum("nji,nj->ni", rotation, points - origin) - found[0] - travel[:, None] * direction
    even = np.linalg.norm(beside, axis=1) < _SHIFTED * noise * np.linalg.norm(found[1][:, :, 0], axis=1)
    poses_here = of_images if pose is None else pose @ of_images
    if rates is not None:
        # The rates are those of the platform's origin.
        lever = poses_here[:, :3, 3] - table.pose[:, :3, 3]
        rates = np.hstack([rates[:, :3] + np.cross(rates[:, 3:], lever), rates[:, 3:]])
    values = kept.frame, kept.line, kept.centre_px.astype(np.float64), noise, beside, travel
    passes, numbers = [], np.unique(pass_of)
    for number in numbers:
        some = even & (pass_of == number)
        name = scan.path.name if len(numbers) == 1 else f"{scan.path.name}, pass {number + 1}"
        passes.append(Pass(name, *(each[some] for each in values), pose=poses_here, rates=rates))
    return passes, list(cloud.warnings)


def _add_mount(
    mount: Mount, prior: Calibration, root: np.ndarray, by_stage: np.ndarray
) -> tuple[np.ndarray, np.ndarray, MountErrors]:
    """Return the components with those of a mount and of its clock, before the last one, and the errors of the mount.

    A mount that was estimated with the same calibration has a part of its errors in common with it.
    """
    independent, common = mount.independent_covariance(calibration_digest(prior))
    of_mount = CovarianceRoot.from_covariance(independent).root
    by_mount, alone = mount.clock_errors(of_mount)
    mount_root = np.block([[of_mount, np.zeros((6, 1))], [by_mount, np.array(alone)]])
    by = np.zeros((7, root.shape[1]))
    if common is not None:
        by[:6] = common @ root[: common.shape[1]]
    at = np.full(7, root.shape[1] - 1)
    by = np.insert(by, at, 0.0, axis=1)
    by[:, at[0] : at[0] + 7] = mount_root
    return (np.insert(root, at, 0.0, axis=1), np.insert(by_stage, at, 0.0, axis=0), MountErrors(mount.transform(), by))


def summarise(problem: PassProblem, solution: PassSolution, prior: Calibration, header: CaptureHeader) -> Recalibrated:
    """Return the result of a solution for passes with a common header."""
    moved = problem.moved(solution.amplitudes)
    parts = problem.root.shape[1]
    covariance = solution.covariance[:parts, :parts]
    of_parameters = problem.root @ covariance @ problem.root.T
    lengths, by_amplitudes = _state_lengths(problem, solution, moved)
    changes = tuple(
        ParameterChange(key, float(a) + 0.0, float(s), float(b), float(t))  # no negative zero
        for key, a, s, b, t in zip(
            moved.parameters.keys,
            problem.known.values,
            np.sqrt(np.diag(problem.root @ problem.root.T)),
            moved.values,
            np.sqrt(np.diag(of_parameters)),
            strict=True,
        )
    )
    return Recalibrated(
        tuple(each.name for each in problem.passes),
        _build(problem, solution, moved, of_parameters, prior, header),
        lengths,
        changes,
        solution.spread,
        SurfaceParts.of(solution.first_cells),
        SurfaceParts.of(solution.cells),
        tuple(rank_passes(problem, solution, by_amplitudes)),
        tuple(_find_doubts(problem, solution, by_amplitudes)),
    )


def _state_lengths(
    problem: PassProblem, solution: PassSolution, moved: StoredEstimate
) -> tuple[tuple[StatedLength, ...], np.ndarray]:
    """Return the uncertainties of lengths along Y and Z, and their derivatives (2, U) by all amplitudes."""
    local = []
    for each in problem.passes:
        found_points = moved.triangulate(each.line[::97], each.centre_px[::97])
        assert found_points is not None
        local.append(found_points[0])
    middle = np.median(np.vstack(local), axis=0)[1:]
    half, found = np.eye(2) * _LENGTH_MM / 2, []
    while not found:
        at = np.vstack([middle - half, middle + half])
        if np.isfinite(project_sheet_points(moved, at)).all():
            samples = compute_lengths(sample_sheet(moved, at), np.array([0, 1]), np.array([2, 3]))
            found.append(samples.by_parameters * (_LENGTH_MM / samples.length_mm)[:, None])
        half = half / 2
    rows = np.zeros((2, problem.unknowns))
    rows[:, : problem.root.shape[1]] = found[0] @ problem.root
    before = np.linalg.norm(rows, axis=1)
    after = np.sqrt(np.einsum("lu,uv,lv->l", rows, solution.covariance, rows))
    return tuple(StatedLength(*each) for each in zip("YZ", before.tolist(), after.tolist(), strict=True)), rows


def _find_doubts(problem: PassProblem, solution: PassSolution, by_amplitudes: np.ndarray) -> list[str]:
    """Return the reasons against a solution: deviations beyond chance, each of unit variance before the passes.

    ``by_amplitudes`` (2, U) are the derivatives of the lengths.
    """
    lengths = solution.lengths
    limit = _FALSE_ALARM / (len(problem.passes) + 2 + (0 if lengths is None else len(lengths.names)))
    doubts = []
    if solution.spread > POOR_FIT:
        variances = np.concatenate([cell.apart_mm**2 for cell in solution.cells])
        number = np.concatenate([cell.number for cell in solution.cells])
        squares = np.bincount(number, variances) / np.maximum(np.bincount(number), 1)
        doubts.append(
            f"the passes disagree {solution.spread:.1f} times as much as their noise, most of all "
            f"{problem.passes[int(np.argmax(squares))].name}: the scene moved or is too rough, or this pass is of "
            "another scene or mirrored"
        )
    doubts += [
        f"{each.name} does not agree with the others: only {100 * used:.0f} % of its points lie on a surface that "
        "another pass sees: it is mirrored, of another scene, its pose is wrong, or it overlaps too little"
        for each, used in zip(problem.passes, solution.used, strict=True)
        if used < _APART * solution.used.max()
    ]
    unknowns = np.eye(problem.unknowns)
    if (probability := chance(solution.amplitudes, solution.covariance, unknowns[: problem.of_sensor])) < limit:
        doubts.append(
            f"the earlier calibration and the passes contradict each other (probability {probability:.1g}): the sensor "
            "changed by more than it states, or the motion is not as stated"
        )
    if (probability := chance(solution.amplitudes, solution.covariance, np.linalg.qr(by_amplitudes.T)[0].T)) < limit:
        changes = zip("YZ", by_amplitudes @ solution.amplitudes, strict=True)
        doubts.append(
            f"lengths change by more than the earlier calibration states (probability {probability:.1g}), 100 mm along "
            + " and ".join(f"{axis} by {change:+.3f} mm" for axis, change in changes)
            + ": the sensor changed, or poses or stage have another scale"
        )
    names = ("its position", "its direction", "the index of the water")
    for number, each in enumerate(problem.passes):
        columns = problem.of_pass(number)
        if (probability := chance(solution.amplitudes, solution.covariance, unknowns[columns])) < limit:
            step = solution.amplitudes[columns]
            sizes = [np.linalg.norm(step[:3]) / np.sqrt(3), np.linalg.norm(step[3:6]) / np.sqrt(3), abs(step[6])]
            worst = int(np.argmax(sizes))
            doubts.append(
                f"{each.name} does not fit the others (probability {probability:.1g}): {names[worst]} deviates "
                f"{sizes[worst]:.1f} times as much as stated"
            )
    if lengths is not None:
        chances = lengths.chances(solution.amplitudes, solution.covariance)
        doubts += [
            f"the passes contradict the known {name} (probability {chance:.1g}): it is not as stated, or other "
            "surfaces are taken for it"
            for name, chance in zip(lengths.names, chances, strict=True)
            if chance < limit
        ]
    return doubts


def _build(
    problem: PassProblem,
    solution: PassSolution,
    moved: StoredEstimate,
    covariance: np.ndarray,
    prior: Calibration,
    header: CaptureHeader,
) -> Calibration:
    """Return the new calibration; the medium of the passes has the index found, with its covariance."""
    joint, keys = require_joint(prior), moved.parameters.keys
    old = dict(zip(joint.parameters, joint.std_before, strict=True))
    before = np.sqrt(np.diag(problem.root @ problem.root.T))
    index = moved.parameters.medium_index(moved.values, moved.view)
    media = list(prior.media)
    number = moved.view.medium
    if number is not None:
        media[number : number + 1] = [KnownMedium(medium=header.medium, index=index)]
    way = problem.stage_direction(solution.amplitudes)
    way = tuple((way / np.linalg.norm(way)).tolist())
    stages = tuple(
        KnownStage(described=each.described, direction=way)
        if np.allclose(each.described, header.stage_direction)
        else each
        for each in prior.stages
    )
    estimate = joint.model_copy(
        update={
            "parameters": keys,
            "values": tuple(moved.values.tolist()),
            "std": tuple(np.sqrt(np.diag(covariance)).tolist()),
            "std_before": tuple(old.get(key, float(std)) for key, std in zip(keys, before, strict=True)),
            "covariance": to_rows(covariance),
        }
    )
    provenance = prior.provenance | {
        "source": "calibration moved by overlapping passes",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "recalibrated": {"digest": calibration_digest(prior), "passes": [each.name for each in problem.passes]},
    }
    return moved.calibration.model_copy(
        update={"media": tuple(media), "joint": estimate, "provenance": provenance, "stages": stages}
    )
