"""Page of a design study: its drawing obeys optics, its charts contain the designs, and no input breaks it."""

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from twin.design.choice import StudyResults, find_pareto_front
from twin.design.designs import (
    Design,
    EvaluatedDesign,
    HighlightedDesign,
    build_sensor,
    count_designs,
    evaluate_designs,
    evaluate_sensor,
    sample_designs,
    select_design,
)
from twin.design.drawing import make_view
from twin.design.figures_of_merit import FIGURES
from twin.design.study import Study, load_study
from twin.design.study_page import best_of_each, choose_pareto_axes, figures_chart, page_text, pareto_chart, sample
from twin.design.study_tables import (
    agreement_text,
    label_of,
    misses,
    number_text,
    round_for_json,
    value_text,
    without_numbers,
    words_of,
)
from twin.design.verification import Agreement
from uwlts.errors import EvaluationError
from uwlts.model.sensor import Sensor
from uwlts.pages.toolkit import write_page

STUDY = load_study("baseline-angle")
BASE = STUDY.sensor


def small(**changes) -> Study:
    """A study of 5 x 6 designs, with values of the Study replaced."""
    variables = {
        "laser.baseline_mm": {"least": 150.0, "most": 400.0, "steps": 5},
        "laser.triangulation_angle_deg": {"least": 15.0, "most": 60.0, "steps": 6},
    }
    given = {"title": "small", "variables": variables, "follow": ("focus", "waist", "volume")} | {
        "objectives": ({"figure": "sigma_z_rms_mm"}, {"figure": "line_mm", "goal": "maximise"}),
        "constraints": {"line_mm": {"least": 160.0}},
    }
    return Study.model_validate(given | changes)


def grid(study: Study) -> tuple[list[Design], dict[str, np.ndarray]]:
    designs = sample_designs(study, 0, count_designs(study))
    return designs, evaluate_designs(study, designs)


def marked_of(study: Study, designs: list[Design], columns: dict[str, np.ndarray]) -> list[HighlightedDesign]:
    base = study.sensor
    best = int(StudyResults(study, columns).best_first[0])
    return [
        HighlightedDesign("base", base, evaluate_sensor(study, "base", base)),
        HighlightedDesign(f"best (design {best})", build_sensor(study, designs[best]), select_design(columns, best)),
    ]


def point(values: dict[str, float]) -> HighlightedDesign:
    """The base sensor as a marked design of these values."""
    return HighlightedDesign("base", BASE, EvaluatedDesign(-1, values, {}, 0.0, ""))


@pytest.fixture(scope="module")
def swept():
    study = small()
    designs, columns = grid(study)
    return study, designs, columns


def changed(**values) -> Sensor:
    """The thesis's sensor with values at paths (``camera__f_number``) replaced, None to leave one out."""
    table = BASE.model_dump(exclude_none=True)
    for path, value in values.items():
        place = table
        *parents, key = path.split("__")
        for parent in parents:
            place = place[parent]
        if value is None:
            del place[key]
        else:
            place[key] = value
    return Sensor.model_validate(table)


SLANT = math.radians(30)
SENSORS = {
    "thesis": (BASE, "water"),
    "height": (changed(camera__stripe_along="height"), "water"),
    "tilted window": (changed(camera__window__tilt_x_deg=-9.0, camera__window__aperture_diameter_mm=90.0), "water"),
    "placed by its axis": (
        changed(
            laser__baseline_mm=None,
            laser__triangulation_angle_deg=None,
            laser__origin_mm=(6.0, -220.0, 15.0),
            laser__axis=(0.0, math.sin(SLANT), math.cos(SLANT)),
        ),
        "water",
    ),
    "no windows, in air": (
        changed(
            camera__window__mounted=False, laser__window__mounted=False, volume={"near_mm": 300.0, "far_mm": 520.0}
        ),
        "air",
    ),
    "distorted": (changed(camera__distortion={"k1": -0.2, "k2": 0.1}), "water"),
}


# --- the drawing ------------------------------------------------------------------------------------------------------


def angle_to(normal: np.ndarray, ray: np.ndarray) -> float:
    """Return the angle between a ray and a normal in the plane, without the drawing's vector functions."""
    return math.remainder(math.atan2(ray[1], ray[0]) - math.atan2(normal[1], normal[0]), math.tau)


