"""Choice of the design to build: Pareto front, best design, and its refinement.

The refinement follows the gradient of the objective, which Dr.Jit derives from the same formulas.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np
from scipy.optimize import minimize

from twin.design.designs import (
    Columns,
    Design,
    HighlightedDesign,
    build_sensor,
    evaluate_designs,
    evaluate_sensor,
    make_sensor,
    select_design,
)
from twin.design.figures_of_merit import (
    DEPTH_SHARES,
    DEPTHS,
    LINE_SHARES,
    PLACES,
    RENDERED_SCATTERING_DEPTH,
    Field,
    evaluate_volume,
    find_depths_in_view,
)
from twin.design.sensor_arrays import PARAMETER_OF, SensorArrays, extract_numbers, list_independent_paths
from twin.design.study import Study
from twin.rendering_options import use_variant
from uwlts.errors import DesignError, Error, EvaluationError
from uwlts.optics.design import Array, standoff_mm


def find_pareto_front(values: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the designs on the Pareto front of M values (N, M) to minimise.

    A design is on the front if no other design is at least as good in all values and better in one. Equal designs have
    the same result. A design with a NaN is neither on the front nor compared with others. Up to two values need one
    sort; more values need a pass over the designs for each design of the front (Kung et al. 1975).
    """
    front = np.zeros(len(values), dtype=bool)
    candidates = np.flatnonzero(~np.isnan(values).any(axis=1))
    if not len(candidates):
        return front
    # Sorted by the first value, then by the next: the first of the remaining designs is always on the front.
    different, place = np.unique(values[candidates], axis=0, return_inverse=True)
    if values.shape[1] <= 2:
        last = different[:, -1]
        best = np.append(True, last[1:] < np.minimum.accumulate(last)[:-1])
    else:
        best, left = np.zeros(len(different), dtype=bool), np.arange(len(different))
        while len(left):
            best[left[0]] = True
            left = left[(different[left] < different[left[0]]).any(axis=1)]
    front[candidates] = best[place]
    return front


@dataclass(frozen=True, eq=False)
class StudyResults:
    """Study and columns of its N evaluated designs; EvaluationError for columns of another study."""

    study: Study
    columns: Columns

    def __post_init__(self) -> None:
        expected = ["design", "violation", "failure", *self.study.free(), *(o.figure for o in self.study.objectives)]
        if missing := [name for name in expected if name not in self.columns]:
            raise EvaluationError(
                f"the results lack the columns {', '.join(missing)}; found {', '.join(self.columns)}: "
                "use the results of this study"
            )

    def __len__(self) -> int:
        return len(self.columns["design"])

    def figure(self, name: str) -> np.ndarray:
        """Return a figure (N,) of all designs; NaN if it is unknown."""
        return np.asarray(self.columns.get(name, np.full(len(self), np.nan)), dtype=np.float64)

    def cost(self, place: int = 0) -> np.ndarray:
        """Return an objective (N,) of all designs, with its sign changed if larger is better."""
        objective = self.study.objectives[place]
        return self.figure(objective.figure) * (1 if objective.goal == "minimise" else -1)

    @cached_property
    def failures(self) -> list[str]:
        """Reasons why designs cannot work, "" for working designs."""
        return [text or "" for text in self.columns["failure"].tolist()]

    @cached_property
    def works(self) -> np.ndarray:
        """Mask (N,) of the designs that work and have a finite first objective."""
        return np.array([not text for text in self.failures], dtype=bool) & np.isfinite(self.cost())

    @cached_property
    def feasible(self) -> np.ndarray:
        """Mask (N,) of the designs that work and meet all constraints."""
        return self.works & (self.figure("violation") <= 0)

    @cached_property
    def best_first(self) -> np.ndarray:
        """Indices of the working designs, sorted by constraint violation, then by the first objective."""
        order = np.lexsort((self.cost(), self.figure("violation")))
        return order[self.works[order]]

    def front(self, among: np.ndarray) -> np.ndarray:
        """Return a mask (N,) of the Pareto front of the objectives ``among`` (N,) some designs."""
        costs = np.column_stack([self.cost(k) for k in range(len(self.study.objectives))])
        return find_pareto_front(np.where(among[:, None], costs, np.nan))

    @property
    def of_interest(self) -> np.ndarray:
        """Mask (N,) of the designs that meet all constraints, or of all working designs if none does."""
        return self.feasible if self.feasible.any() else self.works

    def highlight(self, place: int, text: str) -> HighlightedDesign:
        """Return a design with its sensor as built and a label that starts with ``text``."""
        design = select_design(self.columns, place)
        return HighlightedDesign(
            f"{text} (design {design.number})", build_sensor(self.study, design.without_results()), design
        )


