"""Line charts as plain SVG: panels side by side with axes, ticks, units, bands and one legend below."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from uwlts.report.canvas import ticks

INK, FAINT = "#2b3440", "#dde2e8"
COLOURS = ("#3573b1", "#d9822b", "#2e8b57", "#b5303c", "#7b4fa3", "#5b6770", "#12a3a8", "#a0722a")
WIDTH, HEIGHT = 430, 290
LEFT, RIGHT, TOP, BOTTOM = 66, 14, 34, 52
LEGEND_LINE, LETTER = 20, 6.9
_DASH = 'stroke-dasharray="6 4"'


@dataclass(frozen=True)
class Curve:
    """Values y over x; ``error`` is a standard error, ``marked`` draws dots, ``joined`` the line between them."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str
    error: Sequence[float] | None = None
    marked: bool = True
    joined: bool = True
    dashed: bool = False


@dataclass(frozen=True)
class Band:
    """A shaded range of y, over a range of x or over all of it."""

    name: str
    low: float
    high: float
    x: tuple[float, float] | None = None
    colour: str = "#e9dcc4"


@dataclass(frozen=True)
class Panel:
    """One pair of axes. A logarithmic axis is ticked at ``x_ticks``, or at 1, 2 and 5 in every decade."""

    title: str
    x_label: str
    y_label: str
    curves: Sequence[Curve]
    bands: Sequence[Band] = ()
    log_x: bool = False
    log_y: bool = False
    x_ticks: Sequence[float] | None = None
    y_range: tuple[float, float] | None = None


@dataclass(frozen=True)
class _Axis:
    low: float
    high: float
    start: float
    end: float
    log: bool

    def at(self, value: float) -> float:
        low, high, value = (math.log(v) if self.log else v for v in (self.low, self.high, value))
        return self.start + (self.end - self.start) * (value - low) / (high - low)

    def ticks(self) -> list[float]:
        if not self.log:
            return ticks(self.low, self.high, count=6)
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        marks = [step * 10.0**decade for decade in decades for step in (1, 2, 5)]
        return [mark for mark in marks if self.low * 0.999 <= mark <= self.high * 1.001]


def draw(path: Path, panels: Sequence[Panel]) -> None:
    """Write the panels, in one row, as an SVG file."""
    path.write_text(svg(panels), encoding="utf-8")


def svg(panels: Sequence[Panel]) -> str:
    """The panels, in one row, as the text of an SVG picture."""
    entries = {item.name: item for panel in panels for item in (*panel.bands, *panel.curves)}
    width = len(panels) * WIDTH
    legend, height = _legend(list(entries.values()), width)
    body = [_panel(panel, number * WIDTH, f"clip{number}") for number, panel in enumerate(panels)]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'font-family="Helvetica, Arial, sans-serif" font-size="12" fill="{INK}">\n'
        f'<rect width="{width}" height="{height}" fill="white"/>\n' + "\n".join([*body, legend]) + "\n</svg>\n"
    )


