"""Plots of the study of stripe errors, from measured cases."""

import math
from collections.abc import Sequence
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from stripe_cases import CROP_PX, CROSSING, MASS, Frames, measure
from stripe_plan import DEPTHS, F_NUMBERS, LEVELS, NAME_ALL, NAME_CORE, PLACES, THESIS_STD, TURBIDITIES, Plan

from twin.sensor.speckle import pixel_contrast
from uwlts.model.library import load_sensor
from uwlts.model.placement import camera_from_object, check_design
from uwlts.pages.toolkit import COLOURS, legend_below, new_figure
from uwlts.stripe.peak_window import FWHM_PER_SIGMA

TRUE, FOUND, PUBLISHED = "#ff7800", "#145ac8", "#e9dcc4"
"""Colours of true centres, of those found, and of the thesis's range."""
_HUES = dict(zip(("only noise", "only speckle", "only defocus", NAME_CORE), COLOURS, strict=False))


def draw_all(plan: Plan, folder: Path) -> None:
    """Write all plots into a folder."""
    _depth(plan, folder / "stripe-errors-depth.svg")
    _f_number(plan, folder / "stripe-errors-f-number.svg")
    _turbidity(plan, folder / "stripe-errors-turbidity.svg")
    _gloss(plan, folder / "stripe-errors-gloss.svg")
    _exposure(plan, folder / "stripe-errors-exposure.svg")
    _strips(plan, folder / "stripe-errors-pictures.png")


def line_contrast(f_number: float) -> float:
    """Contrast of the speckle of unpolarised light over one pixel of the thesis's camera."""
    camera = load_sensor("thesis").camera
    magnification = camera.focal_length_mm / (camera.focus_distance_mm - camera.focal_length_mm)
    grain_mm = 1e-6 * load_sensor("thesis").laser.wavelength_nm * f_number * (1 + magnification)
    return pixel_contrast(1e3 * grain_mm / camera.pixel_size_um) / math.sqrt(2)


def predicted_std_px(f_number: float, width_px: float, *, mass: bool = False) -> float:
    """Return the standard deviation by speckle of the centre of a Gaussian profile, px, with independent pixels.

    Let f be the profile with standard deviation s, and C the contrast. The variance of the matched filter's centre is
    `C^2 int x^2 f^4 / (int x^2 f^2 / s^2)^2 = C^2 s / sqrt(2 pi)`. The variance of the centre of mass is
    `C^2 int x^2 f^2 / (int f)^2 = C^2 s / (4 sqrt(pi))`.
    """
    sigma = width_px / FWHM_PER_SIGMA
    return line_contrast(f_number) * math.sqrt(sigma / (4 * math.sqrt(math.pi) if mass else math.sqrt(2 * math.pi)))


def distances_mm(z_mm: tuple[float, ...]) -> list[float]:
    """Return the distances of points on the sheet's middle line from the outside of the camera's window."""
    sensor = load_sensor("thesis")
    standoff = check_design(sensor, sensor.media["water"]).standoff_mm
    return [standoff + z * camera_from_object(sensor)[2, 2] for z in z_mm]


def _two_panels(*titles: str, x_label: str, x_ticks: tuple[float, ...] | None = None) -> tuple[Figure, list[Axes]]:
    """Two axes side by side; with ``x_ticks`` along a logarithmic scale that is labelled there."""
    figure, panels = new_figure(9.0, 3.6, columns=2)
    for axes, title in zip(panels, titles, strict=True):
        axes.set(title=title, xlabel=x_label)
        if x_ticks is not None:
            axes.set_xscale("log")
            axes.set_xticks(x_ticks, [f"{tick:g}" for tick in x_ticks])
            axes.set_xticks([], minor=True)
    return figure, panels


def _write(figure: Figure, path: Path) -> None:
    legend_below(figure, columns=3)
    figure.savefig(path, metadata={"Date": None})


def _curve(axes: Axes, name: str, x: Sequence[float], frames: list[Frames], value: str, colour: str) -> None:
    """Plot a value of the frames' spreads; standard deviations with their standard errors, from zero."""
    spreads = [each.spread() for each in frames]
    is_std = value.startswith("std")
    error = [getattr(s, f"{value}_error") for s in spreads] if is_std else None
    axes.errorbar(x, [getattr(s, value) for s in spreads], error, fmt="o-", color=colour, markersize=4, label=name)
    axes.set_ylabel(f"{'standard deviation' if is_std else 'median'} / {value.rsplit('_', 1)[-1]}")
    if is_std and axes.get_yscale() == "linear":
        axes.set_ylim(bottom=0.0)


def _mass_curve(axes: Axes, name: str, x: Sequence[float], frames: list[Frames], value: str, colour: str) -> None:
    y = [getattr(each.spread(MASS), value) for each in frames]
    axes.plot(x, y, "o--", color=colour, markersize=4, label=f"{name}, centre of mass")


def _depth(plan: Plan, path: Path) -> None:
    cases, x = plan.depth(), distances_mm(DEPTHS)
    titles = [f"Spread of the centre, in {unit}" for unit in ("px", "mm")]
    figure, panels = _two_panels(*titles, x_label="distance from the window / mm")
    for axes, unit, limits in zip(panels, ("px", "mm"), ((5e-4, 1.0), (1.25e-4, 0.3)), strict=True):
        axes.set_yscale("log")
        for name, hue in _HUES.items():
            _curve(axes, name, x, [measure(cases[name, z]) for z in DEPTHS], f"std_{unit}", hue)
        _mass_curve(axes, NAME_CORE, x, [measure(cases[NAME_CORE, z]) for z in DEPTHS], f"std_{unit}", COLOURS[3])
        axes.set_ylim(limits)
    std = [value for thing in PLACES for pair in THESIS_STD[thing, "water"].values() for value in pair[1:]]
    panels[1].axhspan(min(std), max(std), color=PUBLISHED, label="thesis's STD in water, proposed method")
    _write(figure, path)