def choose(
    study: Study, columns: Columns
) -> tuple[tuple[HighlightedDesign, ...], list[HighlightedDesign], tuple[str, ...]]:
    """Choose the best design by the first objective among those that meet the constraints; return further ones, too.

    Returns the designs to mark, further designs to render, and notes. Marked are the base sensor if it works, the best
    design, and the refined design if it is better; the last one is the winner. If no design meets the constraints, the
    one with the smallest violation is chosen, with a note. The further designs are spread over the Pareto front; their
    number is that of the study's designs to render, less one. Raises DesignError if no design works.
    """
    marked, notes = [], []
    base, found = study.sensor, StudyResults(study, columns)
    try:
        marked.append(HighlightedDesign(f"{base.name} (as described)", base, evaluate_sensor(study, "base", base)))
    except Error as error:
        notes.append(f"The base sensor itself cannot work: {error}.")
    if not len(found.best_first):
        reason = found.failures[0]
        raise DesignError(f"none of {len(found)} designs can work; the first one: {reason}: widen the ranges")
    meets = found.feasible
    if not meets.any():
        notes.append("No design meets all constraints; the chosen one misses them least.")
        violation = np.where(found.works, columns["violation"], np.inf)
        meets = violation == violation.min()
    best = int(found.best_first[0])
    winner = found.highlight(best, "best of the sweep")
    marked.append(winner)

    def better(design: Design) -> bool:
        """Return whether a design is better than the best one of the sweep."""
        one, known = StudyResults(study, evaluate_designs(study, [design])), found.cost()[best]
        missed = one.figure("violation")[0]
        return bool(missed <= winner.design.violation and one.cost()[0] < known - 1e-6 * abs(known))

    if (end := refine_design(study, winner.design.without_results(), better)) is not None:
        marked.append(
            HighlightedDesign(
                "refined along the gradient", build_sensor(study, end), select_design(evaluate_designs(study, [end]), 0)
            )
        )
    notes += [note] if (note := describe_turbidity(marked[-1])) else []
    front = np.flatnonzero(found.front(meets))
    front = front[np.argsort(found.cost()[front])]
    spread = front[np.unique(np.linspace(0, len(front) - 1, study.verify + 1).round().astype(int))]
    others = [int(place) for place in spread if place != best][: max(study.verify - 1, 0)]
    further = [found.highlight(place, "on the Pareto front") for place in others]
    return tuple(marked), further, tuple(notes)


def describe_turbidity(one: HighlightedDesign) -> str:
    """Return a note on a design in water that is more turbid than that of the rendered designs, else an empty text."""
    depth = one.design.number_of("scattering_depth")
    if not depth > RENDERED_SCATTERING_DEPTH:
        return ""
    return (
        f"{one.label}: the optical depth of scattering is {depth:.1f}, but formulas and rendering were compared only "
        f"up to {RENDERED_SCATTERING_DEPTH:g}: do not rely on its sigmas unless it is rendered (verify) and agrees."
    )


# --- refinement -------------------------------------------------------------------------------------------------------

_STEPS = 40  # largest number of iterations
_TOLERANCE = 1e-7  # relative change of the objective that ends the search: far below manufacturing tolerances
_HALVINGS = 12  # largest number of halvings of a step; smaller steps are below manufacturing tolerances

Mean = Callable[..., Array]
Smooth = Callable[[ModuleType, SensorArrays, Field, Mean], Array]


def _make_rms(name: str, depth: int | None = None) -> Smooth:
    """Return a function for the root mean square of a quantity over all points, or over those at one depth."""
    return lambda xp, p, f, mean: xp.sqrt(mean(getattr(f, name) ** 2, depth))


def _choose_largest(xp: ModuleType, values: Array) -> Array:
    """Return the largest value; of equal values only one, because a maximum would sum their derivatives."""
    return xp.gather(type(values), values, int(np.argmax(values.numpy())))


def _compute_coverage(xp: ModuleType, p: SensorArrays, f: Field, mean: Mean) -> Array:
    near, far = find_depths_in_view(xp, p)
    return (far - near) / (p.far_mm - p.near_mm)


MIDDLE = DEPTHS // 2  # index of the middle depth
SMOOTH: dict[str, Smooth] = {
    "sigma_z_rms_mm": _make_rms("sigma_z_mm"),
    "sigma_z_mm": lambda xp, p, f, mean: _choose_largest(xp, f.sigma_z_mm),
    "sigma_y_mm": lambda xp, p, f, mean: _choose_largest(xp, f.sigma_y_mm),
    "sigma_z_near_mm": _make_rms("sigma_z_mm", 0),
    "sigma_z_middle_mm": _make_rms("sigma_z_mm", MIDDLE),
    "sigma_z_far_mm": _make_rms("sigma_z_mm", DEPTHS - 1),
    "line_near_mm": lambda xp, p, f, mean: 2 * mean(f.half_line_mm, 0),
    "line_mm": lambda xp, p, f, mean: 2 * mean(f.half_line_mm, MIDDLE),
    "line_far_mm": lambda xp, p, f, mean: 2 * mean(f.half_line_mm, DEPTHS - 1),
    "required_ms": lambda xp, p, f, mean: f.required_ms,
    "standoff_mm": lambda xp, p, f, mean: standoff_mm(p.pose(xp)) - p.outer_mm(xp),
    "near_mm": lambda xp, p, f, mean: p.near_mm,
    "far_mm": lambda xp, p, f, mean: p.far_mm,
    "depth_mm": lambda xp, p, f, mean: p.far_mm - p.near_mm,
    "baseline_mm": lambda xp, p, f, mean: p.baseline_mm,
    "coverage": _compute_coverage,
}
"""Differentiable figures. For coverage, the laser is assumed to reach everything in the camera's view."""


