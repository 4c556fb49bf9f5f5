"""A small version of the thesis's reproduction; its limits reveal an additional error of 0.02 mm.

Uses the as-built sensor, full physics and the whole chain of calibrations, but no random imperfections. Errors are due
to speckle, noise and the methods only. Images depend on the seeds only, so limits are close to the measured values.
Tests with injected errors show that a change of 0.02 mm does not pass.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import uwlts
from twin.experiments.experiment import run_experiment
from twin.experiments.reproduce import METHODS, THESIS_METHODS
from twin.recording.campaigns import RecordingOptions
from twin.scene.campaign import Campaign, load_campaign
from uwlts.model.stripe import CaptureStripes
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.figure_table import FigureTable
from uwlts.stripe import find_stripes

pytestmark = pytest.mark.slow

SENSORS = {"sensor": "thesis", "as_built": "thesis-as-built"}
SPHERES, PLANE = "spheres-standoff-water", "plane-standoff-water"
GATES_MM = {
    (SPHERES, "two refractions", "SSE"): (-0.0001, 0.0199),
    (SPHERES, "two refractions", "STD"): (0.015, 0.025),
    (SPHERES, "one refraction", "SSE"): (-0.0086, 0.0314),
    (SPHERES, "polynomials", "SSE"): (-0.02, 0.02),
    (SPHERES, "single viewpoint", "SSE"): (-0.02, 0.02),
    (SPHERES, "one refraction, low pass", "STD"): (0.08, 0.10),
    # Speckle limits the scatter of a plane: 0.025 mm at the stand-off, at contrast 0.71.
    (PLANE, "two refractions", "STD"): (0.020, 0.029),
    (PLANE, "two refractions", "RE, 99.7 %"): (0.10, 0.18),
}
"""Smallest and largest allowed value of a figure, with sign, around the value measured with this seed.

Nine poses leave a spacing error by refractions of +0.008 to +0.047 mm in eleven other draws of the noise.
"""
POSES = {"direction": (0.0, 0.0, 1.0), "lights": ("lamp", "laser"), "count": 9}
RECORDINGS = (
    {"name": "target-air", "scene": "target-through-window", "motion": POSES | {"start_mm": -180.0, "step_mm": 32.0}},
    {"name": "target-bare", "scene": "target", "motion": POSES | {"start_mm": -180.0, "step_mm": 32.0}},
    {
        "name": "target-water",
        "scene": "target-through-window",
        "media": ["water"],
        "motion": POSES | {"start_mm": -124.0, "step_mm": 23.0},
    },
    {"scene": "step", "placements": ["near", "standoff", "far"]},
    {"scene": "spheres", "media": ["water"], "placements": ["standoff", "far"]},
    {"scene": "plane", "media": ["water"], "placements": ["standoff"]},
)
EVERY = 6
"""Every sixth profile of the thesis's: 7 of the spheres, 25 of the plane."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("thesis")


@pytest.fixture(scope="module")
def edition(folder: Path) -> FigureTable:
    """Figures of the small campaign."""
    described = load_campaign("thesis").model_dump(include={"title"}) | SENSORS | {"recordings": RECORDINGS}
    wanted = {method for _, method, _ in GATES_MM}
    how = {"name": "small", "methods": [each for each in THESIS_METHODS if each.name in wanted]}
    return run_experiment(Campaign.model_validate(described), folder, range(1), RecordingOptions(EVERY), **how).table


def violated(figures: dict[tuple[str, str, str], float]) -> set[tuple[str, str, str]]:
    """Gates that figures do not keep."""
    for gate, (low, high) in GATES_MM.items():
        print(*gate, f"{low:+.4f} <= {figures[gate]:+.4f} <= {high:+.4f}")
    return {gate for gate, (low, high) in GATES_MM.items() if not low <= figures[gate] <= high}


def figures_of(table: FigureTable) -> dict[tuple[str, str, str], float]:
    return {
        (row.scan, row.method, row.figure): row.measured_mm if row.error_mm is None else row.error_mm
        for row in table.rows
    }


def test_the_small_edition_keeps_its_gates(edition: FigureTable):
    assert not violated(figures_of(edition))


def test_the_calibrations_find_the_window(edition: FigureTable):
    found = figures_of(edition)
    # Two refractions know the glass; single step images scatter by speckle.
    assert found["calibration-two-refractions", "two refractions", "window distance"] == pytest.approx(47.3, abs=1.0)
    distances = [value for (scan, _, figure), value in found.items() if figure == "window distance" and "step" in scan]
    assert len(distances) == 13
    assert np.ptp(distances) < 6.0
    assert found["calibration-polynomials-water", "polynomials", "residual of Z"] < 0.06
    assert found["budget of the sphere spacing", "one refraction", "PE"] > 0.05


