"""Joint estimate of a sensor's errors, of the poses of passes and of the water's index in each, from their overlaps.

All unknowns are amplitudes with a mean of zero and a variance of one before the passes. All passes share the
independent errors of calibration and stage (`independent_components`), and the scale of the poses. Each pass has the
errors of its pose, and a change of the water's index. Each round reconstructs the passes with the moved calibration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from uwlts.calibration.joint.stored_estimate import StoredEstimate
from uwlts.calibration.sequential.sheet_fit import object_frame
from uwlts.errors import CalibrationError
from uwlts.fitting.least_squares import biweight
from uwlts.model.artefacts import Artefact
from uwlts.model.calibration import Calibration, calibration_digest, rigid_transform
from uwlts.model.mount import Mount, SensorShare
from uwlts.model.sensor import to_rows
from uwlts.recalibration.known_lengths import KnownLengths, measure_known_lengths
from uwlts.recalibration.surface_cells import Cell, PassPoints, divide, observe

_ROUNDS = 30  # largest number; eight to twelve are usual
_FREE_ROUNDS = 6
"""Rounds with new cells and outliers; the passes then agree within their noise."""
_SETTLED = 0.05
"""Step in standard uncertainties that ends the iteration: it would add 0.1 % to the standard uncertainty."""
_DETERMINED = 0.3
"""Least fraction of a prior variance that the passes remove in a direction whose deviation is tested. In weaker
directions, ripples of welds alone deviated by 10 standard deviations (seeds 3 and 8 of the study)."""
_NEGLIGIBLE = 1e-12
"""Smallest eigenvalue of the parameters' correlations that is no rounding error."""
POOR_FIT = 2.0
"""Disagreement of passes relative to their noise above which the surface is not the same in all passes."""
OF_PASS = 7
"""Unknowns of a pass: shift, rotation, index."""


@dataclass(frozen=True, eq=False)
class Pass:
    """Stripe centres (N,) of one pass, with all that places their points.

    ``beside_mm`` (N, 3) are shifts of the points to the origin of their light in the OCS. ``travel_mm`` (N,) is the
    position of the stage, and ``frame`` (N,) the image. ``pose`` (F, 4, 4) transforms the OCS of each image, with the
    stage at zero, to the common frame. ``rates`` (F, 6) are the velocity of its origin, mm/s, and its angular velocity,
    rad/s, in that frame, or None without a clock of the platform.
    """

    name: str
    frame: np.ndarray
    line: np.ndarray
    centre_px: np.ndarray
    noise_px: np.ndarray
    beside_mm: np.ndarray
    travel_mm: np.ndarray
    pose: np.ndarray
    rates: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class MountErrors:
    """Errors of a mount (4, 4), ``T_platform_sensor``, that places the OCS of the earlier calibration.

    ``by`` (7, M) are derivatives by the components that all passes share: of its translation, mm, and rotation, rad,
    along the platform's axes, and of the lead of the platform's clock, s.
    """

    transform: np.ndarray
    by: np.ndarray

    def correction(self, components: np.ndarray) -> np.ndarray:
        """Return the transform (4, 4) of points in the OCS that replaces a change of the mount."""
        back = self.transform[:3, :3].T
        shift, turn, _ = np.split(self.by @ components, [3, 6])
        return rigid_transform(Rotation.from_rotvec(back @ turn).as_matrix(), back @ shift)


@dataclass(frozen=True, eq=False)
class MotionUncertainty:
    """Stated standard uncertainties of the motion.

    ``pose_mm`` and ``pose_rad`` are those of each pass's pose, along and about each axis. ``pose_scale`` is that of the
    scale of all poses, and ``image_mm`` that of each position along the stage.
    """

    pose_mm: float
    pose_rad: float
    pose_scale: float
    image_mm: float