def _panel(panel: Panel, left: float, clip: str) -> str:
    xs = np.concatenate([np.asarray(curve.x, float) for curve in panel.curves])
    x_low, x_high = float(xs.min()), float(xs.max())
    margin = (x_high / x_low) ** 0.04 if panel.log_x else 0.03 * (x_high - x_low)
    x_low, x_high = (x_low / margin, x_high * margin) if panel.log_x else (x_low - margin, x_high + margin)
    x = _Axis(x_low, x_high, left + LEFT, left + WIDTH - RIGHT, panel.log_x)
    y = _Axis(*(panel.y_range or _extent(panel)), HEIGHT - BOTTOM, TOP, panel.log_y)
    parts = [
        f'<clipPath id="{clip}"><rect x="{x.start}" y="{y.end}" width="{x.end - x.start}" '
        f'height="{y.start - y.end}"/></clipPath>'
    ]
    for band in panel.bands:
        first, last = (x.at(v) for v in band.x) if band.x else (x.start, x.end)
        top, foot = y.at(band.high), y.at(band.low)
        parts.append(
            f'<rect x="{first:.1f}" y="{top:.1f}" width="{last - first:.1f}" height="{foot - top:.1f}" '
            f'fill="{band.colour}" clip-path="url(#{clip})"/>'
        )
    for mark in panel.x_ticks or x.ticks():
        at = x.at(mark)
        parts += [_line(at, y.start, at, y.end, FAINT), _text(_number(mark), at, y.start + 17)]
    for mark in y.ticks():
        at = y.at(mark)
        parts += [_line(x.start, at, x.end, at, FAINT), _text(_number(mark), x.start - 6, at + 4, "end")]
    parts += [_line(x.start, y.start, x.end, y.start, INK), _line(x.start, y.start, x.start, y.end, INK)]
    parts += [f'<g clip-path="url(#{clip})">', *(_curve(curve, x, y) for curve in panel.curves), "</g>"]
    middle_x, middle_y = (x.start + x.end) / 2, (y.start + y.end) / 2
    parts += [_text(panel.title, x.start, 20, "start", bold=True), _text(panel.x_label, middle_x, HEIGHT - 14)]
    at = f"{left + 14:.0f} {middle_y:.0f}"
    parts.append(f'<text transform="translate({at}) rotate(-90)" text-anchor="middle">{escape(panel.y_label)}</text>')
    return "\n".join(parts)


def _extent(panel: Panel) -> tuple[float, float]:
    values = np.concatenate([np.asarray(curve.y, float) for curve in panel.curves])
    values = np.concatenate([values[np.isfinite(values)], [v for b in panel.bands for v in (b.low, b.high)]])
    low, high = float(values.min()), float(values.max())
    if panel.log_y:
        return low / 1.3, high * 1.3
    low = min(low, 0.0)
    margin = 0.06 * (high - low)
    return (low - margin if low < 0 else 0.0), high + margin


def _curve(curve: Curve, x: _Axis, y: _Axis) -> str:
    places = [(x.at(a), y.at(b)) for a, b in zip(curve.x, curve.y, strict=True) if math.isfinite(b)]
    parts = []
    if curve.joined:
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in places)
        dash = _DASH if curve.dashed else ""
        parts.append(f'<polyline points="{line}" fill="none" stroke="{curve.colour}" stroke-width="1.8" {dash}/>')
    if curve.error is not None:
        for a, b, e in zip(curve.x, curve.y, curve.error, strict=True):
            low = max(b - e, y.low) if y.log else b - e
            parts.append(_line(x.at(a), y.at(low), x.at(a), y.at(b + e), curve.colour))
    if curve.marked:
        parts += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3" fill="{curve.colour}"/>' for a, b in places]
    return "\n".join(parts)


def _legend(entries: list[Curve | Band], width: float) -> tuple[str, float]:
    """The legend, in as many lines as it needs, and the height of the whole picture."""
    parts, at, line = [], float(LEFT), HEIGHT + 8.0
    for item in entries:
        length = 34 + LETTER * len(item.name) + 16
        if at + length > width and at > LEFT:
            at, line = float(LEFT), line + LEGEND_LINE
        if isinstance(item, Band):
            parts.append(f'<rect x="{at}" y="{line - 6}" width="26" height="11" fill="{item.colour}"/>')
        else:
            dash = _DASH if item.dashed else ""
            if item.joined:
                parts.append(_line(at, line, at + 26, line, item.colour, f'stroke-width="1.8" {dash}'))
            if item.marked:
                parts.append(f'<circle cx="{at + 13}" cy="{line}" r="3" fill="{item.colour}"/>')
        parts.append(_text(item.name, at + 33, line + 4, "start"))
        at += length
    return "\n".join(parts), line + LEGEND_LINE


def _line(x1: float, y1: float, x2: float, y2: float, colour: str, style: str = "") -> str:
    return f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" {style}/>'


def _text(text: str, x: float, y: float, anchor: str = "middle", *, bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{weight}>{escape(text)}</text>'


def _number(value: float) -> str:
    return f"{value:.6g}".replace("-", "\N{MINUS SIGN}")