@pytest.mark.parametrize("name", ["thesis", "height", "tilted window", "placed by its axis", "distorted"])
def test_drawn_rays_obey_snell_at_both_faces(name):
    sensor, medium = SENSORS[name]
    side = make_view(sensor, sensor.medium(medium))
    indices = [1.0, sensor.camera.window.index(635.0), sensor.medium(medium).refractive_index(635.0)]
    # The window is tilted within the picture's plane at most, so that rays stay in it.
    window, checked = side.camera.window, 0
    for ray in side.edges:
        along = window[1] - window[0]
        normal = np.array([-along[1], along[0]])
        normal *= np.sign(normal @ (window[2] - window[1]))
        inner, outer = (np.cross(np.append(ray[k] - window[c], 0), np.append(along, 0))[2] for k, c in ((1, 0), (2, 2)))
        # On the faces: rounding of coordinates of some 100 mm, times the window's width, is far below 1e-9 mm2.
        assert abs(inner) < 1e-9 and abs(outer) < 1e-9
        sines = [n * math.sin(angle_to(normal, b - a)) for n, a, b in zip(indices, ray[:-1], ray[1:], strict=True)]
        # Equal up to rounding, and not because the rays run straight through.
        assert sines == pytest.approx([sines[0]] * 3, abs=1e-12)
        assert abs(sines[0]) > 0.01
        checked += 1
    assert checked == 2


@pytest.mark.parametrize("name", SENSORS)
def test_drawn_volume_has_the_description_s_ends_and_lies_on_the_sheet(name):
    sensor, medium = SENSORS[name]
    side = make_view(sensor, sensor.medium(medium))
    window = sensor.camera.window
    outer = window.distance_mm + window.thickness_mm / math.cos(math.radians(window.tilt_x_deg))
    depths = outer + np.array([sensor.volume.near_mm, sensor.volume.far_mm])
    assert side.volume[:, 1] == pytest.approx(depths, abs=1e-9)
    # Laser, crossing, volume and its visible part are on one line, at the angle in its label.
    points = np.vstack([side.laser.origin, side.crossing, side.volume, side.in_view])
    direction = np.array([math.sin(side.angle_rad), -math.cos(side.angle_rad)])
    aside = (points - side.crossing) @ np.array([direction[1], -direction[0]])
    assert aside == pytest.approx(np.zeros(len(points)), abs=1e-9)
    first, last = side.in_view[:, 1]
    assert depths[0] - 1e-9 <= first < last <= depths[1] + 1e-9


def test_a_rolled_laser_is_drawn_with_its_sheet_as_a_line():
    sensor = changed(laser__roll_deg=10.0)
    side = make_view(sensor, sensor.medium("water"))
    assert side.baseline_mm == pytest.approx(265.0)
    assert 200 < side.laser.origin[0] < 265
    slope = (side.sheet[-1] - side.laser.origin) / (side.crossing - side.laser.origin)
    assert slope[0] == pytest.approx(slope[1], rel=1e-9)


# --- the Pareto front -------------------------------------------------------------------------------------------------


def front_by_definition(values: np.ndarray) -> list[bool]:
    def beats(a, b):
        return all(x <= y for x, y in zip(a, b, strict=True)) and any(x < y for x, y in zip(a, b, strict=True))

    known = [not any(map(math.isnan, row)) for row in values]
    return [
        ok and not any(other and beats(b, a) for b, other in zip(values, known, strict=True))
        for a, ok in zip(values, known, strict=True)
    ]


numbers = st.one_of(st.integers(-3, 3).map(float), st.sampled_from([math.nan, math.inf, -math.inf]))


@settings(deadline=None, max_examples=200)
@given(st.integers(1, 4).flatmap(lambda m: st.lists(st.lists(numbers, min_size=m, max_size=m), max_size=25)))
def test_the_front_is_the_one_of_the_definition(rows):
    values = np.array(rows, dtype=float).reshape(len(rows), len(rows[0]) if rows else 2)
    assert find_pareto_front(values).tolist() == front_by_definition(values.tolist())


def test_the_front_of_many_designs():
    values = np.random.default_rng(1).random((100_000, 2))
    front = find_pareto_front(values)
    found = values[front][np.argsort(values[front, 0])]
    # Along the front one value rises while the other falls, and no value is below it.
    assert len(found) > 5 and (np.diff(found[:, 1]) < 0).all()
    below = np.searchsorted(found[:, 0], values[:, 0], side="right") - 1
    assert (values[below >= 0, 1] >= found[below[below >= 0], 1]).all()


# --- names ------------------------------------------------------------------------------------------------------------


