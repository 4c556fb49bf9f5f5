"""Published tables of the thesis: their values, and comparisons with tables of drawn figures."""

import numpy as np
import pytest

from twin.experiments.figures import MEAN, PublishedFigure, draw_means, load_published, select_means, state_agreement
from twin.experiments.reproduce import THESIS_METHODS
from twin.scene.campaign import list_takes, load_campaign
from uwlts.errors import DescriptionError
from uwlts.storage.figure_table import FigureTable, MeasuredFigure

PUBLISHED = load_published("thesis-tables")
PLACES = {
    "spheres": ("near", "near-2", "standoff", "standoff-2", "far", "far-2"),
    "plane": ("near", "near-turned", "standoff", "standoff-turned", "far", "far-turned"),
}

# Retyped from the thesis's Tables 2 and 6: PE, STD and SSE, each by the polynomials in air and in water and
# with one refraction in air and in water.
SPHERES = """
0.58 1.08 0.48 0.69   0.10 0.17 0.09 0.12   0.17 0.06 0.29 0.08
0.47 0.97 0.47 0.66   0.09 0.17 0.08 0.14   0.33 0.15 0.34 0.06
0.57 0.86 0.51 0.51   0.10 0.14 0.08 0.12   0.28 0.02 0.35 0.09
0.49 0.69 0.44 0.51   0.08 0.13 0.08 0.11   0.32 0.11 0.45 0.02
0.50 0.66 0.47 0.46   0.09 0.11 0.08 0.10   0.20 0.25 0.35 0.23
0.48 0.65 0.36 0.48   0.08 0.11 0.07 0.10   0.39 0.10 0.44 0.18
"""
# Tables 3 and 7: RE and STD in the same order.
PLANES = """
0.36 0.55 0.47 0.62   0.05 0.07 0.09 0.10
0.80 0.75 0.52 0.59   0.08 0.12 0.08 0.10
0.34 0.62 0.37 0.50   0.06 0.10 0.07 0.09
0.49 0.41 0.62 0.45   0.09 0.06 0.12 0.08
0.33 0.62 0.33 0.50   0.05 0.10 0.06 0.09
0.36 0.51 0.42 0.47   0.06 0.08 0.08 0.08
"""
# Table 5: STD (there called PE) and SSE with one refraction, then with two.
REFRACTIONS = """
0.07 0.11 0.07 0.05
0.08 0.01 0.08 0.05
0.04 0.04 0.04 0.12
0.06 0.02 0.07 0.04
0.06 0.19 0.06 0.29
0.10 0.16 0.10 0.26
"""
COLUMNS = [(method, medium) for method in ("polynomials", "one refraction") for medium in ("air", "water")]
BUDGET = {
    "index": 0.017,
    "expansion": 0.006,
    "resolution": 0.006,
    "standard": 0.002,
    "SSE": 0.11,
    "PE": 0.14,
    "degrees_of_freedom": 35,
    "expanded": 0.37,
    "correction": 0.11,
    "largest_error": 0.48,
}
# Table 4: three images of a place and all of them; the distance, and the sphere spacing error it leads to.
WINDOW = {"near": (46.3, 42.6, 46.2, 46.2), "standoff": (47.1, 43.4, 45.6, 45.6), "far": (45.1, 47.8, 47.9, 47.8)}
WINDOW_SSE = {"near": (0.09, 0.23, 0.09, 0.09), "standoff": (0.12, 0.17, 0.09, 0.09), "far": (0.10, 0.16, 0.16, 0.16)}


def typed(text):
    return np.array([line.split() for line in text.split("\n") if line], float)


def published_values():
    """Return the values retyped here by scan, method and figure; Table 5 repeats those of Table 6 with others."""
    found = {}
    for thing, text, figures in (
        ("spheres", SPHERES, ("PE, 99.7 %", "STD", "SSE")),
        ("plane", PLANES, ("RE, 99.7 %", "STD")),
    ):
        for place, values in zip(PLACES[thing], typed(text).reshape(6, len(figures), 4), strict=True):
            for figure, of_figure in zip(figures, values, strict=True):
                for (method, medium), value in zip(COLUMNS, of_figure, strict=True):
                    found[f"{thing}-{place}-{medium}", f"{method}, low pass", figure] = value
    for figure, places in (("window distance", WINDOW), ("mean SSE", WINDOW_SSE)):
        for place, values in places.items():
            names = [f"step-{place}-water {n}" for n in (1, 2, 3)] + [f"step-{place}-water"]
            found |= {(name, "one refraction", figure): value for name, value in zip(names, values, strict=True)}
    found["all step images", "one refraction", "window distance"] = 46.3
    found["all step images", "one refraction", "mean SSE"] = 0.09
    found["calibration-two-refractions", "two refractions", "window distance"] = 40.7
    found |= {(f"calibration-polynomials-{m}", "polynomials", "residual of Z"): 0.06 for m in ("air", "water")}
    found["line-width", "one refraction", "line length"] = 185.27
    return found | {("budget of the sphere spacing", "one refraction", name): value for name, value in BUDGET.items()}


def campaign(name, factor=1.0):
    """Return the figures of a campaign that are the published ones times a factor; spacings are too small."""
    rows = []
    for (scan, method, figure), value in published_values().items():
        about = {"campaign": name, "scan": scan, "method": method, "figure": figure}
        if figure == "SSE" and scan.startswith("spheres"):
            rows.append(MeasuredFigure(**about, true_mm=99.18, measured_mm=99.18 - factor * value))
        else:
            rows.append(MeasuredFigure(**about, measured_mm=factor * value))
    return rows


