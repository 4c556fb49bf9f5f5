"""Pictures of a certificate as plain SVG: maps over the volume, the correlation of parameters, images' residuals."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from uwlts.calibration.parameter_keys import ParameterKey
from uwlts.certificate.lengths import Worth
from uwlts.report.canvas import ticks
from uwlts.report.colours import coloured
from uwlts.report.page_toolkit import typographic
from uwlts.report.svg_plot import COLOURS, FAINT, INK, Curve, Panel, svg

_WIDTH, _LEFT, _TOP, _BOTTOM, _BAR = 356, 52, 30, 42, 74
_TALLEST = 330.0
_LIGHT, _DARK = np.array([240, 246, 252]), np.array([14, 62, 120])
_CELL, _LETTER = 23, 6.4


def heat_map(title: str, at_mm: np.ndarray, values: np.ndarray, *, signed: bool = False) -> str:
    """Values (R, C) in µm over a mesh (R, C, 2) of Y and Z, the sensor being above; signed ones from blue to red."""
    low, high = at_mm.reshape(-1, 2).min(axis=0), at_mm.reshape(-1, 2).max(axis=0)
    room = _WIDTH - _LEFT - _BAR
    scale = min(room / (high[0] - low[0]), _TALLEST / (high[1] - low[1]))
    height = _TOP + scale * (high[1] - low[1]) + _BOTTOM
    place = (at_mm - low) * scale + [_LEFT, _TOP]
    limit = max(float(np.abs(values).max()), 1e-9)
    middle = (values[:-1, :-1] + values[1:, :-1] + values[:-1, 1:] + values[1:, 1:]) / 4
    parts = []
    for row, column in np.ndindex(middle.shape):
        corners = place[[row, row, row + 1, row + 1], [column, column + 1, column + 1, column]]
        colour = _colour(middle[row, column] / limit, signed=signed)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        # Drawn with a seam of its own colour, lest the page shine through between the cells.
        parts.append(f'<polygon points="{points}" fill="{colour}" stroke="{colour}" stroke-width="0.7"/>')
    for y in ticks(low[0], high[0], count=4):
        at = _LEFT + (y - low[0]) * scale
        parts += [
            _line(at, height - _BOTTOM, at, height - _BOTTOM + 5),
            _text(typographic(f"{y:g}"), at, height - _BOTTOM + 18),
        ]
    for z in ticks(low[1], high[1], count=5):
        at = _TOP + (z - low[1]) * scale
        parts += [_line(_LEFT - 5, at, _LEFT, at), _text(typographic(f"{z:g}"), _LEFT - 8, at + 4, "end")]
    right = _LEFT + scale * (high[0] - low[0])
    parts += [
        _text(title, 6, 18, "start", bold=True), _text("Y / mm", (_LEFT + right) / 2, height - 6),
        f'<text transform="translate(13 {(_TOP + height - _BOTTOM) / 2:.0f}) rotate(-90)" '
        f'text-anchor="middle">Z / mm, away from the sensor</text>',
        _scale_bar(right + 16, _TOP, height - _TOP - _BOTTOM, limit, signed=signed),
    ]  # fmt: skip
    return _picture(_WIDTH, height, parts, title)


def correlation_picture(keys: Sequence[ParameterKey], covariance: np.ndarray) -> str:
    """The correlation matrix of parameters, coloured, with their names at the left and numbers above."""
    std = np.sqrt(np.diag(covariance))
    std = np.where(std > 0, std, 1.0)
    correlation = covariance / np.outer(std, std)
    words = [key.quantity.words for key in keys]
    left, top = 40 + _LETTER * max(map(len, words)), 26
    parts = []
    for row, column in np.ndindex(correlation.shape):
        value = correlation[row, column]
        x, y = left + column * _CELL, top + row * _CELL
        parts.append(
            f'<rect x="{x:.0f}" y="{y}" width="{_CELL - 1}" height="{_CELL - 1}" '
            f'fill="{_colour(value, signed=True)}"><title>{escape(words[row])}, {escape(words[column])}: '
            f"{value:+.3f}</title></rect>"
        )
        if row != column and abs(value) >= 0.5:
            parts.append(_text(f"{abs(value):.2f}"[1:4] if abs(value) < 0.995 else "1", x + _CELL / 2 - 0.5, y + 15.5,
                               size=9, colour="#fff" if abs(value) > 0.7 else INK))  # fmt: skip
    for number, word in enumerate(words, start=1):
        middle = top + (number - 0.5) * _CELL
        parts.append(_text(f"{word}  {number}", left - 8, middle + 4, "end"))
        parts.append(_text(str(number), left + (number - 0.5) * _CELL, top - 8))
    return _picture(left + len(words) * _CELL + 6, top + len(words) * _CELL + 6, parts, "Correlation of the parameters")


def image_residuals(images: Sequence[dict[str, Any]]) -> list[str]:
    """Root mean square residual of every image, a panel for each kind and two of them in a picture."""
    kinds = dict.fromkeys(image["kind"] for image in images)
    panels = []
    for number, kind in enumerate(kinds):
        rms = [image["rms_px"] for image in images if image["kind"] == kind]
        values = [np.nan if value is None else value for value in rms]
        panels.append(
            Panel(
                title=kind, x_label="image", y_label="residual (rms) / px",
                curves=[Curve(kind, list(range(1, len(values) + 1)), values, COLOURS[number], joined=False)],
            )
        )  # fmt: skip
    return [svg(panels[start : start + 2]) for start in range(0, len(panels), 2)]


def length_chart(lengths: Sequence[Worth]) -> str:
    """Expanded uncertainty over length, for each axis."""
    panels = []
    for title, name in (("surfaces: the calibration alone", "calibration_mm"), ("single points", "point_mm")):
        curves = [
            Curve(f"along {axis}", [w.length_mm for w in lengths if w.axis == axis],
                  [1e3 * getattr(w, name) for w in lengths if w.axis == axis], COLOURS[number])
            for number, axis in enumerate("XYZ") if any(w.axis == axis for w in lengths)
        ]  # fmt: skip
        panels.append(Panel(title, "length / mm", "expanded uncertainty (k = 2) / µm", curves))
    return svg(panels)


def _scale_bar(x: float, top: float, height: float, limit: float, *, signed: bool) -> str:
    steps = 40
    parts = []
    for step in range(steps):
        share = 1 - (step + 0.5) / steps
        colour = _colour(2 * share - 1 if signed else share, signed=signed)
        y = top + height * step / steps
        parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" width="12" height="{height / steps + 0.5:.1f}" fill="{colour}"/>')
    start = -limit if signed else 0.0
    for mark in ticks(start, limit, count=4):
        y = top + height * (limit - mark) / (limit - start)
        parts += [
            _line(x + 12, y, x + 16, y),
            _text(typographic(f"{mark:g}"), x + 19, y + 4, "start"),
        ]
    return "".join([*parts, _text("µm", x + 6, top - 8)])


def _colour(share: float, *, signed: bool) -> str:
    rgb = coloured(np.array([share]))[0] if signed else np.round(_LIGHT + min(max(share, 0), 1) * (_DARK - _LIGHT))
    return "#{:02x}{:02x}{:02x}".format(*(int(channel) for channel in rgb))


def _picture(width: float, height: float, parts: Sequence[str], title: str) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}" role="img" aria-label="{escape(title)}" font-size="12" '
        f'font-family="Helvetica, Arial, sans-serif" fill="{INK}">' + "".join(parts) + "</svg>"
    )


def _line(x1: float, y1: float, x2: float, y2: float, colour: str = INK) -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour or FAINT}"/>'


def _text(
    words: str, x: float, y: float, anchor: str = "middle", *, bold: bool = False, size: int = 12, colour: str = INK
) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}" fill="{colour}"{weight}>'
        f"{escape(words)}</text>"
    )