@dataclass(frozen=True, eq=False)
class PassSolution:
    """Amplitudes (U,) with their covariance (U, U), and the observed parts of the surface.

    ``first_cells`` are those with the earlier calibration. ``spread`` is the scatter of the passes' distances relative
    to their stated noise, at least 1. ``used`` (K,) is the part of each
    pass's points that agree with a surface of another pass. ``lengths`` are those of an artefact, if it is known.
    """

    amplitudes: np.ndarray
    covariance: np.ndarray
    first_cells: list[Cell]
    cells: list[Cell]
    spread: float
    used: np.ndarray
    lengths: KnownLengths | None


@dataclass(frozen=True, eq=False)
class PassProblem:
    """Passes with a calibration as prior knowledge.

    ``root`` (P, M) are changes of the parameters and ``by_stage`` (M, 3) shifts per mm of travel by the independent
    components; the last one is a shift of the OCS along X by ``window_shift_mm``. ``direction`` (3,) is that of the
    stage before. ``drift`` is the standard uncertainty of the index in each pass. ``middle_mm`` (3,) is the position
    from which the poses' scale counts. Without a ``mount``, the poses are those of the OCS of the true sensor.
    """

    passes: Sequence[Pass]
    known: StoredEstimate
    root: np.ndarray
    by_stage: np.ndarray
    direction: np.ndarray
    window_shift_mm: float
    drift: float
    motion: MotionUncertainty
    middle_mm: np.ndarray
    mount: MountErrors | None = None

    @property
    def of_sensor(self) -> int:
        """Number of unknowns that all passes share: components and the scale of poses."""
        return self.root.shape[1] + 1

    @property
    def unknowns(self) -> int:
        """Number of all unknowns."""
        return self.of_sensor + OF_PASS * len(self.passes)

    def of_pass(self, number: int) -> slice:
        """Return the columns of a pass: shift, rotation, index."""
        start = self.of_sensor + OF_PASS * number
        return slice(start, start + OF_PASS)

    def moved(self, amplitudes: np.ndarray) -> StoredEstimate:
        """Return the estimate with changed parameters (U,), and its covariance before."""
        values = self.known.values + self.root @ amplitudes[: self.root.shape[1]]
        return replace(self.known, values=values, calibration=move_calibration(self.known, values))

    def stage_direction(self, amplitudes: np.ndarray) -> np.ndarray:
        """Return the shift (3,) per mm of travel in the OCS."""
        return self.direction + self.by_stage.T @ amplitudes[: self.root.shape[1]]

    def earlier_from_moved(self, moved: StoredEstimate) -> np.ndarray:
        """Return the transform (4, 4) from the OCS of a moved estimate to that of the earlier calibration."""
        return np.linalg.inv(self.known.calibration.object_transform()) @ moved.calibration.object_transform()

    def place(self, amplitudes: np.ndarray, corrections_px: Sequence[np.ndarray]) -> PassPoints:
        """Return the points of all passes with derivatives, from corrected stripe centres.

        Raises CalibrationError if a centre gives no point.
        """
        known = self.moved(amplitudes)
        parts_of = self.root.shape[1]
        direction, medium = self.stage_direction(amplitudes), known.view.medium
        if self.mount is None:
            rigid, correction = -known.frame_by @ self.root, np.eye(4)
        else:
            back = self.mount.transform[:3, :3].T
            rigid = np.vstack([back @ self.mount.by[:3], back @ self.mount.by[3:6]])
            correction = self.mount.correction(amplitudes[:parts_of]) @ self.earlier_from_moved(known)
        rigid[0, -1] += self.window_shift_mm
        # In air no index drifts.
        place = 0 if medium is None else known.parameters.places[known.parameters.index_key(medium)]
        parts, first = [], 0
        for number, each in enumerate(self.passes):
            columns = self.of_pass(number)
            shift, turn, water = np.split(amplitudes[columns], [3, 6])
            values = known.values + self.drift * water[0] * np.eye(len(known.values))[place]
            estimate = replace(known, values=values)
            found = estimate.triangulate(each.line, each.centre_px + corrections_px[number])
            if found is None:
                raise CalibrationError(f"{each.name}: the passes lead to a calibration that gives no point")
            points, by = found[0] @ correction[:3, :3].T + correction[:3, 3], correction[:3, :3] @ found[1]
            local = np.zeros((len(points), 3, self.unknowns))
            local[:, :, :parts_of] = by[:, :, 1:] @ self.root
            local[:, :, :parts_of] += rigid[:3] + np.cross(rigid[3:].T, points[:, None]).swapaxes(1, 2)
            local[:, :, :parts_of] += each.travel_mm[:, None, None] * self.by_stage.T
            local[:, :, columns.stop - 1] = self.drift * by[:, :, 1 + place]
            points = points + each.beside_mm + each.travel_mm[:, None] * direction
            points[:, 0] += self.window_shift_mm * amplitudes[parts_of - 1]
            rotation, origin = each.pose[each.frame, :3, :3], each.pose[each.frame, :3, 3]
            from_middle = self.motion.pose_scale * (origin - self.middle_mm)
            places = np.einsum("nij,nj->ni", rotation, points) + origin + amplitudes[parts_of] * from_middle
            moved = rotation @ local
            by_px = np.einsum("nij,nj->ni", rotation, by[:, :, 0])
            along = rotation @ direction
            if self.mount is not None and each.rates is not None:
                speed, spin = np.split(each.rates[each.frame], 2, axis=1)
                speed = speed + np.cross(spin, places - origin)
                places = places + speed * (self.mount.by[6] @ amplitudes[:parts_of])
                moved[:, :, :parts_of] += speed[:, :, None] * self.mount.by[6]
            moved[:, :, parts_of] = from_middle
            # Errors of a pose turn about the middle of its points.
            middle = places.mean(axis=0)
            turned = Rotation.from_rotvec(self.motion.pose_rad * turn).as_matrix()
            places = (places - middle) @ turned.T
            moved[:, :, columns.start : columns.start + 3] = self.motion.pose_mm * np.eye(3)
            moved[:, :, columns.start + 3 : columns.start + 6] = self.motion.pose_rad * np.cross(
                np.eye(3)[None], places[:, None]
            ).swapaxes(1, 2)
            places = places + middle + self.motion.pose_mm * shift
            of_images = self.motion.image_mm * along * (np.ptp(each.travel_mm) > 0)
            parts.append(
                PassPoints(
                    places,
                    np.full(len(places), number),
                    moved,
                    by_px,
                    corrections_px[number],
                    each.noise_px,
                    of_images[None],
                    first + each.frame,
                )
            )
            first += len(each.pose)
        joined = (
            np.concatenate([getattr(part, name) for part in parts], axis=int(name == "image_mm"))
            for name in vars(parts[0])
        )
        return PassPoints(*joined)


