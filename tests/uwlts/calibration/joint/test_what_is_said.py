"""Texts for synthetic estimates: conditions of warnings and contradictions, their figures and advice."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import target_series
from uwlts.calibration.camera.camera_parameters import CameraOptions, Intrinsics
from uwlts.calibration.joint.diagnose import Findings, PriorDeviations, check_consistency, deviations, format_deviation
from uwlts.calibration.joint.estimate import UNSETTLED, Estimate, Noise
from uwlts.calibration.joint.initial import estimate_series_start
from uwlts.calibration.joint.parameters import DescribedSheet, EarlierEstimate, Parameters, Prior, ViewMedium
from uwlts.calibration.joint.residuals import STRIPE, TARGET, Residuals
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.model.parameter_keys import SheetParameter, StageParameter, StepHeight, WindowParameter
from uwlts.model.placement import laser_pose
from uwlts.model.sensor import Uncertainty
from uwlts.optics.nominal import nominal_calibration

SENSOR = built_sensor().model_copy(update={"uncertainty": Uncertainty()})
NOMINAL = nominal_calibration(SENSOR)
INTRINSICS = Intrinsics(CameraOptions(), width_px=1280, height_px=1024)
LENS = INTRINSICS.from_model(NOMINAL.camera)
VIEW = ViewMedium(True, 0)


def estimate_of(known=None, *, images=(), noise=None, lens=LENS, earlier=None, **fields):
    """An estimate with its evidence: ``known`` parameters as (mean, standard uncertainty) before and after.

    Parameters of the lens are known to a thousandth; ``images`` are kind, source and residuals of each.
    """
    known, pose = known or {}, laser_pose(SENSOR)
    sheet = DescribedSheet(pose.normal, pose.axis, np.zeros(3), pose.origin_mm, pose.origin_mm)
    priors = {key: Prior(*before) for key, (before, _) in known.items()}
    parameters = Parameters(INTRINSICS, sheet, NOMINAL.window, (), priors, earlier)
    after = np.array([values for _, values in known.values()]).reshape(-1, 2)
    std = np.append(1e-3 * np.maximum(np.abs(lens), 1e-3), after[:, 1])
    parts = [
        Residuals(kind, values, np.empty((len(values), 0)), np.empty((len(values), 0)), np.arange(0), number)
        for number, (kind, _, values) in enumerate(images)
    ]
    seen = SimpleNamespace(view=VIEW, sources={number: source for number, (_, source, _) in enumerate(images)})
    given = {"local": [np.empty(0)], "residuals": [parts], "stopped": "cost settled"} | fields
    result = Estimate(
        parameters=parameters,
        values=np.append(lens, after[:, 0]),
        covariance=np.diag(std**2),
        local_covariances=[],
        noise=noise or {},
        outliers=0,
        rounds=1,
        **given,
    )
    return result, [seen]


def found_of(*args, **kwargs):
    return check_consistency(*estimate_of(*args, **kwargs), sensor=SENSOR)


def white(sigma_px, seed, count=600):
    """Independent residuals; the median of 600 gives their scatter to 5 %."""
    return np.random.default_rng(seed).normal(0, sigma_px, count)


def images_of(kind, scatter_px, *, others=9, usual_px=0.1):
    """One image with a given scatter among nine others."""
    return [(kind, "odd", white(scatter_px, 0)), *((kind, f"usual {n}", white(usual_px, 1 + n)) for n in range(others))]


@pytest.mark.parametrize(("kind", "largest_px"), [(TARGET, 0.5), (STRIPE, 1.0)])
def test_noise_of_an_image_is_a_doubt_up_to_a_limit_of_its_kind(kind, largest_px):
    """Three times the others' 0.1 px are left in peace; beyond 0.5 or 1 px an image is wrong, however noisy."""
    assert found_of(images=images_of(kind, 0.26)) == Findings([], {}, {}, [])
    noisy = found_of(images=images_of(kind, 0.88 * largest_px))
    assert (noisy.unfit, len(noisy.doubts)) == ({}, 1)
    assert f"odd: the {kind} is 0." in noisy.doubts[0]
    assert noisy.doubts[0].endswith("px off (rms), in the other images 0.10 px")
    wrong = found_of(images=images_of(kind, 1.12 * largest_px))
    assert ([*wrong.unfit], wrong.doubts) == (["odd"], [])


