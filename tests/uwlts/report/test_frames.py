"""Results as tables of pandas, with values from results made by hand."""

import sys
from pathlib import Path

import numpy as np
import pytest

import uwlts
from twin.design.study import load_study
from twin.design.sweep import SweepResult
from uwlts.comparison.change import ChangedRegion
from uwlts.errors import ArgumentError, SetupError
from uwlts.evaluation.evaluate import Evaluation
from uwlts.evaluation.figures import FigureUncertainty
from uwlts.inspection.features import Feature, FeatureKind, Inspection, plain_value
from uwlts.model.joint_estimate import JointEstimate, NominalSheet
from uwlts.model.parameter_keys import LensParameter, WindowParameter
from uwlts.reconstruction.verify import Verdict
from uwlts.storage.cloud import PointCloud, PointUncertainty


def cloud_of(count: int, **columns) -> PointCloud:
    points = np.arange(3.0 * count).reshape(count, 3)
    return PointCloud(points, np.ones(count), np.full(count, -1), np.arange(count), **columns)


def evaluation_of(figures_mm: dict[str, float], **uncertainty: FigureUncertainty) -> Evaluation:
    counts = dict.fromkeys(("points_total", "points_used", "points_rejected"), 2)
    figures = {"kind": "step", "figures_mm": figures_mm, "within_vdi_outliers": True, **counts}
    step = {"kind": "step", "height_mm": 23.17, "height_uncertainty_mm": 0.002}
    content = {"cloud": "step", "artefact": step, "evaluation": figures, "uncertainty": uncertainty}
    return Evaluation.model_validate(content)


def test_figures_of_an_evaluation():
    figures_mm = {"height error": -0.03, "STD": 0.02}
    frame = uwlts.report.to_frame(evaluation_of(figures_mm, **{"height error": FigureUncertainty(0.003, 0.004)}))
    assert list(frame["quantity"]) == ["height error", "STD"] and list(frame["name"]) == ["height error", "STD"]
    np.testing.assert_allclose(frame["value_mm"], [-0.03, 0.02])
    np.testing.assert_allclose(frame["measured_mm"], [23.14, 0.02])
    np.testing.assert_allclose(frame["error_mm"], [-0.03, np.nan])
    np.testing.assert_allclose(frame["calibrated_uncertainty_mm"], [0.002, np.nan])
    # Twice the root of the sum of squares of 3 and 4 um.
    np.testing.assert_allclose(frame["expanded_uncertainty_mm"], [0.010, np.nan])
    np.testing.assert_allclose(frame["uncertainty_systematic_mm"], [0.004, np.nan])


def test_columns_do_not_depend_on_what_is_known():
    known, unknown = (
        uwlts.report.to_frame(evaluation_of({"STD": 0.02}, **each))
        for each in ({"STD": FigureUncertainty(0.1, 0.2)}, {})
    )
    assert list(known.columns) == list(unknown.columns)
    assert unknown["uncertainty_random_mm"].dtype == np.float64


def test_values_of_an_inspection():
    place, values = np.array([1.0, 2.0, 3.0]), [plain_value(FeatureKind.PIT, "depth", 0.5, 0.03, 0.04)]
    values.append(plain_value(FeatureKind.PIT, "remaining wall", 9.5, 0.1, None))
    pit = Feature(FeatureKind.PIT, "pit 1", tuple(values), place, np.eye(3), np.ones(3), np.zeros(9, int), 1e-6)
    pipe = [plain_value(FeatureKind.PIPE, "diameter", 200.0, 0.01, None)]
    whole = Feature(FeatureKind.PIPE, "pipe", tuple(pipe), place, np.eye(3), np.ones(3), np.zeros(0, int))
    frame = uwlts.report.to_frame(Inspection("pipe", (whole, pit), np.zeros(9)))
    assert list(frame["feature_name"]) == ["pipe", "pit 1", "pit 1"] and list(frame["unit"]) == ["mm"] * 3
    assert list(frame["name"]) == ["diameter", "depth", "remaining wall"]
    np.testing.assert_allclose(frame["uncertainty"], [0.01, 0.05, 0.1])
    np.testing.assert_allclose(frame["systematic"], [np.nan, 0.04, np.nan])
    np.testing.assert_allclose(frame["feature_place_z_mm"], 3.0)
    np.testing.assert_allclose(frame["feature_false_alarm"], [np.nan, 1e-6, 1e-6])
    depths = frame[(frame.feature_kind == "pit") & (frame.name == "depth")]
    np.testing.assert_allclose(depths[["low", "high"]], [[0.5 - 1.96 * 0.05, 0.5 + 1.96 * 0.05]])


