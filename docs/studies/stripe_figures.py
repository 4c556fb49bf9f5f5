"""The plots of the study of the stripe's errors, from cases that are measured already."""

import math
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from stripe_cases import CROP_PX, CROSSING, MASS, Frames, measure
from stripe_plan import DEPTHS, F_NUMBERS, LEVELS, NAME_ALL, NAME_CORE, PLACES, THESIS_STD, TURBIDITIES, Plan

from twin.sensor.speckle import pixel_contrast
from uwlts.model.library import load_sensor
from uwlts.model.placement import camera_from_object, check_design
from uwlts.report.canvas import ORANGE, blank, dot, line, write
from uwlts.report.svg_plot import COLOURS, Band, Curve, Panel, draw
from uwlts.stripe.peak_window import FWHM_PER_SIGMA

ZOOM, GAP = 8, 12
FOUND = (200, 90, 20)
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
    """Speckle's error of a Gaussian line of a full width at half maximum, by propagation, pixels being independent.

    With the line f of standard deviation s and the contrast C the variance of the matched filter's centre is
    C^2 int x^2 f^4 / (int x^2 f^2 / s^2)^2 = C^2 s / sqrt(2 pi), that of the centre of mass
    C^2 int x^2 f^2 / (int f)^2 = C^2 s / (4 sqrt(pi)).
    """
    sigma = width_px / FWHM_PER_SIGMA
    return line_contrast(f_number) * math.sqrt(sigma / (4 * math.sqrt(math.pi) if mass else math.sqrt(2 * math.pi)))


def distances_mm(z_mm: tuple[float, ...]) -> list[float]:
    """Distance outside the camera's window of places of the sheet's middle line."""
    sensor = load_sensor("thesis")
    standoff = check_design(sensor, sensor.media["water"]).standoff_mm
    return [standoff + z * camera_from_object(sensor)[2, 2] for z in z_mm]


def _depth(plan: Plan, path: Path) -> None:
    cases, x = plan.depth(), distances_mm(DEPTHS)
    panels = []
    for unit, low in (("px", 2e-3), ("mm", 5e-4)):
        curves = [
            _curve(name, x, [measure(cases[name, z]) for z in DEPTHS], f"std_{unit}", _HUES[name]) for name in _HUES
        ]
        mass = [measure(cases[NAME_CORE, z]).spread(MASS) for z in DEPTHS]
        mass_y = [getattr(spread, f"std_{unit}") for spread in mass]
        curves.append(Curve(f"{NAME_CORE}, centre of mass", x, mass_y, COLOURS[3], dashed=True))
        bands = []
        if unit == "mm":
            std = [value for thing in PLACES for pair in THESIS_STD[thing, "water"].values() for value in pair[1:]]
            bands = [Band("thesis's STD in water, proposed method", min(std), max(std))]
        panels.append(
            Panel(
                f"Spread of the centre, in {unit}",
                "distance from the window / mm",
                f"standard deviation / {unit}",
                curves,
                bands,
                log_y=True,
                y_range=(low / 4, 1.0 if unit == "px" else 0.3),
            )
        )
    draw(path, panels)


def _curve(name: str, x: list[float], frames: list[Frames], value: str, colour: str) -> Curve:
    spreads = [each.spread() for each in frames]
    error = [getattr(s, f"{value}_error") for s in spreads] if value.startswith("std") else None
    return Curve(name, x, [getattr(s, value) for s in spreads], colour, error)


def _f_number(plan: Plan, path: Path) -> None:
    cases = plan.f_number()
    alone = [measure(cases["only speckle", "stand-off", n]) for n in F_NUMBERS]
    together = [measure(cases[NAME_CORE, "stand-off", n]) for n in F_NUMBERS]
    formula = [predicted_std_px(n, frames.width_px) for n, frames in zip(F_NUMBERS, alone, strict=True)]
    left = [
        _curve("speckle alone, stand-off", F_NUMBERS, alone, "std_px", COLOURS[1]),
        Curve("speckle alone, by formula", F_NUMBERS, formula, COLOURS[5], dashed=True, marked=False),
        _curve(f"{NAME_CORE}, stand-off", F_NUMBERS, together, "std_px", COLOURS[3]),
    ]
    right = []
    for place, colour in zip(PLACES["plane"], (COLOURS[0], COLOURS[3], COLOURS[2]), strict=True):
        frames = [measure(cases[NAME_CORE, place, n]) for n in F_NUMBERS]
        right.append(_curve(f"{NAME_CORE}, {place}", F_NUMBERS, frames, "std_mm", colour))
        mass = [f.spread(MASS).std_mm for f in frames]
        right.append(Curve(f"{place}, centre of mass", F_NUMBERS, mass, colour, dashed=True))
    shared = {"x_label": "f-number", "log_x": True, "x_ticks": F_NUMBERS}
    draw(
        path,
        [
            Panel("Stand-off, in px", y_label="standard deviation / px", curves=left, **shared),
            Panel("In mm", y_label="standard deviation / mm", curves=right, **shared),
        ],
    )