def test_residuals_that_run_together_are_no_noise():
    """Waves of 0.35 px with 0.1 px of noise: below every limit of size, and yet not as the others."""
    waves = 0.5 * np.sin(np.arange(600) / 40) + white(0.1, 0)
    images = [(STRIPE, "odd", waves), *images_of(STRIPE, 0.1)]
    assert [*found_of(images=images).unfit] == ["odd"]
    alone = found_of(images=images[:1])
    assert alone.unfit["odd"].endswith("px off (rms), its noise being 0.10 px")


@pytest.mark.parametrize(("kind", "largest_px"), [(TARGET, 0.5), (STRIPE, 1.0)])
def test_a_kind_that_is_too_noisy_throughout_is_a_misfit(kind, largest_px):
    within, beyond = (images_of(kind, s, usual_px=s) for s in (0.9 * largest_px, 1.1 * largest_px))
    assert found_of(images=within) == Findings([], {}, {}, [])
    (words,) = found_of(images=beyond).misfits.values()
    scatter, noise = re.match(
        rf"the {kind} is (.*) px off \(rms\) in most images; noise explains (.*) px;", words
    ).groups()
    assert float(scatter) == pytest.approx(1.1 * largest_px, rel=0.05)
    assert float(noise) == pytest.approx(1.1 * largest_px, rel=0.05)


def test_four_of_many_are_named():
    images = [(TARGET, f"image {n}", white(0.45 if n < 6 else 0.1, n)) for n in range(20)]
    doubts = found_of(images=images).doubts
    assert len(doubts) == 5
    assert doubts[-1] == "and 2 more images"
    unfit = {f"image {n}": f"image {n} is off" for n in (3, 4, 5)}
    assert Findings(["a", "b"], unfit, {"k": "c", "l": "d", "m": "e"}, ["no"]).refusal() == (
        "the evidence contradicts itself: a; b; image 3 is off; image 4 is off; image 5 is off; c; and 2 more "
        "contradictions"
    )
    assert Findings([*"abcdef"], {}, {}, []).refusal() == "the evidence contradicts itself: a; b; c; d; e; f"


@pytest.mark.parametrize(("together", "wrong"), [(7.5, None), (8.5, False), (19.5, False), (20.5, True)])
def test_waves_are_doubtful_beyond_8_lines_and_wrong_beyond_20(together, wrong):
    found = found_of(images=[(STRIPE, "image", white(0.1, 0))], noise={STRIPE: Noise(0.123, together)})
    assert found.contradictions == []
    said = [*found.misfits.values()] if wrong else found.doubts
    assert len(said) == (0 if wrong is None else 1)
    for words in said:
        assert f"(0.12 px rms, equivalent to one independent value in {together:.0f} lines)" in words
        assert "along the stripe" in words


def test_many_outliers_and_a_scatter_that_does_not_settle_are_doubts():
    values = np.where(np.arange(600) < 150, 5.0, 0.05)
    images = [(STRIPE, f"image {n}", values) for n in range(3)]
    assert found_of(images=images, noise={STRIPE: Noise(0.1)}).doubts == [
        "25 % of the stripe on the target was left out as outliers: look at the images"
    ]
    fewer = [(kind, source, values[40:]) for kind, source, values in images]
    assert found_of(images=fewer, noise={STRIPE: Noise(0.1)}).doubts == []
    assert found_of(stopped=UNSETTLED).doubts == [f"{UNSETTLED}: some of the evidence contradicts the rest"]


@pytest.mark.parametrize(("sigmas", "wrong"), [(-3.5, None), (4.5, False), (-4.5, False), (6.5, True), (-6.5, True)])
def test_parameters_are_doubtful_beyond_4_and_wrong_beyond_6_standard_uncertainties(sigmas, wrong):
    known = {WindowParameter.DISTANCE: ((62.8, 5.0), (62.8 + 5.0 * sigmas, 0.05))}
    found = found_of(known)
    said, other = (found.contradictions, found.doubts) if wrong else (found.doubts, found.contradictions)
    assert (len(said), other) == (0 if wrong is None else 1, [])
    for words in said:
        assert words.startswith(f"window distance found {62.8 + 5 * sigmas:.1f}, described as 62.8 +- 5 mm")
        assert f"({abs(sigmas)} standard uncertainties off): check camera.window.distance_mm" in words


def test_what_the_evidence_says_alone_is_the_estimate_without_its_prior():
    """5 before and 4 after leave 3 that the evidence has removed: (10.8 / 0.36 = 30) alone, 10.8 / 3 = 3.6 sigma."""
    (each,) = deviations(estimate_of({WindowParameter.DISTANCE: ((60.0, 5.0), (70.8, 4.0))})[0], least=0.0)
    assert each.alone == pytest.approx(90.0)
    assert each.sigmas == pytest.approx(3.6)