def remeasured(edition: FigureTable, folder: Path, *, scale: float = 1.0, noise_px: float = 0.0) -> set[str]:
    """Figures outside their gates with another focal length or more noise, of the spheres by two refractions."""
    place = folder / "campaign-0"
    calibration = uwlts.read(place / "calibration-two-refractions.json")
    assert isinstance(calibration, uwlts.Calibration)
    focal = {name: scale * getattr(calibration.camera, name) for name in ("fx_px", "fy_px")}
    wrong = calibration.model_copy(update={"camera": calibration.camera.model_copy(update=focal)})
    with uwlts.Capture(place / f"{SPHERES}.h5") as capture:
        stripes: CaptureStripes = find_stripes(capture)
        noise = np.random.default_rng(0).normal(0, noise_px, len(stripes.centre_px))
        moved = replace(stripes, centre_px=stripes.centre_px + noise)
        found = uwlts.evaluate(reconstruct_stripes(capture, moved, wrong))
    changed = {(SPHERES, "two refractions", figure.key.name): figure.value_mm for figure in found.figures}
    return {figure for scan, _, figure in violated(figures_of(edition) | changed) if scan == SPHERES}


def test_a_spacing_lost_by_two_hundredths_is_noticed(edition: FigureTable, folder: Path):
    """A focal length wrong by 2e-4 of itself makes 99 mm wrong by 0.02 mm."""
    assert not remeasured(edition, folder)
    for sign in (-1, 1):
        assert "SSE" in remeasured(edition, folder, scale=1 + sign * 0.02 / 99.18), sign


def test_noise_of_two_hundredths_is_noticed(edition: FigureTable, folder: Path):
    """0.02 mm along the laser's axis are 0.09 px at the stand-off."""
    assert "STD" in remeasured(edition, folder, noise_px=0.09)


@pytest.fixture(scope="module")
def imperfect(tmp_path_factory: pytest.TempPathFactory) -> FigureTable:
    """Figures of a small campaign with the random imperfections of seed 1, among them water of another temperature."""
    described = load_campaign("thesis").model_dump(include={"title", "imperfections"}) | SENSORS
    places = ["near", "near-2", "standoff", "standoff-2", "far", "far-2"]
    scans = {"scene": "spheres", "media": ["water"], "placements": places}
    campaign = Campaign.model_validate(described | {"recordings": [*RECORDINGS[:4], scans]})
    how = {"name": "imperfect", "methods": METHODS}
    out = tmp_path_factory.mktemp("imperfect")
    return run_experiment(campaign, out, range(1, 2), RecordingOptions(EVERY), **how).table


def root_mean_square(values) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


JOINT = "joint, with scans too"


def test_the_joint_calibration_measures_closer_than_the_thesis_s_ways(imperfect: FigureTable):
    """Imperfections follow from the seed alone; only the images' noise depends on the processor that draws it.

    Root mean square errors on a processor with AVX2, for all nine figures (three spacings, six diameters) of scans that
    no calibration has used: 0.010 mm jointly with other scans, 0.024 mm with the target in water, 0.074 mm with one
    refraction and 0.082 mm with two. The stated uncertainty is 0.020 mm, as the water could have drifted between scans.
    """
    ways = (JOINT, "joint, with the target in water", "one refraction", "two refractions")
    pooled = [each for each in imperfect.pooled_errors() if each.name in ("SSE", "diameter error")]
    assert {each.scan for each in pooled} == {"spheres"}
    errors = {way: np.concatenate([each.errors_mm for each in pooled if each.method == way]) for way in ways}
    stated = np.concatenate([each.expanded_mm for each in pooled if each.method == JOINT]) / 2
    assert len(stated) == 9
    assert {row.scan for row in imperfect.select(method=JOINT, figure="SSE").rows} == {
        f"spheres-{place}-2-water" for place in ("near", "standoff", "far")
    }
    print({way: root_mean_square(e) for way, e in errors.items()}, errors[JOINT] / stated, root_mean_square(stated))

    # Errors against their stated standard uncertainties. All figures share the calibration; their correlation is not
    # known. Whatever it is, a sum of squared normal variables with a mean of 1 exceeds any x > 1.54 at most as often as
    # a single one does (Szekely and Bakirov 2003, Probab. Theory Relat. Fields 126:184): 6.3e-5 beyond 4 sigma.
    assert np.mean((errors[JOINT] / stated) ** 2) < 4.0**2

    # The stated uncertainty depends little on the drawn noise: its level follows from some ten thousand stripe centres
    # and circles, to a few percent, and from descriptions. 30 % are far beyond a probability of 1e-4. It may neither
    # shrink to half or a third (overconfident) nor grow (an advantage lost); the simulated campaigns of
    # tests/uwlts/calibration/joint/test_coverage.py show that it is correct.
    assert 0.0204 / 1.3 < root_mean_square(stated) < 0.0204 * 1.3

    # Factors of 7.7 and 8.7 are expected, and 3 is required: a joint estimate whose errors are 2.6 times larger fails.
    # Standard deviations: 0.007 mm of a diameter by noise of its scan, independent between scans, and about 0.005 mm of
    # all spacings together by noise of the calibration. To reach 0.025 mm, all spacings would have to move by 0.028 mm,
    # over five standard deviations (1e-7), or each of six diameters by 0.015 mm, over two standard deviations (1e-9).
    for way in ("one refraction", "two refractions"):
        assert root_mean_square(errors[JOINT]) < root_mean_square(errors[way]) / 3, way

    stating = {row.method for row in imperfect.rows if row.expanded_mm is not None}
    assert stating == {"joint, same evidence", "joint, with the target in water", JOINT}
