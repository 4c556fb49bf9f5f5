"""Refinement of a design along the gradient of its objective, which Dr.Jit derives from the formulas of all designs."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType

import numpy as np
from scipy.optimize import minimize

from twin.design.description import Study
from twin.design.designs import Design, sensor_of
from twin.design.figures import DEPTHS, PLACES, Field, depths_in_view, field_of
from twin.design.geometry import Array, standoff_mm
from twin.design.parameters import Parameters, followed, numbers_of
from twin.options import use_variant

PARAMETER_OF: dict[str, tuple[str, float]] = {
    "laser.baseline_mm": ("baseline_mm", 1.0),
    "laser.triangulation_angle_deg": ("angle_rad", math.pi / 180),
    "laser.roll_deg": ("roll_rad", math.pi / 180),
    "laser.power_mw": ("power_w", 1e-3),
    "laser.waist_radius_mm": ("waist_mm", 1.0),
    "laser.waist_distance_mm": ("waist_distance_mm", 1.0),
    "laser.beam_quality_m2": ("beam_quality", 1.0),
    "laser.window.distance_mm": ("laser_window_distance_mm", 1.0),
    "laser.window.thickness_mm": ("laser_window_thickness_mm", 1.0),
    "camera.focal_length_mm": ("focal_mm", 1.0),
    "camera.f_number": ("f_number", 1.0),
    "camera.focus_distance_mm": ("focus_mm", 1.0),
    "camera.window.distance_mm": ("window_distance_mm", 1.0),
    "camera.window.thickness_mm": ("window_thickness_mm", 1.0),
    "camera.window.tilt_x_deg": ("window_tilt_x_rad", math.pi / 180),
    "camera.window.tilt_y_deg": ("window_tilt_y_rad", math.pi / 180),
    "volume.near_mm": ("near_mm", 1.0),
    "volume.far_mm": ("far_mm", 1.0),
}
"""Numbers of the description along which figures can be derived, with the parameter and its unit per the path's.

What a window's glass absorbs is taken as it is at the starting point."""

_OF_BASELINE = ("laser.baseline_mm", "laser.triangulation_angle_deg", "laser.roll_deg")
"""Numbers without a meaning for a laser that is placed by its axis."""

_STEPS, _TOLERANCE = 40, 1e-7
_HALVINGS = 12

Mean = Callable[..., Array]
Smooth = Callable[[ModuleType, Parameters, Field, Mean], Array]


def _rms(name: str, depth: int | None = None) -> Smooth:
    """Root mean square of a quantity over the points in view, all or those at one depth."""
    return lambda xp, p, f, mean: xp.sqrt(mean(getattr(f, name) ** 2, depth))


def _largest(xp: ModuleType, values: Array) -> Array:
    """The largest value: one of them where several are alike, of which a maximum would add up the derivatives."""
    return xp.gather(type(values), values, int(np.argmax(values.numpy())))


def _coverage(xp: ModuleType, p: Parameters, f: Field, mean: Mean) -> Array:
    near, far = depths_in_view(xp, p)
    return (far - near) / (p.far_mm - p.near_mm)


MIDDLE = DEPTHS // 2
SMOOTH: dict[str, Smooth] = {
    "sigma_z_rms_mm": _rms("sigma_z_mm"),
    "sigma_z_mm": lambda xp, p, f, mean: _largest(xp, f.sigma_z_mm),
    "sigma_y_mm": lambda xp, p, f, mean: _largest(xp, f.sigma_y_mm),
    "sigma_z_near_mm": _rms("sigma_z_mm", 0),
    "sigma_z_middle_mm": _rms("sigma_z_mm", MIDDLE),
    "sigma_z_far_mm": _rms("sigma_z_mm", DEPTHS - 1),
    "line_near_mm": lambda xp, p, f, mean: 2 * mean(f.half_line_mm, 0),
    "line_mm": lambda xp, p, f, mean: 2 * mean(f.half_line_mm, MIDDLE),
    "line_far_mm": lambda xp, p, f, mean: 2 * mean(f.half_line_mm, DEPTHS - 1),
    "required_ms": lambda xp, p, f, mean: f.required_ms,
    "standoff_mm": lambda xp, p, f, mean: standoff_mm(p.pose(xp)) - p.outer_mm(xp),
    "near_mm": lambda xp, p, f, mean: p.near_mm,
    "far_mm": lambda xp, p, f, mean: p.far_mm,
    "depth_mm": lambda xp, p, f, mean: p.far_mm - p.near_mm,
    "baseline_mm": lambda xp, p, f, mean: p.baseline_mm,
    "coverage": _coverage,
}
"""Figures that can be derived. For coverage the laser counts as reaching whatever the camera sees."""


