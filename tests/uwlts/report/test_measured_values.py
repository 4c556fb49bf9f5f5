"""Lists of values measured by hand: verdicts by the whole interval, undo, and files with the same content."""

import csv
import json
from itertools import product

import numpy as np
import pytest

from tests.uwlts.desk.test_analyses import weld_cloud
from uwlts.errors import DescriptionError, OutputError
from uwlts.evaluation.figures import FigureUncertainty
from uwlts.inspection.picking import MeasuredValues, PickedMeasurement, read_measured
from uwlts.report import write_findings
from uwlts.report.findings_page import write_measured

WITHOUT = "the cloud has no uncertainty"
# Expanded uncertainty 2 * sqrt(3^2 + 4^2) = 10 um.
LENGTH = PickedMeasurement("length", {"distance": 5.0}, {"distance": FigureUncertainty(0.003, 0.004)}, 2, 0)
SPHERE = PickedMeasurement("sphere", {"diameter": 40.0, "standard deviation": 0.02}, {}, 300, 1)


def listed(*measured: PickedMeasurement) -> MeasuredValues:
    values = MeasuredValues()
    for each in measured:
        values = values.add(each, source="plate.cloud.h5", without_interval=WITHOUT)
    return values


def test_all_figures_are_listed_with_intervals_or_the_reason_why_there_is_none():
    values = listed(LENGTH, SPHERE, LENGTH).values
    assert [each.name for each in values] == ["length 1", "sphere 1", "sphere 1", "length 2"]
    assert [each.quantity for each in values] == ["distance", "diameter", "standard deviation", "distance"]
    assert len({each.number for each in values}) == 4
    assert values[0].expanded_mm == pytest.approx(0.010) and values[0].without_interval == ""
    assert values[1].expanded_mm is None and values[1].without_interval == WITHOUT
    assert values[0].interval_text() == "distance 5.000 ± 0.010 mm"
    assert values[1].interval_text() == f"diameter 40.00000 mm ({WITHOUT})"


def test_verdicts_are_those_of_all_values_in_the_interval():
    """The interval is 4.99 to 5.01 mm: judged by values in it, one by one."""
    inside = np.linspace(4.99, 5.01, 201)
    limits = [None, 4.0, 4.985, 4.995, 5.005, 5.015, 6.0]
    seen = set()
    for lower, upper in product(limits, limits):
        if lower is not None and upper is not None and lower > upper:
            continue
        verdict = listed(LENGTH).limit(1, lower, upper).values[0].verdict
        fit = (inside >= (lower or -np.inf)) & (inside <= (upper or np.inf))
        if lower is None and upper is None:
            wanted = "no limit"
        else:
            wanted = "within the limit" if fit.all() else "undecided" if fit.any() else "exceeds the limit"
        assert verdict == wanted, (lower, upper)
        seen.add(verdict)
    assert len(seen) == 4


def test_a_limit_without_uncertainty_is_undecided():
    assert listed(SPHERE).values[0].verdict == "no limit"
    assert listed(SPHERE).limit(1, 30.0, 50.0).values[0].verdict == "undecided"


def test_each_change_is_undone_and_wrong_ones_change_nothing():
    first = listed(LENGTH, SPHERE)
    changes = [
        lambda values: values.rename(1, "width of the groove"),
        lambda values: values.limit(2, 39.0, None),
        lambda values: values.remove(3),
        lambda values: values.add(LENGTH, source="other", without_interval=""),
    ]
    values = first
    for change in changes:
        changed = change(values)
        assert changed.values != values.values and changed.undo().values == values.values
        values = changed
    for _ in changes:
        values = values.undo()
    assert values.values == first.values
    # The same name again is no change.
    assert first.rename(1, "length 1") is first
    wrong = [
        (lambda: first.rename(1, "  "), "at least 1 character"),
        (lambda: first.limit(1, 2.0, 1.0), "the lower limit 2 mm is above the upper one, 1 mm"),
        (lambda: first.remove(9), "value 9 was removed"),
        (lambda: MeasuredValues().undo(), "no change of the list to undo"),
    ]
    for act, words in wrong:
        with pytest.raises(DescriptionError, match=words):
            act()


def test_page_list_and_table_have_the_same_values(tmp_path):
    values = listed(LENGTH, SPHERE).rename(1, "groove <b>, 1").limit(1, 4.9, 5.1)
    page, record, table = write_measured(tmp_path / "a.measured.html", values, title="A")
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([page.name, record.name, table.name])
    assert read_measured(record).values == values.values
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["value_mm"]) for row in rows] == [each.value_mm for each in values.values]
    assert [row["expanded_mm"] for row in rows] == ["0.01", "", ""]
    assert [row["verdict"] for row in rows] == ["within the limit", "no limit", "no limit"]
    text = page.read_text(encoding="utf-8")
    assert "groove &lt;b&gt;, 1" in text and "<td>within the limit</td>" in text and text.count(WITHOUT) == 2
    # Nothing is replaced without being asked, and an edited list is marked.
    with pytest.raises(OutputError, match="exists"):
        write_measured(tmp_path / "a.measured.html", values, title="A")
    record.write_text(
        record.read_text(encoding="utf-8").replace('"value_mm": 5.0', '"value_mm": 4.0'), encoding="utf-8"
    )
    assert not values.edited and read_measured(record).edited
    with pytest.raises(DescriptionError, match="is empty"):
        write_measured(tmp_path / "b.measured.html", MeasuredValues(), title="B")


def test_a_findings_report_shows_the_list(tmp_path):
    weld_cloud().save(tmp_path / "plate.ply")
    write_measured(tmp_path / "plate.measured.html", listed(LENGTH).limit(1, None, 4.0), title="A")
    write_findings(
        tmp_path / "plate.ply", "weld", out=tmp_path / "plate.html", measured=tmp_path / "plate.measured.json"
    )
    text = (tmp_path / "plate.html").read_text(encoding="utf-8")
    assert "Values measured by hand" in text and "<td>exceeds the limit</td>" in text
    record = json.loads((tmp_path / "plate.findings.json").read_text(encoding="utf-8"))
    assert [each["verdict"] for each in record["measured"]] == ["exceeds the limit"]
    assert [each["name"] for each in record["sources"]] == ["plate.ply", "plate.measured.json"]
