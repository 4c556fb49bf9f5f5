"""Interactive figures of one measurement: its cloud, its deviations, and where along the stripe they lie."""

from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go

from uwlts.cloud import PointCloud
from uwlts.report.cloud_picture import view_direction
from uwlts.report.colours import LIMIT_STD, PLAIN, UNKNOWN, colour_limit_mm, plotly_scale
from uwlts.report.numbers import as_fine_as, unit_for
from uwlts.report.page_toolkit import typographic

MOST_POINTS = 15_000
INK, FAINT, BLUE, RED = "#2b3440", "#dde2e8", "#3573b1", "#b5303c"
_SEED = 0
_PLACE = "X %{x:.3f}, Y %{y:.3f}, Z %{z:.3f} mm"
_BINS, _SHOWN_STD = 81, 4.0
_PLACES, _LEAST_OF_PLACE = 120, 5


@dataclass(frozen=True, eq=False)
class Drawn:
    """A figure for a page: plotly's JSON, whether it needs WebGL, and what it shows, in a sentence."""

    figure: go.Figure
    caption: str
    solid: bool = False


def layout(figure: go.Figure, *, x: str, y: str, height: int = 320) -> go.Figure:
    """Put on axes with titles and the page's plain look."""
    axis = {"gridcolor": FAINT, "linecolor": INK, "ticks": "outside", "zeroline": False, "automargin": True}
    return figure.update_layout(
        template="none", height=height, margin={"l": 70, "r": 20, "t": 36, "b": 56}, font={"size": 13, "color": INK},
        xaxis=axis | {"title": {"text": x, "standoff": 10}}, yaxis=axis | {"title": {"text": y, "standoff": 12}},
        legend={"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0}, hoverlabel={"namelength": -1},
        paper_bgcolor="white", plot_bgcolor="white", separators=". ",
    )  # fmt: skip


def cloud_figure(cloud: PointCloud) -> Drawn:
    """Points in the OCS with equal scales, seen from the sensor's side, coloured by deviation."""
    chosen = np.arange(len(cloud))
    shown = f"All {len(cloud):,} points."
    if len(cloud) > MOST_POINTS:
        chosen = np.sort(np.random.default_rng(_SEED).choice(len(cloud), MOST_POINTS, replace=False))
        shown = f"{MOST_POINTS:,} of {len(cloud):,} points, drawn at random."
    points = cloud.points_mm[chosen].astype(np.float32)
    figure = go.Figure()
    unknown, coloured = np.ones(len(chosen), bool), cloud.deviation_mm is not None
    if coloured:
        limit = colour_limit_mm(cloud.deviation_mm)
        unit, factor = unit_for(limit)
        deviation = cloud.deviation_mm[chosen] * np.float32(factor)
        unknown = np.isnan(deviation)
        figure.add_scatter3d(
            **_xyz(points[~unknown]), mode="markers", name="evaluated",
            marker={
                "size": 2, "color": deviation[~unknown], "colorscale": plotly_scale(),
                "cmin": -factor * limit, "cmax": factor * limit,
                "colorbar": {"title": {"text": f"deviation<br>/ {unit}"}, "thickness": 16, "len": 0.8},
            },
            hovertemplate=f"{_PLACE}<br>deviation %{{marker.color:.4g}} {unit}<extra></extra>",
        )  # fmt: skip
        shown += f" The colours end at {LIMIT_STD:g} standard deviations, ±{factor * limit:.3g} {unit}."
    if unknown.any():
        figure.add_scatter3d(
            **_xyz(points[unknown]), mode="markers", name="not evaluated",
            marker={"size": 1.5, "color": "rgb({}, {}, {})".format(*(UNKNOWN if coloured else PLAIN))},
            hovertemplate=f"{_PLACE}<extra>not evaluated</extra>",
        )  # fmt: skip
        shown += (
            " Dark points were not evaluated: stray, near an edge, or beside the artefact." if coloured
            else " The file holds no deviations; let the evaluation write a coloured cloud to see them here."
        )  # fmt: skip
    eye = dict(zip("xyz", (-1.6 * view_direction()).tolist(), strict=True))
    scales, shape = _equal_scales(cloud.points_mm)
    figure.update_layout(
        template="none", height=520, margin={"l": 0, "r": 0, "t": 0, "b": 0}, showlegend=False,
        font={"size": 12, "color": INK},
        scene={
            **scales, "aspectmode": "manual", "aspectratio": shape, "dragmode": "orbit",
            "camera": {"eye": eye, "up": {"x": 0, "y": 0, "z": -1}, "projection": {"type": "orthographic"}},
        },
    )  # fmt: skip
    return Drawn(figure, f"{shown} X: direction of the scan; Y: along the stripe; Z: away from the sensor.", solid=True)


def histogram_figure(deviation_mm: np.ndarray) -> Drawn:
    """Distribution of the deviations beside the normal one of the same mean and standard deviation."""
    finite = deviation_mm[np.isfinite(deviation_mm)].astype(np.float64)
    mean, std = float(finite.mean()), float(finite.std())
    unit, factor = unit_for(std)
    reach = max(_SHOWN_STD * std, 1e-9)
    counts, edges = np.histogram(finite, bins=_BINS, range=(mean - reach, mean + reach))
    middles = factor * (edges[1:] + edges[:-1]) / 2
    figure = go.Figure()
    figure.add_bar(x=middles, y=counts, width=factor * 2 * reach / _BINS, marker={"color": "#9dbad6"}, name="points")
    if std > 0:
        normal = len(finite) * (2 * reach / _BINS) / (std * np.sqrt(2 * np.pi))
        curve = normal * np.exp(-0.5 * ((edges[1:] + edges[:-1]) / 2 - mean) ** 2 / std**2)
        line = {"color": INK, "width": 1.5}
        figure.add_scatter(x=middles, y=curve, mode="lines", line=line, name="normal distribution")
    for place, dash in ((mean, "solid"), (mean - std, "dot"), (mean + std, "dot")):
        figure.add_vline(x=factor * place, line={"color": RED, "width": 1.5, "dash": dash})
    layout(figure, x=f"deviation / {unit}", y="points per bin").update_layout(bargap=0)
    beyond = len(finite) - int(counts.sum())
    shown = [typographic(as_fine_as(factor * value, factor * std)) for value in (mean, std)]
    caption = f"Mean {shown[0]} {unit} (solid line), standard deviation {shown[1]} {unit} (dotted)."
    return Drawn(figure, caption + (f" {beyond:,} of {len(finite):,} points lie farther out." if beyond else ""))


def along_stripe_figure(cloud: PointCloud) -> Drawn | None:
    """Mean and scatter of the deviations in short intervals of Y; None where too few points say anything."""
    if cloud.deviation_mm is None:
        return None
    known = np.isfinite(cloud.deviation_mm)
    y, deviation = cloud.points_mm[known, 1], cloud.deviation_mm[known].astype(np.float64)
    if len(y) < _LEAST_OF_PLACE or not np.ptp(y) > 0:
        return None
    edges = np.linspace(y.min(), y.max(), _PLACES + 1)
    place = np.clip(np.searchsorted(edges, y, side="right") - 1, 0, _PLACES - 1)
    count = np.bincount(place, minlength=_PLACES)
    enough = count >= _LEAST_OF_PLACE
    if not enough.any():
        return None
    mean = np.bincount(place, deviation, _PLACES)[enough] / count[enough]
    square = np.bincount(place, deviation**2, _PLACES)[enough] / count[enough]
    std = np.sqrt(np.maximum(square - mean**2, 0))
    unit, factor = unit_for(float(deviation.std()))
    # A gap in the stripe stays a gap in the curve.
    middles = (edges[1:] + edges[:-1]) / 2
    curves = np.full((3, _PLACES), np.nan)
    curves[:, enough] = factor * np.array([mean, mean - std, mean + std])
    figure = go.Figure()
    for number, name in ((1, "mean - standard deviation"), (2, "mean ± standard deviation")):
        line = {"color": "#9dbad6", "width": 1}
        figure.add_scatter(x=middles, y=curves[number], mode="lines", line=line, name=name, showlegend=number == 2)
    figure.add_scatter(x=middles, y=curves[0], mode="lines", line={"color": BLUE, "width": 2}, name="mean")
    figure.add_hline(y=0, line={"color": INK, "width": 1})
    layout(figure, x="Y, along the stripe / mm", y=f"deviation / {unit}")
    return Drawn(figure, f"Over all images, in intervals of {edges[1] - edges[0]:.2g} mm along the stripe.")


def _equal_scales(points: np.ndarray) -> tuple[dict[str, dict], dict[str, float]]:
    """Axes that just hold the points, and the shape of the box in which a millimetre is the same along each."""
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.ones(3))
    half = np.maximum(0.52 * (high - low), 0.02 * max(1e-6, float((high - low).max())))
    middle = (low + high) / 2
    axes = {
        f"{name}axis": {
            "title": {"text": f"{name.upper()} / mm"}, "gridcolor": FAINT, "color": INK,
            "range": [middle[number] - half[number], middle[number] + half[number]], "nticks": 8 if number == 1 else 5,
        }
        for number, name in enumerate("xyz")
    }  # fmt: skip
    return axes, dict(zip("xyz", (2.7 * half / half.max()).tolist(), strict=True))


def _xyz(points: np.ndarray) -> dict[str, np.ndarray]:
    return dict(zip("xyz", points.T, strict=True))