def _f_number(plan: Plan, path: Path) -> None:
    cases = plan.f_number()
    alone = [measure(cases["only speckle", "stand-off", n]) for n in F_NUMBERS]
    together = [measure(cases[NAME_CORE, "stand-off", n]) for n in F_NUMBERS]
    formula = [predicted_std_px(n, frames.width_px) for n, frames in zip(F_NUMBERS, alone, strict=True)]
    figure, (left, right) = _two_panels("Stand-off, in px", "In mm", x_label="f-number", x_ticks=F_NUMBERS)
    _curve(left, "speckle alone, stand-off", F_NUMBERS, alone, "std_px", COLOURS[1])
    left.plot(F_NUMBERS, formula, "--", color=COLOURS[5], label="speckle alone, by formula")
    _curve(left, f"{NAME_CORE}, stand-off", F_NUMBERS, together, "std_px", COLOURS[3])
    for place, colour in zip(PLACES["plane"], (COLOURS[0], COLOURS[3], COLOURS[2]), strict=True):
        frames = [measure(cases[NAME_CORE, place, n]) for n in F_NUMBERS]
        _curve(right, f"{NAME_CORE}, {place}", F_NUMBERS, frames, "std_mm", colour)
        _mass_curve(right, place, F_NUMBERS, frames, "std_mm", colour)
    _write(figure, path)


def _turbidity(plan: Plan, path: Path) -> None:
    cases = plan.turbidity()
    names = list(dict.fromkeys(name for name, _ in cases))
    hues = dict(zip(names, (COLOURS[0], COLOURS[1], COLOURS[3], COLOURS[2]), strict=True))
    label = "turbidity: 0 pure, 1 clear, 2 coastal, 3 harbour"
    figure, (left, right) = _two_panels("Bias, no other effect", "Spread", x_label=label)
    for name, hue in hues.items():
        frames = [measure(cases[name, water]) for water in TURBIDITIES]
        if name not in (NAME_ALL, "all but scatter"):
            _curve(left, name, TURBIDITIES, frames, "bias_px", hue)
        _curve(right, name, TURBIDITIES, frames, "std_px", hue)
    left.set_ylim(-0.02, 0.02)
    _write(figure, path)


def _gloss(plan: Plan, path: Path) -> None:
    cases = plan.gloss()
    figure, panels = _two_panels("Step of steel, its corner at 0", "Pipe of PVC", x_label="Y, along the stripe / mm")
    bins = {"step": np.arange(-14.0, 14.5, 0.5), "pipe": np.arange(-70.0, 71.0, 4.0)}
    for axes, (thing, edges) in zip(panels, bins.items(), strict=True):
        middles = (edges[1:] + edges[:-1]) / 2
        for (_, name), colour in zip([key for key in cases if key[0] == thing], COLOURS, strict=False):
            frames = measure(cases[thing, name])
            error, y = np.where(frames.used, frames.error_px[CROSSING], np.nan), frames.point_mm[..., 1]
            inside = [error[(y >= a) & (y < b) & np.isfinite(error)] for a, b in pairwise(edges)]
            bias = [float(np.median(part)) if part.size else math.nan for part in inside]
            axes.plot(middles, bias, "--" if "light" in name else "-", color=colour, label=name)
        axes.set(ylabel="median / px", ylim=(-0.05, 0.05))
    _write(figure, path)


def _exposure(plan: Plan, path: Path) -> None:
    cases = plan.exposure()
    figure, (left, right) = _two_panels("Bias", "Spread", x_label="brightest light / full well", x_ticks=LEVELS)
    right.set_yscale("log")
    for name in ("only noise", NAME_CORE):
        frames = [measure(cases[name, level]) for level in LEVELS]
        _curve(left, name, LEVELS, frames, "bias_px", _HUES[name])
        _curve(right, name, LEVELS, frames, "std_px", _HUES[name])
    left.set_ylim(-0.03, 0.03)
    _write(figure, path)


def _strips(plan: Plan, path: Path) -> None:
    """Plot an enlarged part of the stripe with several effects, with true centres (line) and found ones (dots)."""
    cases = plan.pictures()
    waters, names = (list(dict.fromkeys(key[axis] for key in cases)) for axis in (0, 1))
    figure, panels = new_figure(2.2 * len(names), 2.3 * len(waters), rows=len(waters), columns=len(names))
    for axes, (water, name) in zip(panels, product(waters, names), strict=True):
        frames = measure(cases[water, name])
        first_row, first = frames.crop_at
        # The square root brightens dark pixels, like the gamma of displays.
        axes.imshow(np.sqrt(frames.crop), cmap="gray", vmin=0.0, vmax=np.sqrt(255.0), interpolation="nearest")
        truth, error = (v[0, first : first + CROP_PX] for v in (frames.truth_px, frames.error_px[CROSSING]))
        axes.plot(truth - first_row, color=TRUE, linewidth=1)
        axes.plot(truth - first_row + error, ".", color=FOUND, markersize=4)
        axes.set(xticks=[], yticks=[])
        if water == waters[0]:
            axes.set_title(name)
        if name == names[0]:
            axes.set_ylabel(water)
    figure.savefig(path, dpi=100)
