"""Comparison of two results, and their files."""

import math

import pytest

from uwlts.errors import CaptureError
from uwlts.radiometry.result import ImageEstimate, compare_estimates, format_value, read_estimates


def estimate(name: str, value: float, std: float) -> ImageEstimate:
    return ImageEstimate(name, value, std, "1/m", f"the {name}")


def test_changes_are_in_combined_standard_uncertainties():
    before = [estimate("attenuation", 1.0, 0.03), estimate("old", 1.0, 0.1)]
    after = [estimate("attenuation", 1.25, 0.04), estimate("new", 1.0, 0.1)]
    (change,) = compare_estimates(after, before)
    assert change.std == pytest.approx(0.05)
    assert change.significance == pytest.approx(5.0)
    assert change.line() == "the attenuation: 1 -> 1.25 1/m, +0.25 ± 0.05, +5.0 sigma (significant)"


def test_estimates_without_uncertainty_change_by_infinity_or_not():
    same, other = (compare_estimates([estimate("x", 1.0, 0.0)], [estimate("x", v, 0.0)])[0] for v in (1.0, 2.0))
    assert same.significance == 0.0
    assert other.significance == -math.inf


def test_values_have_the_digits_of_their_uncertainty():
    assert format_value(0.83214, 0.0143) == "0.832 ± 0.014"
    assert format_value(1234.5, 25.0) == "1234 ± 25"
    assert format_value(1.0, 0.0) == "1"


def test_wrong_files_are_refused(tmp_path):
    other = tmp_path / "other.json"
    other.write_text('{"format": "uwlts-calibration", "version": 1}', encoding="utf-8")
    with pytest.raises(CaptureError, match="not a result of uwlts radiometry"):
        read_estimates(other)
    with pytest.raises(CaptureError, match="give the result beside it, followed.json"):
        read_estimates(tmp_path / "followed.toml")
