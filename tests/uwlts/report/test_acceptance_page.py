"""Page of an acceptance test: its conclusion, what it shows, and its files."""

from typing import get_args

import pytest

import uwlts
from uwlts.acceptance.accept import Acceptance, Verdict
from uwlts.errors import OutputError
from uwlts.report.acceptance_page import acceptance_page

SPHERES = {"kind": "spheres", "diameters_mm": [25.0, 25.0], "spacings_mm": [60.0], "spacing_uncertainty_mm": 0.006}
POSITIONS = [{"name": name, "artefact": "bar", "file": f"{name}.ply"} for name in ("across", "along <1>")]


def acceptance(*, error=0.01, decision="conformity proven", left=0, **changes):
    """Two positions of a ball bar; `left` of them are missing."""
    plan = {"title": "Test of <A & B>", "volume_mm": [100.0, 120.0, 120.0], "mpe": {"SD_mm": 0.1}}
    plan |= {"artefacts": {"bar": {"standard": SPHERES, "certificate": "4711"}}, "positions": POSITIONS}
    plan |= {"decision_rule": "1.65 u"}
    judged = []
    for number, position in enumerate(POSITIONS):
        direction = [0.0, 1.0, 0.0] if number == 0 else [1.0, 0.0, 0.0]
        where = {"place_mm": [0.0, 0.0, 10.0 * number], "direction": direction, "length_mm": 60.0}
        value = {"symbol": "SD", "position": position["name"], "label": "spacing", "value_mm": error} | where
        there = {"state": "judged", "sha256": "ab" * 32, "values": [value | {"expanded_mm": 0.006}]}
        there |= {"points": 5000, "on_artefact": 4000, "rejected": 12}
        judged.append(position | (there if number < len(POSITIONS) - left else {"state": "missing"}))
    characteristic = {"symbol": "SD", "worst": judged[0].get("values", [None])[0], "count": 2 - left, "mpe_mm": 0.1}
    characteristic |= {"decision": decision, "reason": "not sure" if decision == "undecided" else ""}
    characteristic |= {"probability": 0.973}
    few = {"clause": "sphere spacing: positions", "required": "at least 7", "done": "2 of 2 planned", "met": False}
    content = {"plan": plan, "positions": judged, "remarks": ["step: no expansion"], "requirements": [few]}
    content |= {"characteristics": [characteristic], "calibration": None, "verdict": decision}
    content |= {"conclusion": f"{decision}: because of <SD>"}
    return Acceptance.model_validate(content | {"software": "uwlts 1", "date": "2026-01-02T03:04:05+00:00"} | changes)


@pytest.mark.parametrize("decision", get_args(Verdict))
def test_the_conclusion_is_first(decision):
    text = acceptance_page(acceptance(decision=decision))
    said = f"{decision.capitalize()}: because of &lt;SD&gt;."
    assert text.index(said) < text.index("Characteristics")
    colours = {"conformity proven": "good", "accepted": "good", "undecided": "open"}
    assert f'<div class="verdict {colours.get(decision, "bad")}">' in text


def test_everything_stated_is_shown_as_text():
    text = acceptance_page(acceptance(decision="undecided"))
    for shown in (
        *("Test of &lt;A &amp; B&gt;", "along &lt;1&gt;", "4711", "step: no expansion", "ab" * 32, "+0.0100"),
        *("undecided: not sure", "97.3 %", "1.65 u", "ISO 14253-1:2017", "4,000 of 5,000; 12"),
        *("sphere spacing: positions", "not met", "at least 7", "2 of 2 planned"),
    ):
        assert shown in text, shown
    assert "<1>" not in text
    assert text.count("<svg") == 3


def test_nothing_measured_is_a_page_too():
    text = acceptance_page(acceptance(left=2, characteristics=(), decision="undecided"))
    assert "Undecided" in text
    assert "<svg" not in text


def test_page_and_result_are_written_together(tmp_path):
    found = acceptance()
    uwlts.report.write_acceptance(tmp_path / "a.html", found)
    assert uwlts.read(tmp_path / "a.acceptance.json") == found
    with pytest.raises(OutputError, match="exists already"):
        uwlts.report.write_acceptance(tmp_path / "a.html", found)