@pytest.mark.parametrize(("count", "off", "factor"), [(6, 2.5, 2.5), (6, 1.5, 1.0), (5, 4.0, 1.0)])
def test_descriptions_that_are_all_too_sure_are_noticed(count, off, factor):
    """Six squares exceed 22.5 once in a thousand times: 13.5 do not, 37.5 do."""
    keys = [*WindowParameter, SheetParameter.BOW][:count]
    known = {key: ((0.0, 1.0), ((-1) ** n * off, 1e-3)) for n, key in enumerate(keys)}
    assert PriorDeviations(deviations(estimate_of(known)[0], least=0.0)).birge_ratio == pytest.approx(factor, rel=1e-3)


@pytest.mark.parametrize(("share", "wrong"), [(0.07, None), (0.09, False), (-0.09, False), (-0.21, True), (0.21, True)])
def test_a_focal_length_far_from_the_lens_is_told(share, wrong):
    found = found_of(lens=LENS * np.where(np.arange(len(LENS)) == 0, 1 + share, 1.0))
    said = found.contradictions if wrong else found.doubts
    assert len(said) == (0 if wrong is None else 1)
    assert all(f"the focal length is {LENS[0] * (1 + share):.1f} px; expected " in words for words in said)


@pytest.mark.parametrize(("off", "wrong"), [(3.9, None), (4.1, False), (-6.2, True)])
def test_new_evidence_against_an_earlier_estimate_is_told_by_what_moved_farthest(off, wrong):
    """By 0.8 of the standard uncertainty before, as 0.6 of it are left."""
    std = 1e-3 * np.maximum(np.abs(LENS), 1e-3) / 0.6
    earlier = EarlierEstimate(LENS - 0.8 * std * off * (np.arange(len(LENS)) == 1), np.diag(std**2))
    found = found_of(earlier=earlier)
    said = found.contradictions if wrong else found.doubts
    assert len(said) == (0 if wrong is None else 1)
    for words in said:
        assert f"by {abs(off):.1f} standard uncertainties, mostly in the column of the principal point: " in words


@pytest.fixture(scope="module")
def staged():
    """A target on the stage in six images, and the start of its local parameters."""
    series = target_series(SENSOR, window=False, positions=np.arange(6) * 40.0 - 180.0, columns=7)
    start = estimate_series_start(
        [series], SENSOR, None, [], options=CalibrationOptions(poses="stage", correct_circles=False)
    )
    return start.evidence[0], start.local[0]


@pytest.mark.parametrize(
    ("tilt_deg", "errors_mm", "said"),
    [
        (2.9, [0, 0, 0, 0, 0], None),
        (-3.1, [0, 0, 0, 0, 0], "target: the stage moves 3.1 deg off the target's normal; expected within 0.5 deg"),
        (0, [0, 0, 0.029, 0, 0], None),
        (0, [0, 0, -0.031, 0, 0], "target, frame 3: the stage was -0.031 mm from its stated position"),
        (0, [0.02, -0.02, 0.02, -0.02, 0.0], "target: the stage's positions scatter by 0.018 mm, stated uncertainty"),
        (0, [0.015, -0.015, 0.015, -0.015, 0.0], None),
    ],
)
def test_a_stage_that_does_not_move_as_described_is_told(staged, tilt_deg, errors_mm, said):
    """0.5 deg and 0.005 mm are stated: six of these are too much, three of the mean square of all positions.

    Also if other evidence, without a stage, comes first.
    """
    piece, local = staged
    local = np.concatenate([local[:6], [np.tan(np.radians(tilt_deg)), 0.0], errors_mm])
    result, other = estimate_of(local=[np.empty(0), local], residuals=[[], []])
    found = check_consistency(result, [*other, piece], sensor=SENSOR).contradictions
    assert len(found) == (0 if said is None else 1)
    assert all(words.startswith(said) for words in found)


def test_a_step_that_seems_too_high_may_not_face_the_laser():
    """cos(4.23 deg) = 23.17 / 23.2333."""
    high, low = (format_deviation(StepHeight(23.17), 23.17 + d, 23.17, 0.01, sigmas=6.3) for d in (0.0633, -0.0633))
    assert high.endswith(
        "which standard it is, and whether it faces the laser: a rotation by 4.2° about the stripe explains the height"
    )
    assert low.endswith("check which standard it is")


def test_a_stage_scale_is_told_in_mm_per_mm():
    said = format_deviation(StageParameter.SCALE, -0.0012, 0.0, 1e-4, sigmas=12.0)
    assert said.startswith("the stage moves 0.9988 mm per mm of its positions, stated 1 +- 0.0001 (12.0 standard")
