"""Descriptions of the files in a folder."""

import pytest

from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal
from uwlts.report.inventory import calibration_lines


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("air", "for use in air only"),
        ("fresh", "for use in fresh water only, as seen from a single viewpoint"),
        ("sea", "for use in sea water only, as seen from a single viewpoint"),
        ("custom", "for use in the medium of its images only, as seen from a single viewpoint"),
    ],
)
def test_a_calibration_without_a_window_is_for_the_medium_of_its_images(thesis: Sensor, kind: str, said: str):
    known = nominal(thesis, medium="water").model_copy(update={"window": None, "medium_kind": kind})
    assert f"window: none; {said}" in calibration_lines(known)