def test_parameters_of_a_calibration():
    nominal = uwlts.nominal("thesis", medium="water")
    lens = nominal.camera.distortion.model_copy(update={"k1": 0.01})
    camera = nominal.camera.model_copy(update={"distortion": lens})
    stated = {
        "camera": {"std": {"f": 0.8, "cx": 0.3, "k1": 0.001}},
        "sheet": {"normal_std_deg": 0.03},
        "window": {"std_mm": 0.4},
    }
    frame = uwlts.report.to_frame(nominal.model_copy(update={"residuals": stated, "camera": camera})).set_index("name")
    assert frame.loc["f", "value"] == nominal.camera.fx_px
    assert frame.loc["window_distance", "value"] == nominal.window.distance_mm
    np.testing.assert_allclose(frame.loc[["f", "cx", "cy", "sheet_normal"], "std"], [0.8, 0.3, np.nan, 0.03])
    np.testing.assert_allclose(frame.loc[["k1", "window_distance"], "std"], [0.001, 0.4])
    assert list(frame.loc[["f", "k1", "window_distance", "sheet_normal"], "unit"]) == ["px", "", "mm", "°"]


def test_parameters_of_a_joint_calibration_are_in_the_units_of_the_pages():
    zero = (0.0, 0.0, 0.0)
    joint = JointEstimate(
        parameters=(LensParameter.F, WindowParameter.SLOPE_X),
        values=(2400.0, np.radians(0.5)),
        std=(2.0, np.radians(0.1)),
        std_before=(None, np.radians(1.0)),
        covariance=((4.0, 0.0), (0.0, np.radians(0.1) ** 2)),
        nominal_sheet=NominalSheet(normal=zero, axis=zero, middle_mm=zero, apex_mm=zero, pivot_mm=zero),
        scatter_px={},
        residual_count=0,
        outlier_count=0,
    )
    frame = uwlts.report.to_frame(uwlts.nominal("thesis", medium="water").model_copy(update={"joint": joint}))
    assert list(frame["name"]) == ["f", "window_slope_x"] and list(frame["unit"]) == ["px", "°"]
    np.testing.assert_allclose(frame[["value", "std", "std_before"]], [[2400, 2, np.nan], [0.5, 0.1, 1.0]])


def test_points_of_a_cloud():
    variances = np.tile([1.0, 0, 0, 4.0, 0, 9.0], (2, 1))
    known = PointUncertainty(variances, np.zeros((2, 3)), np.zeros((0, 2, 3)))
    frame = uwlts.report.to_frame(cloud_of(2, uncertainty=known, time_s=np.array([0.5, 0.6])))
    assert list(frame.columns) == [
        *("x_mm", "y_mm", "z_mm", "intensity", "line", "time_s"),
        *("std_x_mm", "std_y_mm", "std_z_mm"),
    ]
    np.testing.assert_array_equal(frame[["x_mm", "y_mm", "z_mm"]], [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_allclose(frame[["std_x_mm", "std_y_mm", "std_z_mm"]], [[1, 2, 3]] * 2)
    assert "common_std_mm" in uwlts.report.to_frame(cloud_of(2, common_std_mm=np.ones(2)))


def test_designs_of_a_sweep_and_lists_of_records(tmp_path: Path):
    columns = {"design": np.arange(3), "baseline_mm": np.array([100.0, 200, 300]), "violation": np.zeros(3)}
    sweep = SweepResult(load_study("baseline-angle"), tmp_path, columns, (), (), ())
    assert uwlts.report.to_frame(sweep).equals(uwlts.report.to_frame(columns))
    assert list(uwlts.report.to_frame(sweep)["baseline_mm"]) == [100, 200, 300]
    rows = uwlts.design("thesis", medium="water")
    frame = uwlts.report.to_frame(rows)
    assert list(frame["name"]) == [row.name for row in rows] and list(frame["value"]) == [row.value for row in rows]
    region = ChangedRegion((1.0, 2.0, 3.0), 7, 5.0, -0.1, -0.2, 0.05, -0.5, 4.0)
    assert uwlts.report.to_frame([region]).loc[0, ["centre_x_mm", "centre_z_mm", "places"]].tolist() == [1, 3, 7]
    verdict = Verdict(
        quantity="step height",
        calibrated_mm=23.17,
        measured_mm=23.19,
        calibrated_expanded_mm=0.003,
        measured_expanded_mm=0.004,
        limit_mm=None,
    )
    # Error 0.02 mm, expanded uncertainty 0.005 mm.
    (found,) = uwlts.report.to_frame([verdict])["normalised_error"]
    assert found == pytest.approx(4.0)


@pytest.mark.parametrize("result", [[1, 2], "text", None])
def test_other_things_have_no_table(result: object):
    with pytest.raises(ArgumentError, match=f"`result` is of the type {type(result).__name__}, which has no table"):
        uwlts.report.to_frame(result)


def test_the_advice_without_pandas_installs_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(SetupError, match="needs the library pandas, which is not installed: .* -m pip install 'pandas"):
        uwlts.report.to_frame(cloud_of(1))