class DerivedFigures:
    """Figures of a design as functions of those of its free numbers, ``paths``, that can be derived."""

    def __init__(self, study: Study, design: Design, figures: list[str]):
        use_variant()
        import drjit as dr
        from drjit.llvm.ad import Float64

        self._dr, self._float = dr, Float64
        sensor = sensor_of(study, design)
        known = set(PARAMETER_OF) - (set() if sensor.laser.baseline_mm is not None else set(_OF_BASELINE))
        free = ((path, one) for path, one in study.variables.items() if path in known)
        self.paths = [path for path, variable in free if variable.values is None and not variable.whole]
        self._figures, self._study = figures, study
        self._parameters = numbers_of(sensor, study.medium_of(sensor))
        shares, places = np.meshgrid(np.linspace(0, 1, DEPTHS), np.linspace(-1, 1, PLACES), indexing="ij")
        self._shares, self._places = Float64(shares.ravel()), Float64(places.ravel() * (1 - 1e-9))

    def at(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Figures (F,) at values (K,) of the free numbers, and derivatives (F, K) by these, in the paths' own units."""
        found = [self._derived(values, number) for number in range(len(self.paths))]
        return np.array(found[-1][0]), np.array([change for _, change in found]).T

    def _derived(self, values: np.ndarray, number: int) -> tuple[list[float], list[float]]:
        """Figures, and their derivatives by one number."""
        dr = self._dr
        # All numbers carry derivatives, of which one is not 0, and neither is compiled in: one kernel serves all.
        numbers = [self._float(float(v) * PARAMETER_OF[path][1]) for path, v in zip(self.paths, values, strict=True)]
        seeds = [self._float(float(k == number)) for k in range(len(numbers))]
        dr.make_opaque(numbers, seeds)
        dr.enable_grad(numbers)
        changed = {PARAMETER_OF[path][0]: leaf for path, leaf in zip(self.paths, numbers, strict=True)}
        p = followed(dr, replace(self._parameters, **changed), self._study.follow)
        near, far = depths_in_view(dr, p)
        depths = near + (far - near) * self._shares
        f = field_of(dr, p, depths, self._places, reflectance=self._study.reflectance)

        def mean(quantity: Array, depth: int | None = None) -> Array:
            weights = np.zeros((DEPTHS, PLACES))
            weights[slice(None) if depth is None else depth] = 1
            return dr.sum(quantity * self._float(weights.ravel() / weights.sum()))

        outputs = [self._float(SMOOTH[name](dr, p, f, mean)) for name in self._figures]
        dr.set_grad(numbers, seeds)
        dr.enqueue(dr.ADMode.Forward, numbers)
        # Figures may share intermediate results: their gradients are kept.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        changes = [dr.grad(output) for output in outputs]
        dr.eval(outputs, changes)
        unit = PARAMETER_OF[self.paths[number]][1]
        return [float(output.numpy()[0]) for output in outputs], [unit * float(c.numpy()[0]) for c in changes]


def refined(study: Study, design: Design, accepts: Callable[[Design], bool]) -> Design | None:
    """The design moved along the gradient until the first objective is best within ranges and constraints.

    Sequential quadratic programming (Kraft 1988). Constraints without a derivative are left to ``accepts``, which
    returns whether a design is better than the start; where it rejects the end, the step is halved. None if nothing has
    a derivative, or nothing better is found.
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
        """Figures, and derivatives by the shares of the ranges."""
        clipped = np.clip(shares, 0, 1)
        if (key := clipped.tobytes()) not in known:
            values, gradient = figures.at(low + clipped * wide)
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
            return None
        values = low + (start + step) * wide
        moved = Design(design.number, design.values | dict(zip(figures.paths, values.tolist(), strict=True)))
        if accepts(moved):
            return moved
        step = 0.5 * step
    return None