def test_every_figure_has_a_name_of_its_own():
    assert all(words for words, _ in FIGURES.values())
    assert len({words for words, _ in FIGURES.values()}) == len(FIGURES)


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("laser.baseline_mm", "laser baseline (mm)"),
        ("camera.f_number", "camera f-number"),
        ("camera.window.tilt_x_deg", "camera window tilt x (°)"),
        ("laser.beam_quality_m2", "laser beam quality M²"),
        ("sigma_z_rms_mm", "σ Z, rms over the volume (mm)"),
        ("my_camera", "my camera"),
        ("media.water.water", "water"),
        ("media.water.turbidity", "water turbidity"),
        ("detector.dark_current_e_per_s", "detector dark current (e⁻/s)"),
    ],
)
def test_labels(name, label):
    assert label_of(name) == label


def test_numbers_in_words():
    assert [number_text(v) for v in (0.0123456, 1234.5678, -2.5, math.nan, 1e-5, 250.0)] == [
        "0.01235",
        "1235",
        "\N{MINUS SIGN}2.5",
        "\N{EN DASH}",
        "0.00001",
        "250",
    ]
    assert value_text("sigma_z_rms_mm", 0.03934, unit=False) == "0.039"
    assert value_text("laser_class", 4.0) == "3B"
    assert value_text("laser.triangulation_angle_deg", np.float64(35)) == "35°"
    assert round_for_json([1.2345678, math.inf, math.nan, 0.000123456]) == [1.2346, None, None, 0.00012346]
    assert without_numbers("begins -12.5 mm and 3e-4 mm behind x2") == "begins … mm and … mm behind x2"


# --- charts -----------------------------------------------------------------------------------------------------------


def panel_of(figure, title: str) -> int:
    """Number of the panel with a title."""
    return [each.text for each in figure.layout.annotations].index(title)


def test_two_ranges_show_each_working_design_with_its_figure(swept):
    study, designs, columns = swept
    marked = marked_of(study, designs, columns)
    figure, caption = figures_chart(StudyResults(study, columns), marked)
    panel = panel_of(figure, "line length in the middle (mm)")
    drawn = [trace for trace in figure.data if trace.xaxis == ("x" if panel == 0 else f"x{panel + 1}")]
    works = columns["failure"] == ""
    assert list(drawn[0].x) == round_for_json(columns["laser.baseline_mm"][works])
    assert list(drawn[0].y) == round_for_json(columns["laser.triangulation_angle_deg"][works])
    assert list(drawn[0].marker.color) == round_for_json(columns["line_mm"][works])
    hollow = np.array(drawn[0].marker.symbol) == "circle-open"
    assert hollow.tolist() == (columns["violation"][works] > 0).tolist() and 0 < hollow.sum() < works.sum()
    assert [trace.text for trace in drawn[1:]] == [(f"<b>{one.label}</b>",) for one in marked]
    assert figure.layout.xaxis.title.text == "laser baseline (mm)" and "Hollow" in caption


def test_the_front_in_the_chart_is_that_of_the_designs_that_meet_the_constraints(swept):
    study, _, columns = swept
    table = StudyResults(study, columns)
    assert choose_pareto_axes(table) == (("sigma_z_rms_mm", 1), ("line_mm", -1))
    figure = pareto_chart(table, [point({"sigma_z_rms_mm": 0.03, "line_mm": 160.0})])[0]
    front = next(trace for trace in figure.data if trace.name.startswith("Pareto"))
    meets = columns["violation"] == 0
    values = np.column_stack([columns["sigma_z_rms_mm"], -columns["line_mm"]])[meets]
    expected = values[front_by_definition(values.tolist())]
    assert sorted(front.x) == round_for_json(np.sort(expected[:, 0]))
    assert [trace.text for trace in figure.data if not trace.name] == [("<b>base</b>",)]


def test_sampling_keeps_what_is_to_be_kept():
    candidates = np.arange(1000) % 2 == 0
    kept = np.zeros(1000, bool)
    kept[[0, 10]] = True
    chosen = sample(candidates, kept, 100)
    assert chosen.sum() == 100 and chosen[kept].all() and not chosen[~candidates].any()


