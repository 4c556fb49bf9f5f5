"""The thesis's figures, redrawn from our results as SVG."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from uwlts.report.canvas import ticks
from uwlts.report.svg_plot import COLOURS, FAINT, INK, Curve, Panel, svg
from uwlts.thesis.measurements import POLYNOMIALS, PROPOSED
from uwlts.thesis.tables import MEAN, TableRow

_BAR, _GAP, _LABEL, _ROOM = 15, 12, 300, 560


def window_distance_figure(result: dict[str, Any]) -> str:
    """Figure 45: a step's profile for several window distances."""
    curves = []
    for number, profile in enumerate(result["window_profiles"]):
        y, z = _columns(profile["points_mm"])
        name = f"d = {profile['distance_mm']:.1f} mm"
        curves.append(Curve(name, y, z, COLOURS[number], joined=False))
    title = "One step image for different window distances"
    whole = Panel(title, "Y / mm", "Z / mm", curves, y_range=_range(curves))
    depths = np.concatenate([np.empty(0), *(curve.y for curve in curves)])
    if not len(depths):
        return svg([whole])
    nearest = float(depths.min())
    return svg([whole, Panel("Its upper tread", "Y / mm", "Z / mm", curves, y_range=(nearest - 0.2, nearest + 1.2))])


def polynomials_figures(result: dict[str, Any]) -> tuple[str, str]:
    """Figures 58 and 59: Z(v) and Y(Z) of three profile lines in air and in water."""
    drawn = []
    for title, x_key, y_key, x_label, y_label in (
        ("Z(v)", "centre_px", "z_mm", "stripe position v / px", "Z / mm"),
        ("Y(Z)", "z_mm", "y_mm", "Z / mm", "Y / mm"),
    ):
        panels = []
        for medium, found in result["polynomials"].items():
            curves = [
                Curve(f"profile line, {name}", line[x_key], line[y_key], COLOURS[number], marked=False)
                for number, (name, line) in enumerate(found["lines"].items())
            ]
            panels.append(Panel(f"{title} in {medium}", x_label, y_label, curves, y_range=_range(curves)))
        drawn.append(svg(panels))
    return drawn[0], drawn[1]


def line_figure(result: dict[str, Any]) -> str:
    """Figure 67: the stripe on a 300 mm pipe at the stand-off, for either orientation of the camera."""
    curves = []
    for number, (side, profile) in enumerate(result["line_profiles"].items()):
        y, z = _columns(profile["points_mm"])
        name = f"along the image's {side}: {profile['length_mm']:.1f} mm"
        curves.append(Curve(name, y, z, COLOURS[number], joined=False))
    return svg([Panel("Stripe on a 300 mm pipe in water", "Y / mm", "Z / mm", curves, y_range=_range(curves))])


def comparison_figure(rows: Sequence[TableRow]) -> str:
    """Figure 66: means over the positions, ours as bars with the campaigns' range, the published ones as diamonds."""
    width = _LABEL + _ROOM + 70
    largest = max([0.02, *(max(row.ours) for row in rows if row.ours), *(row.published or 0.0 for row in rows)]) * 1.05
    parts, y = [], 30.0

    def at(value: float) -> float:
        return _LABEL + _ROOM * value / largest

    height = y + len(rows) * (_BAR + _GAP) + 34
    for mark in ticks(0.0, largest, count=10):
        parts.append(f'<line x1="{at(mark):.1f}" y1="20" x2="{at(mark):.1f}" y2="{height - 30}" stroke="{FAINT}"/>')
        parts.append(f'<text x="{at(mark):.1f}" y="{height - 14}" text-anchor="middle">{mark:g}</text>')
    for row in rows:
        if not row.ours:
            continue
        colour = COLOURS[0] if "water" in row.row else COLOURS[3]
        middle = y + _BAR / 2
        parts.append(
            f'<text x="{_LABEL - 8}" y="{middle + 4}" text-anchor="end">{escape(_label(row))}</text>'
            f'<rect x="{_LABEL}" y="{y}" width="{at(row.mean) - _LABEL:.1f}" height="{_BAR}" fill="{colour}" '
            'fill-opacity="0.75"/>'
            f'<line x1="{at(min(row.ours)):.1f}" y1="{middle}" x2="{at(max(row.ours)):.1f}" y2="{middle}" '
            f'stroke="{INK}" stroke-width="2"/>'
        )
        if row.published is not None:
            x = at(row.published)
            parts.append(
                f'<path d="M{x:.1f} {middle - 6} L{x + 6:.1f} {middle} L{x:.1f} {middle + 6} L{x - 6:.1f} {middle} Z" '
                f'fill="{COLOURS[1]}" stroke="{INK}"/>'
            )
        y += _BAR + _GAP
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'font-family="Helvetica, Arial, sans-serif" font-size="12" fill="{INK}">'
        f'<rect width="{width}" height="{height}" fill="white"/>{"".join(parts)}'
        f'<text x="{_LABEL + _ROOM + 8}" y="{height - 14}">mm</text></svg>'
    )


def _label(row: TableRow) -> str:
    """What a bar shows: quantity, object, medium and method."""
    method = {"Table 2": POLYNOMIALS, "Table 3": POLYNOMIALS, "Table 6": PROPOSED, "Table 7": PROPOSED}.get(row.table)
    shown = row.row.replace(f", {MEAN}", "").removesuffix(", thesis image processing")
    return f"{row.quantity}: {shown}" + (f", {method}" if method else "")


def _columns(points: list[list[float]]) -> tuple[np.ndarray, np.ndarray]:
    found = np.array(points, float).reshape(-1, 2)
    found = found[np.isfinite(found).all(axis=1)]
    return found[:, 0], found[:, 1]


def _range(curves: Sequence[Curve]) -> tuple[float, float]:
    values = np.concatenate([np.asarray(curve.y, float) for curve in curves])
    margin = 0.05 * float(np.ptp(values))
    return float(values.min()) - margin, float(values.max()) + margin