def compare(*rows):
    found = PUBLISHED.compare(FigureTable(rows=tuple(row for each in rows for row in each)))
    return {(row.table, row.method, row.scan, row.figure): row for row in found}


def test_figures_of_the_published_values_themselves():
    rows = compare(campaign("0", 0.9), campaign("1", 1.2))
    for row in rows.values():
        if not row.table.startswith(("Table 5", "Table 8")):
            assert row.ratio == pytest.approx(1.05, rel=1e-9), row
            assert row.mean == pytest.approx(np.mean(row.measured))
    # Spheres: 3 figures, 2 media, 2 methods, 6 positions and the mean; planes: 2 figures; Table 4: 13 sets of images;
    # Table 5 with one refraction: 2 figures; Table 8: 4; Table 9: 10; distance, two residuals, and the line's length.
    assert len(rows) == 3 * 2 * 2 * 7 + 2 * 2 * 2 * 7 + 2 * 13 + 2 * 7 + 4 + 10 + 4
    mean = rows["Table 2, spheres in air", "polynomials, low pass", MEAN, "SSE"]
    # By hand: 0.17 + 0.33 + 0.28 + 0.32 + 0.20 + 0.39 = 1.69; errors count without their sign.
    assert mean.published == pytest.approx(1.69 / 6)
    assert mean.measured == pytest.approx((0.9 * 1.69 / 6, 1.2 * 1.69 / 6))
    # The largest error in water with one refraction is 0.23 mm, of 220 mm.
    share = rows["Table 8, in water", "one refraction, low pass", "all scans", "largest SSE, % of the depth"]
    assert share.published == 0.08
    assert share.measured[0] == pytest.approx(0.9 * 23 / 220)
    # Calculated from values of two digits.
    assert share.ratio == pytest.approx(1.05, rel=0.35)


def test_one_and_two_refractions():
    tables = {each.name: each for each in PUBLISHED.tables}
    std_one, sse_one, std_two, sse_two = typed(REFRACTIONS).T
    for name, std, sse in (("one refraction", std_one, sse_one), ("two refractions", std_two, sse_two)):
        table = tables[f"Table 5, {name}"]
        assert table.figures == {"STD": tuple(std), "SSE": tuple(sse)}
        assert table.method == f"{name}, low pass"
        assert table.scans == tuple(f"spheres-{place}-water" for place in PLACES["spheres"])


def test_all_published_scans_are_recorded_and_measured():
    recorded = {take.name for take in list_takes(load_campaign("thesis"), seed=0)}
    measured = {(method.name, scan) for method in THESIS_METHODS for scan in method.scans}
    assert {scan for _, scan in measured} <= recorded
    for table in PUBLISHED.tables:
        if scans := {scan for scan in table.scans if scan.startswith(("spheres", "plane"))}:
            assert {(table.method, scan) for scan in scans} <= measured, table.name


def test_a_position_that_was_not_measured():
    def lost(rows):
        return [row for row in rows if (row.scan, row.method) != ("spheres-far-water", "one refraction, low pass")]

    key = "Table 6, spheres in water", "one refraction, low pass"
    depth = "Table 8, in water", "one refraction, low pass", "all scans", "largest SSE, % of the depth"
    alone = compare(lost(campaign("0")))
    assert (*key, "spheres-far-water", "STD") not in alone and depth not in alone
    # The mean is over the available positions, also for the published values.
    mean = alone[*key, MEAN, "PE, 99.7 %"]
    assert mean.measured == pytest.approx(((0.69 + 0.66 + 0.51 + 0.51 + 0.48) / 5,))
    assert mean.ratio == pytest.approx(1.0)
    # A campaign without a position is missing in the mean.
    both = compare(campaign("0"), lost(campaign("1", 1.2)))
    assert len(both[*key, "spheres-far-water", "STD"].measured) == 1
    assert both[*key, MEAN, "PE, 99.7 %"].measured == pytest.approx(((0.69 + 0.66 + 0.51 + 0.51 + 0.46 + 0.48) / 6,))
    assert both[depth].measured == pytest.approx((100 * 0.23 / 220,))
    assert PUBLISHED.compare(FigureTable()) == ()


def test_means_are_the_main_result():
    rows = [*compare(campaign("0")).values()]
    assert len(select_means(rows)) == 2 * (6 + 4) + 2
    # The standard deviations of Table 5 are others than those of Table 6.
    assert state_agreement(rows).startswith("21 of 22 means")
    assert state_agreement([*compare(campaign("0", 1.6)).values()]).startswith("0 of 22 means")
    figure = draw_means(rows)
    labels = [text.get_text() for text in figure.axes[0].get_yticklabels()]
    assert labels[0] == "Table 2, spheres in air: PE, 99.7 %" and len(labels) == 22
    row = PublishedFigure(table="t", method="m", scan="s", figure="f", published=0.5, measured=(0.4, 0.7))
    assert row.texts() == ("t", "s", "f", "0.5", "0.55", "0.4 to 0.7", "1.10")


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('title = "Other"\n', "tables"),
        (
            'title = "x"\n[[tables]]\nname = "T"\nmethod = "m"\nscans = ["a", "b"]\nfigures = { STD = [1] }\n',
            "1 values",
        ),
    ],
)
def test_files_without_tables_are_refused(tmp_path, text, found):
    path = tmp_path / "other.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DescriptionError, match=found):
        load_published(path)