def test_one_range_is_an_axis_and_none_gives_ranks():
    lens = {"f/4": {"camera.f_number": 4.0}, "f/8": {"camera.f_number": 8.0}}
    study = small(variables={"laser.power_mw": {"least": 1, "most": 20, "steps": 4}}, choices={"lens": lens}, follow=())
    _, columns = grid(study)
    base = point({"laser.power_mw": 7.0, "line_mm": 9.0})
    figure, caption = figures_chart(StudyResults(study, columns), [base])
    assert sorted(set(figure.data[0].x)) == pytest.approx([1, 22 / 3, 41 / 3, 20], rel=1e-4)
    panel = panel_of(figure, "line length in the middle (mm)")
    axis = "x" if panel == 0 else f"x{panel + 1}"
    (marked,) = (trace for trace in figure.data if trace.xaxis == axis and trace.text == ("<b>base</b>",))
    assert (list(marked.x), list(marked.y)) == ([7.0], [9.0])
    assert "Dashed: bounds." in caption and [shape.y0 for shape in figure.layout.shapes] == [160.0]
    study = small(variables={}, choices={"lens": lens})
    _, columns = grid(study)
    first = figures_chart(StudyResults(study, columns), [])[0].data[0]
    best = columns["sigma_z_rms_mm"].argmin()
    assert first.x[best] == 1.0 and list(first.y) == round_for_json(columns["sigma_z_rms_mm"])


# --- the page ---------------------------------------------------------------------------------------------------------