class DerivedFigures:
    """Figures of a design and their derivatives with respect to its continuous free numbers, ``paths``."""

    def __init__(self, study: Study, design: Design, figures: list[str]):
        use_variant()
        from drjit.llvm.ad import Float64

        sensor = make_sensor(study, design)
        self.paths = [path for path in list_independent_paths(sensor) if path in study.continuous()]
        self._figures, self._study, self._float = figures, study, Float64
        self._parameters = extract_numbers(sensor, study.medium_of(sensor))
        self._places = [Float64(shares.ravel()) for shares in np.broadcast_arrays(DEPTH_SHARES, LINE_SHARES)]

    def evaluate(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return figures (F,) and derivatives (F, K) at values (K,) of the free numbers, in the units of the paths."""
        found = [self._differentiate(values, number) for number in range(len(self.paths))]
        return np.array(found[-1][0]), np.array([change for _, change in found]).T

    def _differentiate(self, values: np.ndarray, number: int) -> tuple[list[float], list[float]]:
        """Return the figures, and their derivatives with respect to one number."""
        import drjit as dr

        names, units = zip(*(PARAMETER_OF[path] for path in self.paths), strict=True)
        # All numbers have gradients, all but one of them 0. They are opaque, so that one kernel serves all.
        numbers = [self._float(float(value) * unit) for value, unit in zip(values, units, strict=True)]
        seeds = [self._float(float(k == number)) for k in range(len(numbers))]
        dr.make_opaque(numbers, seeds)
        dr.enable_grad(numbers)
        p = replace(self._parameters, **dict(zip(names, numbers, strict=True)))
        followers, _, _, field = evaluate_volume(dr, p, self._study.follow, self._study.reflectance, *self._places)
        p, f = replace(p, **followers), Field(**field)

        def mean(quantity: Array, depth: int | None = None) -> Array:
            weights = np.zeros((DEPTHS, PLACES))
            weights[slice(None) if depth is None else depth] = 1
            return dr.sum(quantity * self._float(weights.ravel() / weights.sum()))

        outputs = [self._float(SMOOTH[name](dr, p, f, mean)) for name in self._figures]
        dr.set_grad(numbers, seeds)
        dr.enqueue(dr.ADMode.Forward, numbers)
        # Figures can share intermediate results, so that gradients are kept.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        changes = [dr.grad(output) for output in outputs]
        dr.eval(outputs, changes)
        return [float(one.numpy()[0]) for one in outputs], [units[number] * float(c.numpy()[0]) for c in changes]


def refine_design(study: Study, design: Design, accepts: Callable[[Design], bool]) -> Design | None:
    """Optimise the first objective of a design within ranges and constraints; return None without an improvement.

    The method is sequential quadratic programming (Kraft 1988). ``accepts`` returns whether a design is better than the
    start, including constraints without a derivative. If it rejects the result, the step is halved. The result is also
    None if the objective is not differentiable.
    """
    objective, bounds = study.objectives[0], [bound for bound in study.bounds() if bound[0] in SMOOTH]
    if objective.figure not in SMOOTH:
        return None
    names = list(dict.fromkeys([objective.figure, *(name for name, _, _ in bounds)]))
    figures = DerivedFigures(study, design, names)
    if not figures.paths:
        return None
    low, most = np.array([study.variables[path].ends() for path in figures.paths]).T
    wide = most - low
    start = (np.array([design.values[path] for path in figures.paths]) - low) / wide
    known: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}

    def at(shares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return figures, and derivatives with respect to the normalised variables (0 to 1)."""
        clipped = np.clip(shares, 0, 1)
        if (key := clipped.tobytes()) not in known:
            values, gradient = figures.evaluate(low + clipped * wide)
            known[key] = values, gradient * wide
        return known[key]

    scale = (1.0 if objective.goal == "minimise" else -1.0) / (abs(at(start)[0][0]) or 1.0)
    places = [names.index(name) for name, _, _ in bounds]
    limits = np.array([limit for _, _, limit in bounds])
    sizes = np.array([-sign / max(abs(limit), 1.0) for _, sign, limit in bounds])
    found = minimize(
        lambda x: scale * at(x)[0][0],
        start,
        jac=lambda x: scale * at(x)[1][0],
        method="SLSQP",
        bounds=[(0.0, 1.0)] * len(start),
        constraints={
            "type": "ineq",
            "fun": lambda x: sizes * (at(x)[0][places] - limits),
            "jac": lambda x: sizes[:, None] * at(x)[1][places],
        },
        options={"maxiter": _STEPS, "ftol": _TOLERANCE},
    )
    step = np.clip(found.x, 0, 1) - start
    for _ in range(_HALVINGS):
        if not np.isfinite(step).all() or not step.any():
            break
        values = low + (start + step) * wide
        moved = Design(design.number, design.values | dict(zip(figures.paths, values.tolist(), strict=True)))
        if accepts(moved):
            return moved
        step = 0.5 * step
    return None
