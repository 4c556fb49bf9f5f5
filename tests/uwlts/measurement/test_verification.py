"""Verdicts on calibrated quantities against ISO/IEC 17043 and ISO 14253-1, worked out by hand."""

import numpy as np
import pytest

from uwlts.measurement.verification import Verdict, Verification
from uwlts.metrology.evaluation import Figure, FigureKey, FigureUncertainty, Quantity


def verdict(measured_mm: float, **changes: float | None) -> Verdict:
    known = {"calibrated_expanded_mm": 0.003, "measured_expanded_mm": 0.004, "limit_mm": None} | changes
    return Verdict(quantity="step height", calibrated_mm=10.0, measured_mm=measured_mm, **known)


def test_the_coverage_factor_of_expanded_uncertainties_is_2():
    # Random and systematic parts add in squares: 2 sqrt(3^2 + 4^2) = 10.
    uncertainty = FigureUncertainty(random_mm=3.0, systematic_mm=4.0)
    assert uncertainty.expanded_mm == pytest.approx(10.0, rel=1e-12)
    figure = Figure(FigureKey(Quantity.STD, "STD"), 0.5, uncertainty)
    assert figure.expanded_uncertainty_mm == pytest.approx(10.0, rel=1e-12)


def test_an_expanded_uncertainty_holds_about_95_percent_of_normal_errors():
    inside = np.abs(np.random.default_rng(1).standard_normal(100_000)) <= FigureUncertainty(0.6, 0.8).expanded_mm
    # 95.45 % for k = 2 (GUM, table G.1); 99.7 % for k = 3. Four standard deviations of 100,000 draws are 0.26 %.
    assert inside.mean() == pytest.approx(0.9545, abs=0.0027)


def test_both_uncertainties_judge_the_error():
    # E_n = |error| / sqrt(U_measured^2 + U_calibrated^2), here over 5 um (ISO/IEC 17043:2010, B.3.1.3 e).
    judged = verdict(10.004)
    assert judged.error_mm == pytest.approx(0.004) and judged.expanded_mm == pytest.approx(0.005)
    assert judged.normalised_error == pytest.approx(0.8) and judged.passed
    assert verdict(9.9951).passed and not verdict(9.9949).passed
    assert verdict(10.0049).passed and not verdict(10.0051).passed
    assert "error +0.0040 ± 0.0050 mm, E_n 0.80: pass" in judged.text and verdict(10.0051).text.endswith("FAIL")


def test_a_certificate_without_uncertainty_leaves_the_measurements_own():
    assert verdict(10.0039, calibrated_expanded_mm=None).passed
    assert not verdict(10.0041, calibrated_expanded_mm=None).passed


def test_a_limit_is_kept_only_beyond_doubt():
    # ISO 14253-1: the error with its expanded uncertainty, 4 + 5 um, lies within the limit.
    assert verdict(10.004, limit_mm=0.0091).passed
    assert not verdict(10.004, limit_mm=0.0089).passed
    assert not verdict(9.996, limit_mm=0.0089).passed
    # An error within the limit does not pass if it is not within the uncertainties.
    assert not verdict(10.006, limit_mm=0.1).passed


def test_without_an_uncertainty_of_the_measurement_the_limit_alone_judges():
    judged = verdict(10.02, measured_expanded_mm=None, calibrated_expanded_mm=None, limit_mm=0.021)
    assert judged.normalised_error is None and judged.passed and "E_n" not in judged.text
    assert not verdict(10.022, measured_expanded_mm=None, calibrated_expanded_mm=None, limit_mm=0.021).passed


def test_one_failed_verdict_fails_the_verification():
    good, bad = verdict(10.0), verdict(10.1)
    assert Verification((good, good)).passed and not Verification((good, bad)).passed
    assert Verification((good, bad)).text.splitlines() == [good.text, bad.text]
