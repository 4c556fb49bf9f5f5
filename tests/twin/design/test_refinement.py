"""Derivatives of figures by the parameters of a design, compared with differences, and improved designs."""

import numpy as np
import pytest

from twin.design.choice import SMOOTH, DerivedFigures, refine_design
from twin.design.designs import Design, evaluate_designs
from twin.design.sensor_arrays import PARAMETER_OF
from twin.design.study import Study

VALUES = {
    "laser.baseline_mm": 265.0,
    "laser.triangulation_angle_deg": 35.0,
    "laser.roll_deg": 0.4,
    "laser.power_mw": 7.0,
    "laser.waist_radius_mm": 0.25,
    "laser.waist_distance_mm": 450.0,
    "laser.beam_quality_m2": 1.4,
    "laser.window.distance_mm": 30.0,
    "laser.window.thickness_mm": 6.0,
    "camera.focal_length_mm": 12.5,
    "camera.f_number": 4.0,
    "camera.focus_distance_mm": 320.0,
    "camera.window.distance_mm": 60.0,
    "camera.window.thickness_mm": 6.0,
    "camera.window.tilt_x_deg": 3.0,
    "camera.window.tilt_y_deg": -2.0,
    "volume.near_mm": 250.0,
    "volume.far_mm": 380.0,
}


def study_of(paths: dict[str, float], **rest: object) -> Study:
    ranges = {
        path: {"least": value - 0.3 * abs(value), "most": value + 0.3 * abs(value)} for path, value in paths.items()
    }
    return Study.model_validate({"title": "test", "variables": ranges, "sampling": {"kind": "sobol"}} | rest)


@pytest.mark.slow
def test_every_derivative_is_the_limit_of_differences():
    assert set(VALUES) == set(PARAMETER_OF)
    study, names = study_of(VALUES), list(SMOOTH)
    design = Design(0, VALUES)
    figures = DerivedFigures(study, design, names)
    start = np.array([VALUES[path] for path in figures.paths])
    found, gradient = figures.evaluate(start)
    direct = evaluate_designs(study, [design])
    for value, name in zip(found, names, strict=True):
        assert value == pytest.approx(direct[name].item(), rel=1e-9), name
    steps = 1e-5 * np.abs(start)
    changes = zip(figures.paths, start, steps, strict=True)
    ends = [Design(0, VALUES | {path: at + sign * step}) for path, at, step in changes for sign in (1, -1)]
    columns = evaluate_designs(study, ends)
    for row, name in zip(gradient, names, strict=True):
        differences = np.subtract(*columns[name].reshape(-1, 2).T) / (2 * steps)
        # Rounding leaves 1e-11 of the value over the step's length, 1e-6 of the derivative or less.
        size = np.abs(direct[name].item() / start)
        for k, path in enumerate(figures.paths):
            assert row[k] == pytest.approx(differences[k], rel=1e-5, abs=1e-6 * size[k]), (path, name)


def test_a_design_follows_the_gradient_to_the_best_of_its_range():
    study = study_of(
        {"laser.baseline_mm": 265.0, "laser.triangulation_angle_deg": 35.0},
        follow=["focus", "waist", "volume"],
        constraints={"line_mm": {"least": 160.0}},
    )
    start = Design(0, {"laser.baseline_mm": 280.0, "laser.triangulation_angle_deg": 33.0})
    before = evaluate_designs(study, [start])

    def better(design: Design) -> bool:
        found = evaluate_designs(study, [design])
        return bool(found["violation"][0] == 0 and found["sigma_z_rms_mm"][0] < before["sigma_z_rms_mm"][0])

    end = refine_design(study, start, better)
    assert end is not None
    after = evaluate_designs(study, [end])["sigma_z_rms_mm"].item()
    # A fine grid about the result contains no better design that meets all constraints and has the same view.
    around = [
        Design(0, {"laser.baseline_mm": b, "laser.triangulation_angle_deg": a})
        for b in np.linspace(185.5, 344.5, 41)
        for a in np.linspace(24.5, 45.5, 61)
    ]
    columns = evaluate_designs(study, around)
    allowed = (columns["violation"] == 0) & (columns["coverage"] >= before["coverage"][0])
    assert allowed.sum() > 50
    assert after < 0.995 * before["sigma_z_rms_mm"].item()
    assert after <= 1.002 * columns["sigma_z_rms_mm"][allowed].min()


def test_nothing_to_derive_is_no_refinement():
    study = Study.model_validate({"title": "t", "variables": {"laser.wavelength_nm": {"least": 500.0, "most": 650.0}}})
    assert refine_design(study, Design(0, {"laser.wavelength_nm": 600.0}), lambda design: True) is None


def test_a_refinement_that_is_not_accepted_is_none():
    study = study_of({"laser.power_mw": 7.0})
    assert refine_design(study, Design(0, {"laser.power_mw": 7.0}), lambda design: False) is None
