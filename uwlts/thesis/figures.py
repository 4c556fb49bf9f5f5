"""The thesis's figures, redrawn from our results with matplotlib."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from uwlts.report.page_toolkit import BLUE, COLOURS, INK, RED, legend_below, new_figure, plain_text
from uwlts.thesis.measurements import POLYNOMIALS, PROPOSED
from uwlts.thesis.results import CampaignResults, Points
from uwlts.thesis.tables import MEAN, TableRow


def window_distance_figure(results: CampaignResults) -> Figure:
    """Figure 45: a step's profile for several window distances."""
    profiles = {f"d = {each.distance_mm:.1f} mm": each.points_mm for each in results.window_profiles}
    figure, (whole, upper) = new_figure(9.0, 3.2, columns=2)
    _draw_profiles(whole, "One step image for different window distances", profiles)
    _draw_profiles(upper, "Its upper face", profiles)
    depths = [z for points in profiles.values() for _, z in points if np.isfinite(z)]
    if depths:
        # The face is flat within a few tenths of a millimetre for every window distance that is drawn.
        upper.set_ylim(min(depths) - 0.2, min(depths) + 1.2)
    legend_below(figure)
    return figure


def polynomials_figures(results: CampaignResults) -> tuple[Figure, Figure]:
    """Figures 58 and 59: Z(v) and Y(Z) of three profile lines in air and in water."""
    (by_row, rows), (by_depth, depths) = (new_figure(9.0, 3.2, columns=2) for _ in range(2))
    for z_axes, y_axes, (medium, found) in zip(rows, depths, results.polynomials.items(), strict=True):
        for name, line in found.lines.items():
            z_axes.plot(line.centre_px, line.z_mm, label=f"profile line, {name}")
            y_axes.plot(line.z_mm, line.y_mm, label=f"profile line, {name}")
        z_axes.set(title=f"Z(v) in {medium}", xlabel="stripe position v / px", ylabel="Z / mm")
        y_axes.set(title=f"Y(Z) in {medium}", xlabel="Z / mm", ylabel="Y / mm")
    legend_below(by_row)
    legend_below(by_depth)
    return by_row, by_depth


def line_figure(results: CampaignResults) -> Figure:
    """Figure 67: the stripe on a 300 mm pipe at the stand-off, for either orientation of the camera."""
    figure, (axes,) = new_figure(4.8, 3.2)
    profiles = {
        f"along the image's {side}: {profile.length_mm:.1f} mm": profile.points_mm
        for side, profile in results.line_profiles.items()
    }
    _draw_profiles(axes, "Stripe on a 300 mm pipe in water", profiles)
    legend_below(figure, columns=1)
    return figure


def comparison_figure(rows: Sequence[TableRow]) -> Figure:
    """Figure 66: means over the positions, ours as bars with the campaigns' range, the published ones as diamonds."""
    shown = [row for row in rows if row.ours]
    figure, (axes,) = new_figure(9.0, 0.8 + 0.25 * len(shown))
    places = np.arange(len(shown))
    colours = [BLUE if "water" in row.row else RED for row in shown]
    axes.barh(places, [np.mean(row.ours) for row in shown], height=0.55, color=colours, alpha=0.75)
    axes.hlines(places, [min(row.ours) for row in shown], [max(row.ours) for row in shown], color=INK)
    published = [(row.published, place) for place, row in enumerate(shown) if row.published is not None]
    axes.plot(*np.array(published).reshape(-1, 2).T, "D", color=COLOURS[1], markeredgecolor=INK)
    axes.set_yticks(places, [plain_text(_label(row)) for row in shown])
    axes.invert_yaxis()
    axes.set_xlim(left=0.0)
    axes.set_xlabel("mean of the campaigns / mm")
    return figure


def _draw_profiles(axes: Axes, title: str, profiles: Mapping[str, Points]) -> None:
    """Draw points (Y, Z) in mm of profiles by name."""
    for name, points in profiles.items():
        axes.plot(*np.array(points, float).reshape(-1, 2).T, ".", markersize=3, label=name)
    axes.set(title=title, xlabel="Y / mm", ylabel="Z / mm")


def _label(row: TableRow) -> str:
    """Quantity, object, medium and method of a bar."""
    method = {"Table 2": POLYNOMIALS, "Table 3": POLYNOMIALS, "Table 6": PROPOSED, "Table 7": PROPOSED}.get(row.table)
    shown = row.row.replace(f", {MEAN}", "").removesuffix(", thesis image processing")
    return f"{row.quantity}: {shown}" + (f", {method}" if method else "")
