"""The joint least squares: all evidence and all prior knowledge, weighted by the scatter that the evidence shows."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from uwlts.calibration.joint.noise import Noise, judged, outliers, with_common_error, with_misfit
from uwlts.calibration.joint.parameters import Parameters
from uwlts.calibration.joint.residuals import STEP, STRIPE, TARGET, Residuals, StepProfileEvidence, TargetEvidence
from uwlts.calibration.joint.scanned_surfaces import SCANNED, SurfaceScanEvidence
from uwlts.errors import CalibrationError
from uwlts.fitting.schur_least_squares import Observation, SchurFit, schur_least_squares
from uwlts.model.parameter_keys import ParameterKey
from uwlts.model.sensor import Uncertainty

Evidence = TargetEvidence | StepProfileEvidence | SurfaceScanEvidence

_FIRST = {TARGET: Noise(0.1), STRIPE: Noise(0.3), STEP: Noise(0.3), **dict.fromkeys(SCANNED, Noise(0.3))}
_SOFT_LIMIT = 3.0  # standard deviations; outliers of the first round, not known yet, count linearly
_ROUNDS = 10  # of weights and corrections; a few settle, unless parts of the evidence contradict each other
_SETTLED = 0.02  # relative change of a scatter: as the standard uncertainty of that of a thousand values
UNSETTLED = "the residuals' scatter changes from round to round"
_SETTLED_PX = 1e-3  # of a corrected centre, as `_FINEST_PX` of the noise
# Of a cost that is the number of residuals: a step that gains so little moves the parameters by a tenth of their
# uncertainty, and what is left after it is far less. What the first round finds is but a start for the next.
_SMALLEST_GAIN, _FIRST_GAIN = 1e-7, 1e-3
_DAMPING, _FIRST_DAMPING = 1e-9, 1e-4
_FIRST_LINES = slice(None, None, 4)  # of the stripes on targets in the first round: good enough for a start, and fast
_FIRST_ROUNDS = 30  # then outliers are left out and the rest is solved to its end


@dataclass(frozen=True, eq=False)
class Estimate:
    """The global parameters, ``values`` (P,) with their ``covariance`` (P, P), and what the evidence says of them.

    ``local``, (b,) each, with ``local_covariances``, (b, b) each, and ``residuals``, outliers included, are those of
    every piece of evidence, ``noise`` that of every kind of residual; ``outliers`` is the number left out, ``rounds``
    that of all least squares together.
    """

    parameters: Parameters
    values: np.ndarray
    covariance: np.ndarray
    local: list[np.ndarray]
    local_covariances: list[np.ndarray]
    noise: dict[str, Noise]
    residuals: list[list[Residuals]]
    outliers: int
    rounds: int
    stopped: str

    def std(self) -> dict[ParameterKey, float]:
        """Standard uncertainty of every parameter."""
        return dict(zip(self.parameters.keys, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def estimate(
    parameters: Parameters,
    evidence: Sequence[Evidence],
    global_values: np.ndarray,
    local: Sequence[np.ndarray],
    *,
    uncertainty: Uncertainty,
    diameter_mm: float | None = None,
    misfits: Collection[str] = (),
) -> Estimate:
    """Least squares over all evidence, repeated until weights and corrections agree with the solution.

    At first large residuals count linearly; then outliers, beyond five standard deviations, are left out. The start is
    ``global_values`` (P,) and ``local``, (b,) of every piece of evidence. With ``diameter_mm`` of the target's circles
    the offsets of their images' centres are taken out. Of kinds of residuals among ``misfits`` the model is known to
    lack something: all residuals of an image count as one.

    Raises CalibrationError: the start has no meaning, the evidence does not determine the parameters, or corrections do
    not settle.
    """
    found, local, rounds, known = list(evidence), list(local), 0, dict(_FIRST)
    left_out: list[list[np.ndarray]] | None = None
    moved = np.inf
    for number in range(_ROUNDS):
        first, last = number == 0, number == _ROUNDS - 1
        thinned = [e.with_stripes(_FIRST_LINES) if isinstance(e, TargetEvidence) else e for e in evidence]
        fit = _fit(parameters, thinned if first else evidence, global_values, local, uncertainty, known, left_out)
        global_values, local, rounds = fit.global_values, fit.local[:-1], rounds + fit.rounds
        residuals = []
        for piece, values in zip(evidence, local, strict=True):
            if (parts := piece.residuals(parameters, global_values, values)) is None:
                raise CalibrationError("the joint calibration diverged: a ray that was seen meets no sheet or target")
            residuals.append(parts)
        before, known = known, _noise(evidence, residuals, misfits)
        left_out = [[outliers(r, known[r.kind]) for r in parts] for parts in residuals]
        used, evidence = evidence, []
        for piece, values, parts, masks in zip(found, local, residuals, left_out, strict=True):
            if diameter_mm is not None and isinstance(piece, TargetEvidence):
                piece = piece.with_centres(parameters, global_values, values, diameter_mm)
            evidence.append(piece.linearised(parts, [~mask for mask in masks]))
        changes = [
            float(np.abs(a.placement.pixels - b.placement.pixels).max())
            for a, b in zip(used, evidence, strict=True)
            if isinstance(a, TargetEvidence) and isinstance(b, TargetEvidence)
        ]
        moved = max(changes, default=0.0)
        steady = all(abs(known[k].effective_px() / before[k].effective_px() - 1) < _SETTLED for k in known)
        if moved <= _SETTLED_PX and not first and (steady or last):
            return Estimate(
                parameters=parameters,
                values=global_values,
                covariance=fit.covariance / fit.sigma**2,
                local=local,
                local_covariances=[each / fit.sigma**2 for each in fit.local_covariances[:-1]],
                noise=known,
                residuals=residuals,
                outliers=sum(int(mask.sum()) for parts in left_out for mask in parts),
                rounds=rounds,
                stopped=fit.stopped if steady else UNSETTLED,
            )
    raise CalibrationError(
        f"the joint calibration did not settle in {_ROUNDS} rounds: the offsets of the circles' images still move by "
        f"{moved:.2g} px; is the circles' diameter right?"
    )


def _fit(
    parameters: Parameters,
    evidence: Sequence[Evidence],
    global_values: np.ndarray,
    local: Sequence[np.ndarray],
    uncertainty: Uncertainty,
    noise: dict[str, Noise],
    left_out: list[list[np.ndarray]] | None,
) -> SchurFit:
    """Every piece of evidence as a group with local parameters; the last group is what is known before."""

    def model(group: int, global_values: np.ndarray, local: np.ndarray) -> list[Observation] | None:
        if group == len(evidence):
            return _known_before(parameters, global_values)
        piece = evidence[group]
        parts = piece.residuals(parameters, global_values, local)
        if parts is None:
            return None
        rows = []
        for number, part in enumerate(parts):
            used = slice(None) if left_out is None else ~left_out[group][number]
            columns, scale = (part.values[:, None], part.by_global, part.by_local), noise[part.kind].effective_px()
            values, by_global, by_local = (column[used] / scale for column in columns)
            rows.append(Observation(values, by_global, by_local, part.local_columns))
        off, by_local = piece.known_before(local, uncertainty)
        return [*rows, Observation(off[:, None], np.zeros((len(off), len(global_values))), by_local)]

    starts = [*local, np.empty(0)]
    if left_out is not None:
        return schur_least_squares(model, global_values, starts, smallest_gain=_SMALLEST_GAIN, damping=_DAMPING)
    first = {"smallest_gain": _FIRST_GAIN, "damping": _FIRST_DAMPING, "soft_limit": _SOFT_LIMIT}
    return schur_least_squares(model, global_values, starts, **first, enough_rounds=_FIRST_ROUNDS)


def _known_before(parameters: Parameters, global_values: np.ndarray) -> list[Observation]:
    """Prior knowledge: of each parameter by itself, and of many at once by an earlier estimate."""
    std = parameters.prior_std()
    known = np.isfinite(std)
    found = [((global_values - parameters.prior_mean())[known] / std[known], np.diag(1.0 / std)[known])]
    if parameters.earlier is not None:
        found.append(parameters.earlier.residuals(global_values))
    return [Observation(off[:, None], by_global, np.empty((len(off), 0))) for off, by_global in found]


def _noise(
    evidence: Sequence[Evidence], residuals: list[list[Residuals]], misfits: Collection[str]
) -> dict[str, Noise]:
    result = {}
    for kind in dict.fromkeys(r.kind for parts in residuals for r in parts):
        points = [e.placement.points_mm for e in evidence if kind == TARGET and isinstance(e, TargetEvidence)]
        of_kind = [r for parts in residuals for r in parts if r.kind == kind]
        result[kind] = judged(kind, of_kind, points)
        if kind in SCANNED:
            scans = [e for e in evidence if isinstance(e, SurfaceScanEvidence) and e.surface.kind == kind]
            common_px, bodies = np.concatenate([e.common_px for e in scans]), sum(e.surface.count for e in scans)
            result[kind] = with_common_error(result[kind], common_px, bodies=bodies)
        if kind in misfits:
            per_image = float(np.mean([len(r.values) for r in of_kind]))
            result[kind] = with_misfit(result[kind], per_image=per_image)
    return result