def _turbidity(plan: Plan, path: Path) -> None:
    cases = plan.turbidity()
    names = list(dict.fromkeys(name for name, _ in cases))
    hues = dict(zip(names, (COLOURS[0], COLOURS[1], COLOURS[3], COLOURS[2]), strict=True))
    frames = {name: [measure(cases[name, water]) for water in TURBIDITIES] for name in names}
    shared = {"x_label": "turbidity: 0 pure, 1 clear, 2 coastal, 3 harbour"}
    scatter = [name for name in names if name not in (NAME_ALL, "all but scatter")]
    draw(
        path,
        [
            Panel(
                "Bias, no other effect",
                y_label="median / px",
                y_range=(-0.02, 0.02),
                **shared,
                curves=[_curve(name, TURBIDITIES, frames[name], "bias_px", hues[name]) for name in scatter],
            ),
            Panel(
                "Spread",
                y_label="standard deviation / px",
                **shared,
                curves=[_curve(name, TURBIDITIES, frames[name], "std_px", hues[name]) for name in names],
            ),
        ],
    )


def _gloss(plan: Plan, path: Path) -> None:
    cases, panels = plan.gloss(), []
    for thing, edges in (("step", np.arange(-14.0, 14.5, 0.5)), ("pipe", np.arange(-70.0, 71.0, 4.0))):
        middles, curves = (edges[1:] + edges[:-1]) / 2, []
        for (_, name), colour in zip([key for key in cases if key[0] == thing], COLOURS, strict=False):
            frames = measure(cases[thing, name])
            error, y = np.where(frames.used, frames.error_px[CROSSING], np.nan), frames.point_mm[..., 1]
            inside = [error[(y >= a) & (y < b) & np.isfinite(error)] for a, b in pairwise(edges)]
            bias = [float(np.median(part)) if part.size else math.nan for part in inside]
            curves.append(Curve(name, middles, bias, colour, marked=False, dashed="light" in name))
        title = "Step of steel, its corner at 0" if thing == "step" else "Pipe of PVC"
        panels.append(Panel(title, "Y, along the stripe / mm", "median / px", curves, y_range=(-0.05, 0.05)))
    draw(path, panels)


def _exposure(plan: Plan, path: Path) -> None:
    cases = plan.exposure()
    frames = {name: [measure(cases[name, level]) for level in LEVELS] for name in ("only noise", NAME_CORE)}
    shared = {"x_label": "brightest light / full well", "log_x": True, "x_ticks": LEVELS}
    draw(
        path,
        [
            Panel(
                "Bias",
                y_label="median / px",
                y_range=(-0.03, 0.03),
                **shared,
                curves=[_curve(name, LEVELS, each, "bias_px", _HUES[name]) for name, each in frames.items()],
            ),
            Panel(
                "Spread",
                y_label="standard deviation / px",
                log_y=True,
                **shared,
                curves=[_curve(name, LEVELS, each, "std_px", _HUES[name]) for name, each in frames.items()],
            ),
        ],
    )


def _strips(plan: Plan, path: Path) -> None:
    """The same piece of the stripe under effects, enlarged, with the true centres (line) and those found (dots)."""
    cases = plan.pictures()
    waters, names = (list(dict.fromkeys(key[axis] for key in cases)) for axis in (0, 1))
    side = ZOOM * CROP_PX
    picture = blank(90 + len(names) * (side + GAP), 30 + len(waters) * (side + GAP))
    for row, water in enumerate(waters):
        top = 30 + row * (side + GAP)
        write(picture, water, 12, top + side / 2)
        for column, name in enumerate(names):
            frames = measure(cases[water, name])
            left = 90 + column * (side + GAP)
            bright = np.sqrt(255.0 * frames.crop).round().astype(np.uint8)  # as displays do: lifts the dark
            grey = cv2.resize(bright, (side, side), interpolation=cv2.INTER_NEAREST)
            picture[top : top + side, left : left + side] = grey[..., None]
            first_row, first = frames.crop_at
            lines = np.arange(CROP_PX)
            x = left + ZOOM * (lines + 0.5)
            truth, error = (v[0, first : first + CROP_PX] for v in (frames.truth_px, frames.error_px[CROSSING]))
            y = top + ZOOM * (truth - first_row + 0.5)
            line(picture, np.column_stack([x, y]), colour=ORANGE)
            for a, b in zip(x, y + ZOOM * error, strict=True):
                if math.isfinite(b):
                    dot(picture, a, b, radius=2, colour=FOUND)
            if row == 0:
                write(picture, name, left + side / 2, 16, align="middle", size=0.45)
    cv2.imwrite(str(path), picture)
