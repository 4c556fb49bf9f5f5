"""The demonstration stops where its folder cannot be used. That it runs to its end is seen by everyone who runs it."""

from pathlib import Path

import pytest

from twin.experiments.reproduce import DEMO_METHODS, demo
from twin.scene.campaign import list_takes, load_campaign
from uwlts.errors import OutputError


def test_a_folder_that_cannot_be_used_ends_the_demo_before_rendering(tmp_path: Path):
    (tmp_path / "plan.json").mkdir()
    with pytest.raises(OutputError, match=r"plan\.json"):
        demo(tmp_path)
    assert [each.name for each in tmp_path.iterdir()] == ["plan.json"]


def test_the_campaign_records_what_the_calibrations_use():
    recorded = {take.name for take in list_takes(load_campaign("demo"), seed=0)}
    assert recorded >= {
        name for each in DEMO_METHODS for names in (each.scans, *each.evidence.values()) for name in names
    }