def move_calibration(known: StoredEstimate, values: np.ndarray) -> Calibration:
    """Return the calibration with other values (P,) of the estimate's parameters; its record of evidence is kept."""
    parameters = known.parameters
    sheet = parameters.sheet_model(values)
    frame = object_frame(sheet, laser_axis=parameters.sheet.axis)
    return known.calibration.model_copy(
        update={
            "camera": parameters.camera(values),
            "window": parameters.window_model(values),
            "sheet": sheet,
            "camera_from_object": to_rows(frame),
        }
    )


def solve_passes(problem: PassProblem, *, size_mm: float, artefact: Artefact | None = None) -> PassSolution:
    """Solve for the amplitudes from cells of a size and an artefact of known lengths.

    Raises CalibrationError if the passes do not overlap or the iteration does not converge, and EvaluationError if
    they do not show the artefact.
    """
    amplitudes = np.zeros(problem.unknowns)
    none = [np.zeros(len(each.line)) for each in problem.passes]
    corrections, first_cells, lengths = none, [], None
    ends = np.cumsum([len(each.line) for each in problem.passes])[:-1]
    spread, step = 1.0, np.zeros(problem.unknowns)
    cell_of = weights = used = np.empty(0)
    for done in range(_ROUNDS):
        points = problem.place(amplitudes, corrections)
        if done < _FREE_ROUNDS:
            cell_of = divide(points.places_mm, size_mm)
        cells = observe(points, cell_of, spread, keep=done > _FREE_ROUNDS)
        first_cells = first_cells or cells
        if done == _FREE_ROUNDS:
            if artefact is not None:
                placed, first = problem.place(amplitudes, none), problem.passes[0].pose
                lengths = measure_known_lengths(placed, amplitudes, artefact, pose=first[len(first) // 2])
            number = np.concatenate([cell.number for cell in cells])
            used = np.bincount(number, minlength=len(none)) / [len(each) for each in none]
            # Points and weights stay, so that the iteration converges.
            cell_of = np.full(len(points.number), -1)
            for number, cell in enumerate(cells):
                cell_of[cell.some] = number
            weights, spread = weigh(np.array([cell.offset_square for cell in cells]))
        elif done < _FREE_ROUNDS:
            weights = np.ones(len(cells))
        total, gradient = normal_equations(cells, weights, amplitudes)
        if lengths is not None:
            total += lengths.rows.T @ lengths.rows
            gradient += lengths.rows.T @ lengths.residuals(amplitudes)
        step = -np.linalg.solve(total, gradient)
        amplitudes = amplitudes + step
        corrections = np.split(_correct(cells, points, step), ends)
        if done > _FREE_ROUNDS and np.max(np.abs(step) / np.sqrt(np.diag(np.linalg.inv(total)))) < _SETTLED:
            break
    else:
        raise CalibrationError(
            f"the passes do not converge: the last step was {np.abs(step).max():.2g} prior standard uncertainties; "
            "give better poses or a better calibration"
        )
    covariance = estimate_covariance(cells, weights, total, points, lengths)
    return PassSolution(amplitudes, covariance, first_cells, cells, spread, used, lengths)


def weigh(squares: np.ndarray) -> tuple[np.ndarray, float]:
    """Return weights (C,) of cells by their whitened disagreement, and Birge's ratio of it to the noise, at least 1."""
    weights = biweight(np.sqrt(squares / max(float(np.median(squares)), 1e-12)))
    return weights, max(1.0, float(np.sqrt(np.mean(squares[weights > 0]))))


def normal_equations(
    cells: Sequence[Cell], weights: np.ndarray, amplitudes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix (U, U) and the gradient (U,) of prior knowledge and of weighted cells."""
    total, gradient = np.eye(len(amplitudes)), amplitudes.copy()
    for cell, weight in zip(cells, weights, strict=True):
        rows = cell.apart.T @ cell.rows
        total += weight * rows.T @ rows
        gradient += weight * rows.T @ (cell.apart.T @ cell.residuals)
    return total, gradient


def _correct(cells: Sequence[Cell], points: PassPoints, step: np.ndarray) -> np.ndarray:
    """Return the corrections (N,) of all stripe centres after a step: their part of the residuals."""
    corrections = np.zeros(len(points.number))
    for cell in cells:
        left = (cell.residuals + cell.rows @ step) / cell.std
        corrections[cell.some] = -cell.by_px * points.noise_px[cell.some] ** 2 * left
    return corrections


def estimate_covariance(
    cells: Sequence[Cell], weights: np.ndarray, total: np.ndarray, points: PassPoints, lengths: KnownLengths | None
) -> np.ndarray:
    """Return the covariance (U, U): noise, positions of images that many cells share, lengths and prior knowledge."""
    inverse = np.linalg.inv(total)
    of_images = np.zeros((len(points.image_mm), int(points.image.max()) + 1, len(total)))
    spread = np.eye(len(total)) if lengths is None else np.eye(len(total)) + lengths.rows.T @ lengths.rows
    for cell, weight in zip(cells, weights, strict=True):
        independent = np.sqrt(np.maximum(1.0 - np.sum(cell.images**2, axis=0), 0.0))
        rows = weight * cell.apart @ (cell.apart.T @ cell.rows)
        spread += (rows * independent[:, None]).T @ (rows * independent[:, None])
        for together, shares in zip(of_images, cell.images, strict=True):
            np.add.at(together, points.image[cell.some], rows * shares[:, None])
    return inverse @ (spread + np.einsum("kiu,kiv->uv", of_images, of_images)) @ inverse


def chance(amplitudes: np.ndarray, covariance: np.ndarray, directions: np.ndarray) -> float:
    """Return the probability of deviations as large along orthonormal directions (K, U), as far as determined.

    The amplitudes (U,) have a variance of one before, and a covariance (U, U) after the estimate.
    """
    found, after = directions @ amplitudes, directions @ covariance @ directions.T
    values, vectors = np.linalg.eigh(np.eye(len(found)) - after)
    tested = values > _DETERMINED
    square = float(np.sum((vectors.T @ found)[tested] ** 2 / values[tested]))
    return float(chdtrc(int(tested.sum()), square)) if tested.any() else 1.0


@dataclass(frozen=True, eq=False)
class MovedMount:
    """Mount after the passes, and its change (7,) with standard uncertainties before and after: mm, rad, s."""

    mount: Mount
    change: np.ndarray
    before: np.ndarray
    after: np.ndarray

    def lines(self) -> list[str]:
        """Describe the change."""
        rows = [("position", "mm", slice(0, 3), 1.0), ("direction", "deg", slice(3, 6), float(np.degrees(1.0)))]
        rows += [("clock offset", "ms", slice(6, 7), 1e3)] if self.before[6] > 0 else []
        lines = []
        for name, unit, part, factor in rows:
            values = (factor * each[part] for each in (self.change, self.before, self.after))
            moved, before, after = (", ".join(f"{value:.3f}" for value in each) for each in values)
            lines.append(f"mount, {name}: changed by {moved} {unit}; standard uncertainty {before} before, {after} now")
        return lines


def move_mount(mount: Mount, problem: PassProblem, solution: PassSolution, calibration: Calibration) -> MovedMount:
    """Return the mount for the OCS of the new calibration, with their correlation."""
    assert problem.mount is not None
    by, count = problem.mount.by, problem.root.shape[1]
    components, covariance = solution.amplitudes[:count], solution.covariance[:count, :count]
    moved = problem.moved(solution.amplitudes)
    # The sheet defines the OCS, which moves with it; the mount's change belongs to the OCS of the earlier calibration.
    corrected = problem.mount.correction(components) @ problem.earlier_from_moved(moved)
    transform = problem.mount.transform @ corrected
    lever = problem.mount.transform[:3, :3] @ corrected[:3, 3]
    in_place = by.copy()
    in_place[:3] += np.cross(by[3:6].T, lever).T
    of_mount = in_place @ covariance @ in_place.T
    shared, of_parameters = in_place @ covariance @ problem.root.T, problem.root @ covariance @ problem.root.T
    std = np.sqrt(np.diag(of_parameters))
    inverse = np.linalg.pinv(of_parameters / np.outer(std, std), rcond=_NEGLIGIBLE, hermitian=True)
    by_parameters = shared[:6] @ (inverse / np.outer(std, std))
    independent = of_mount[:6, :6] - by_parameters @ shared[:6].T
    changes: dict[str, object] = {
        "T_platform_sensor": to_rows(transform),
        "covariance": to_rows(0.5 * (of_mount + of_mount.T)[:6, :6]),
        "sensor": SensorShare(
            calibration=calibration_digest(calibration),
            by_parameters=to_rows(by_parameters),
            covariance_apart=to_rows(0.5 * (independent + independent.T)),
        ),
    }
    change = by @ components
    if mount.time_offset_std_s:
        changes["time_offset_s"] = (mount.time_offset_s or 0.0) + float(change[6])
        changes["time_offset_std_s"] = float(np.sqrt(of_mount[6, 6]))
        changes["clock_covariance"] = tuple((of_mount[:6, 6] - by_parameters @ shared[6]).tolist())
    if mount.robot_scale is not None:
        scale = problem.motion.pose_scale
        changes["robot_scale"] = mount.robot_scale * (1.0 + scale * float(solution.amplitudes[count]))
        changes["robot_scale_std"] = scale * float(np.sqrt(solution.covariance[count, count]))
    before, after = np.linalg.norm(by, axis=1), np.sqrt(np.einsum("iu,uv,iv->i", by, covariance, by))
    return MovedMount(mount.model_copy(update=changes), change, before, after)