class Page(HTMLParser):
    """Contents of a page: text, attributes that load files, and the figures' JSON."""

    VOID = {"meta", "br", "link", "img", "rect", "path", "line", "circle"}

    def __init__(self, text: str):
        super().__init__()
        self.open: list[str] = []
        self.words: list[str] = []
        self.loads: list[str] = []
        self.figures: list[dict] = []
        self._kind = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        table = dict(attrs)
        self.loads += [value for key, value in attrs if key in ("src", "href", "action", "data", "poster", "srcset")]
        self._kind = table.get("type", "code") if tag == "script" else "style" if tag == "style" else ""
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.loads += [value for key, value in attrs if key in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag
        self._kind = ""

    def handle_data(self, data):
        if self._kind == "application/json":
            self.figures.append(json.loads(data, parse_constant=lambda name: pytest.fail(f"{name} is no JSON")))
        elif not self._kind:
            self.words.append(data)

    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def verification(**changes) -> Agreement:
    found = Agreement(
        "best",
        3,
        z_mm=[-50.0, 0.0, 50.0],
        predicted_mm=[0.01, 0.02, 0.03],
        rendered_mm=[0.011, 0.022, math.nan],
        error_mm=[0.001, -0.004, math.nan],
        line_mm=[150.0, 160.0, 0.0],
        ratio=1.1,
        agrees=True,
        exposure_ms=1.25,
        predicted_exposure_ms=1.2,
        seconds=80.0,
    )
    return replace(found, **changes)


def test_the_page_says_what_an_engineer_needs(swept, tmp_path):
    study, designs, columns = swept
    marked = marked_of(study, designs, columns)
    bad = verification(label="base", design=-1, ratio=2.5, agrees=False, rendered_mm=[0.01, 0.05, 0.03])
    rows = [verification(), bad]
    path = tmp_path / "report.html"
    path.write_text("older")
    written = page_text(study, columns, marked=marked, agreements=rows, notes=["A note & more."])
    write_page(path, written, overwrite=True)
    raw = path.read_text(encoding="utf-8")
    page = Page(raw)
    assert not page.open
    text, chosen = page.text(), marked[-1].design.table()
    assert (columns["violation"] == 0).sum() > 5
    works = (columns["failure"] == "").sum()
    assert (
        f"30 evaluated, all of a grid; {works} work, {(columns['violation'] == 0).sum()} meet all constraints" in text
    )
    for name in ("laser.baseline_mm", "laser.triangulation_angle_deg", "sigma_z_rms_mm", "line_mm", "standoff_mm"):
        tile = f"{words_of(name)} {value_text(name, chosen[name])}"
        assert tile.replace("\N{NO-BREAK SPACE}", " ") in text
    assert "A note & more." in text and "laser baseline from 150" in text
    assert "Formulas and rendering disagree by a factor 2.5 (limit 1.5), most at Z = 0 mm" in text
    assert "20 µm predicted, 50 µm rendered" in text
    assert "the measuring volume would begin … mm behind the window's outer face" in text
    # The page loads nothing from the network: links stay within the page, and the policy forbids the rest.
    assert page.loads and all(link.startswith(("#", "data:image/png")) for link in page.loads)
    styles = raw.split("<script")[0]
    assert "default-src 'none'" in styles and "@import" not in styles and not re.findall(r"url\((?!#)", styles)
    # Figures and front; drawing and two verifications.
    assert len(page.figures) == 2 and styles.count("<svg") == 3
    assert len(raw) < 7e6


def test_figures_hold_rounded_numbers_only(swept):
    study, designs, columns = swept
    page = Page(page_text(study, columns, marked=marked_of(study, designs, columns), agreements=[]))
    shown = [trace for trace in page.figures[1]["data"] if trace.get("showlegend", True)]
    numbers = [value for trace in shown for value in (*trace["x"], *trace["y"])]
    assert len(numbers) == 2 * (columns["failure"] == "").sum()
    assert all(float(f"{value:.5g}") == value for value in numbers)


def test_labels_are_escaped():
    lens = {'<script>alert("1")</script>': {"camera.f_number": 4.0}, "f & 8": {"camera.f_number": 8.0}}
    study = small(title="<b>bold</b>", choices={"<i>lens</i>": lens})
    designs, columns = grid(study)
    marked = [HighlightedDesign("<u>me</u>", m.sensor, m.design) for m in marked_of(study, designs, columns)]
    row = verification(label="<u>me</u>", failure="no <marks>", agrees=False)
    raw = page_text(study, columns, marked=marked, agreements=[row], notes=["<hr>"])
    page = Page(raw)
    assert not page.open
    before, _, _ = raw.partition('<script type="application/json"')
    for tag in ("<script>", "<b>bold", "<u>", "<hr>", "<marks>", "<i>lens"):
        assert tag not in before.split("<body>")[1]
    assert "<b>bold</b>" in page.text() and "no <marks>" in page.text()
    assert ["<b>&lt;u&gt;me&lt;/u&gt;</b>"] in [trace.get("text") for trace in page.figures[1]["data"]]


def test_a_page_where_nothing_meets_the_constraints():
    study = small(constraints={"coverage": {"least": 2.0}})
    designs, columns = grid(study)
    page = Page(page_text(study, columns, marked=marked_of(study, designs, columns), agreements=[]))
    assert "No design meets all constraints: the front is that of all working designs." in page.text()
    assert "misses its bound: at least 200 % is required" in page.text()
    assert len(page.figures) == 2


def test_each_combination_of_choices_has_its_best_design():
    lens = {"f/4": {"camera.f_number": 4.0}, "f/8": {"camera.f_number": 8.0}}
    waters = {"media.water.water": {"values": ["pure", "clear", "coastal"]}}
    powers = {"laser.power_mw": {"least": 1, "most": 20, "steps": 4}}
    study = small(variables=waters | powers, choices={"lens": lens}, follow=())
    designs, columns = grid(study)
    head, rows = best_of_each(StudyResults(study, columns))
    assert head[:3] == ["design", "water", "lens"] and len(rows) == 6
    assert [row[1:3] for row in rows] == [[w, f] for w in ("pure", "clear", "coastal") for f in ("f/4", "f/8")]
    sigma = columns["sigma_z_rms_mm"]
    for number, water, f, *_ in rows:
        among = (columns["media.water.water"] == water) & (columns["lens"] == f)
        assert sigma[columns["design"] == int(number)].item() == sigma[among & (columns["violation"] == 0)].min()
    # The finest is that with the strongest laser, at the end of its range.
    text = Page(page_text(study, columns, marked=marked_of(study, designs, columns), agreements=[])).text()
    assert "Best for each choice" in text and "at the end of its range: widen it" in text


def test_a_page_of_one_design():
    study = small()
    designs, columns = grid(study)
    place = int(np.flatnonzero(columns["violation"] == 0)[0])
    one = {name: values[place : place + 1] for name, values in columns.items()}
    marked = [HighlightedDesign("only", build_sensor(study, designs[place]), select_design(columns, place))]
    page = Page(page_text(study, one, marked=marked, agreements=[]))
    assert "1 evaluated" in page.text() and not page.open


def test_results_of_another_study_are_refused(swept):
    _, _, columns = swept
    other = small(variables={"camera.f_number": {"least": 2, "most": 8}})
    with pytest.raises(EvaluationError, match=r"lack the columns camera\.f_number"):
        StudyResults(other, columns)


def test_verdicts():
    assert agreement_text(verification()).startswith("Formulas and rendering agree")
    assert "no marks" in agreement_text(verification(failure="no marks", agrees=False))
    lost = verification(agrees=False, ratio=math.nan, rendered_mm=[math.nan] * 3)
    assert "could not be compared" in agreement_text(lost)


def test_missed_bounds_in_words():
    study = small(constraints={"line_mm": {"least": 100.0, "most": 200.0}})
    assert misses(study, {"line_mm": 250.0}) == {"line_mm": "at most 200\N{NO-BREAK SPACE}mm is required"}
    assert not misses(study, {"line_mm": 150.0})
