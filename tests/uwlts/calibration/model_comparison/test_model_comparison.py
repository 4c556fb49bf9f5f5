"""Choice of a model by held-out images, on views by Fermat's principle, with and without tilts and bow."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.uwlts.calibration_views import built_sensor
from tests.uwlts.joint_views import Noise, gathered, target_series
from uwlts.calibration.joint.procedure import joint_problem, solve_jointly
from uwlts.calibration.joint.residuals import STRIPE, TARGET
from uwlts.calibration.joint.stored_estimate import read_original_estimate
from uwlts.calibration.model_comparison.comparison import Comparison, build_choice, choose, compare_models, sum_errors
from uwlts.calibration.model_comparison.held_out import (
    INSIDE,
    OUTSIDE,
    Candidate,
    Misses,
    Prediction,
    apply_candidate,
    predict,
    split_images,
)
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.errors import CalibrationError, DescriptionError
from uwlts.files.json_files import SEAL, compute_seal, json_text
from uwlts.report.model_comparison import (
    ModelComparisonContent,
    compute_additional_error,
    format_lines,
    make_content,
    models_page,
    verdicts,
)

OPTIONS = CalibrationOptions(poses="stage", correct_circles=False)
AIR, IN_WATER = np.arange(8) * 35.0 - 200.0, np.arange(11) * 18.0 - 120.0


def sensor_with(*, window_tilt_deg: float, laser_tilt_deg: float):
    built = built_sensor()
    camera = built.camera.model_copy(
        update={"window": built.camera.window.model_copy(update={"tilt_x_deg": window_tilt_deg, "tilt_y_deg": 0.0})}
    )
    window = built.laser.window.model_copy(update={"tilt_y_deg": laser_tilt_deg})
    return built.model_copy(update={"camera": camera, "laser": built.laser.model_copy(update={"window": window})})


def problem_of(thesis, sensor, *, bow: float, seed: int):
    noise = Noise(circles_px=0.03, stripe_px=0.1, stage_mm=0.003, rng=np.random.default_rng(seed))
    series = [
        target_series(sensor, window=False, positions=AIR, bow=bow, noise=noise, columns=15),
        target_series(sensor, medium=0, positions=IN_WATER, bow=bow, noise=noise, columns=15),
    ]
    return joint_problem(gathered(thesis, series), options=OPTIONS)


@pytest.fixture(scope="module")
def plain(thesis):
    """Return the described sensor: a window square to the axis, a flat sheet, and a laser window square to it."""
    return problem_of(thesis, sensor_with(window_tilt_deg=0.0, laser_tilt_deg=0.0), bow=0.0, seed=0)


@pytest.fixture(scope="module")
def plain_choice(plain):
    return choose(plain, workers=1)


@pytest.fixture(scope="module")
def tilted_choice(thesis):
    problem = problem_of(thesis, sensor_with(window_tilt_deg=0.2, laser_tilt_deg=0.0), bow=0.0, seed=0)
    ways = split_images(problem)
    models = (Candidate(), Candidate(window_tilt=False), Candidate(bow=False))
    return build_choice(
        {model: {where: predict(problem, model, held) for where, held in ways.items()} for model in models},
        ways,
        frozenset({1}),
    )


@pytest.mark.slow
def test_where_nothing_is_tilted_or_bowed_the_simplest_model_is_chosen(plain_choice):
    simplest = plain_choice.simplest()
    assert not (simplest.window_tilt or simplest.bow or simplest.window_turn)
    assert simplest.distortion == ("k1", "k2")
    said = " ".join(verdicts(plain_choice))
    # Two images in water are held out: too few for a statement about windows.
    assert "whether the tilt of the window is needed is not shown" in said
    assert "the bow of the sheet is not needed" in said
    assert "the turn of the laser's window is not needed" in said
    assert "distortion k1 k2 is enough: with distortion k1" in said


@pytest.mark.slow
def test_a_tilted_window_is_found_to_be_needed(tilted_choice):
    """A tilt t shifts rays by t (n - 1) times the distance to the object: 0.2 deg and 400 mm give 0.46 mm.

    Poses and principal point absorb most of it. The remaining 2 to 6 µm depend on the noise; a dozen held-out images
    determine them to a quarter or a third.
    """
    assert tilted_choice.simplest().window_tilt
    assert Candidate(window_tilt=False) not in tilted_choice.list_equivalent()
    cost, std = compute_additional_error(tilted_choice, Candidate(window_tilt=False), Candidate(), OUTSIDE)
    assert 0.001 < cost < 0.01
    assert std < cost / 3
    assert any(line.startswith("the tilt of the window is needed: without it") for line in verdicts(tilted_choice))


@pytest.mark.slow
def test_images_held_out_are_predicted_to_their_noise(plain_choice):
    """Distance of points with 0.03 px in both directions, stripes with 0.1 px; 3 µm of the stage add a hundredth.

    The mean square of n values has the relative standard error sqrt(2 / n): below 3 % for the fewest, 1,000.
    """
    for where in (INSIDE, OUTSIDE):
        score = next(each for each in plain_choice.judged if each.candidate == plain_choice.simplest()).scores[where]
        assert score.px["points"] == pytest.approx(0.03 * np.sqrt(2), rel=0.15)
        assert score.px["stripes"] == pytest.approx(0.1, rel=0.15)
        assert score.std_mm < 0.3 * score.all_mm


def test_misses_on_the_object_are_those_in_the_image_times_its_distance(plain):
    """In air without a window a pixel at an angle a to the axis spans z / f, or that times cos a: up to 20 deg, 6 %."""
    held = frozenset({(0, 4)})
    (misses,) = [m for m in predict(plain, Candidate(), held).misses if m.kind == TARGET]
    piece, local = plain.evidence[0], plain.local[0]
    pose = piece.pose(plain.parameters, plain.global_values, local, 4)
    here = piece.placement.image == 4
    depth = (piece.placement.points_mm[here] @ pose[:3, :3].T + pose[:3, 3])[:, 2]
    share = misses.mm / (misses.px * depth / plain.global_values[0])
    assert len(share) > 50
    assert share.min() > 0.85 and share.max() < 1.05


def test_the_outermost_images_are_held_out_outside_and_never_inside(plain):
    ways = split_images(plain)
    assert list(ways) == [INSIDE, OUTSIDE]
    inside, outside = ways.values()
    for number, positions in enumerate((AIR, IN_WATER)):
        lit = np.unique(plain.evidence[number].image)
        assert len(lit) > 0.8 * len(positions)
        ends = {(number, int(lit[0])), (number, int(lit[-1]))}
        assert ends <= outside
        assert not ends & inside
    assert len(inside) >= 4


@pytest.mark.slow
@pytest.mark.parametrize("count", [12, 14])
def test_fourteen_images_at_even_depths_are_enough(thesis, count):
    series = target_series(built_sensor(), medium=0, positions=np.linspace(-80.0, 40.0, count), columns=5)
    few = replace(series, found=replace(series.found, stripes=[pixels[::20] for pixels in series.found.stripes]))
    problem = joint_problem(gathered(thesis, [few]), options=OPTIONS)
    images = {(0, int(image)) for image in np.unique(problem.evidence[0].image)}
    assert len(images) == count
    for held in split_images(problem).values():
        assert 4 <= len(held) <= len(images) - 4


def test_too_few_images_are_refused(thesis):
    with pytest.raises(DescriptionError, match="workers is 0"):
        compare_models(air=["none.h5"], workers=0)
    with pytest.raises(DescriptionError, match="no captures of a target"):
        compare_models(workers=1)
    series = target_series(built_sensor(), medium=0, positions=IN_WATER[::3], columns=15)
    with pytest.raises(CalibrationError, match="too few images with a stripe"):
        split_images(joint_problem(gathered(thesis, [series]), options=OPTIONS))


@pytest.mark.slow
def test_a_target_held_by_hand_is_predicted_from_its_own_points(thesis):
    """Nothing ties its poses, so each is fitted to the target's points; the stripe then shows the sheet's error."""
    tilts = np.array([(0, 0), (0.35, 0), (-0.35, 0), (0, 0.35), (0, -0.35), (0.25, 0.25), (-0.25, 0.25), (0.3, -0.2)])
    noise = Noise(circles_px=0.03, stripe_px=0.1, rng=np.random.default_rng(1))
    series = target_series(
        built_sensor(), medium=0, positions=np.linspace(-60, 60, 8), noise=noise, tilts=tilts, columns=15
    )
    problem = joint_problem(gathered(thesis, [series]), options=replace(OPTIONS, poses="free"))
    held = frozenset({(2, 2), (5, 5)})
    misses = predict(problem, Candidate(), held).misses
    assert {(m.image, m.kind) for m in misses} == {(image, kind) for image in held for kind in (TARGET, STRIPE)}
    stripes = np.concatenate([m.px for m in misses if m.kind == STRIPE])
    # 200 lines with 0.1 px each: 10 % is twice the standard error of their mean square; the model adds some hundredths.
    assert np.sqrt(np.mean(stripes**2)) == pytest.approx(0.1, rel=0.25)


def test_what_a_model_adds_is_distinguished_from_noise_and_outliers_do_not_count():
    """A miss common to all points of an image adds its square to the mean square, whatever the noise."""
    rng = np.random.default_rng(0)
    noise = [rng.normal(0, 0.1, 1000) for _ in range(12)]
    noise[3][7] = 50.0
    more = rng.choice([-0.05, 0.05], 12)

    def made(shift):
        misses = [
            Misses((0, n), STRIPE, np.abs(off + by), 0.2 * np.abs(off + by))
            for n, (off, by) in enumerate(zip(noise, shift, strict=True))
        ]
        return Prediction(misses, None, None, None)

    found = sum_errors([made(np.zeros(12)), made(more), made(np.full(12, 1e-4))])
    assert found.score(0).px["stripes"] == pytest.approx(0.1, rel=0.03)
    assert found.score(0).all_mm == pytest.approx(0.02, rel=0.03)
    difference, std = found.compute_excess(1, 0)
    # Of 12,000 values the cross term 2 * 0.1 * 0.05 scatters by 1 / sqrt(12000) of itself.
    assert difference == pytest.approx((0.2 * 0.05) ** 2, abs=4 * 0.2**2 * 0.01 / np.sqrt(12000))
    assert 0 < std < 0.2 * difference
    assert not found.as_good(1, 0)
    assert found.as_good(2, 0) and found.as_good(0, 1)


@pytest.mark.slow
def test_a_parameter_without_uncertainty_is_held_and_read_back(thesis):
    """If tilts and bow are known exactly, they are not estimated, but the file contains them."""
    known = thesis.uncertainty.model_copy(update={"window_tilt_deg": 0.0, "bow_deg": 0.0})
    window = thesis.camera.window.model_copy(update={"tilt_x_deg": 0.3})
    camera = thesis.camera.model_copy(update={"window": window})
    sensor = thesis.model_copy(update={"uncertainty": known, "camera": camera})
    series = target_series(sensor, medium=0, positions=IN_WATER[::2], columns=15)
    result = solve_jointly(gathered(sensor, [series]), options=OPTIONS)
    parameters = result.estimate.parameters
    assert not {"window_slope_x", "window_slope_y", "sheet_bow"} & {key.text for key in parameters.keys}
    assert result.calibration.window.normal == pytest.approx(tuple(window.normal()), abs=1e-12)
    stored = read_original_estimate(result.calibration, result.calibration.media[0].medium)
    assert stored.parameters.keys == parameters.keys
    assert stored.parameters.window_model(stored.values) == result.calibration.window
    assert stored.parameters.sheet_model(stored.values) == parameters.sheet_model(result.estimate.values)


def test_every_candidate_has_the_parameters_its_name_says(plain):
    def names_of(problem):
        return {key.text for key in problem.parameters.keys}

    usual = names_of(apply_candidate(plain, Candidate()))
    usually = {"p1", "p2", "target_saddle", "target_twist", "target_stretch_x", "target_stretch_y", "target_stripe"}
    assert usual == names_of(plain) - usually

    def lacking(**changes):
        names = names_of(apply_candidate(plain, Candidate(**changes)))
        return usual - names, names - usual

    assert lacking(window_tilt=False) == ({"window_slope_x", "window_slope_y"}, set())
    assert lacking(bow=False, window_turn=False) == ({"sheet_bow", "laser_window_turn"}, set())
    assert lacking(refractions=1) == ({"glass_thickness", "glass_index"}, set())
    assert lacking(distortion=("k1", "k2", "p1", "p2")) == (set(), {"p1", "p2"})


@pytest.mark.slow
def test_the_page_and_the_lines_tell_every_model(plain_choice):
    comparison = Comparison(
        "thesis <as built>", ["target.h5"], plain_choice, None, "no polynomials here", ["a warning"]
    )
    content = make_content(comparison)
    text = json_text(content, indent=2, only_ascii=False)
    written = json.loads(text)
    assert written.pop(SEAL) == compute_seal(written)
    assert ModelComparisonContent.model_validate(written) == content
    usual = written["models"][0]
    assert list(usual) == ["model", "parameters", "inside", "outside", "as_good"]
    page, lines = models_page(content), "\n".join(format_lines(content))
    assert "<svg" in page and "thesis &lt;as built&gt;" in page
    for judged in plain_choice.judged:
        assert judged.candidate.describe() in page and judged.candidate.describe() in lines
    for verdict in content.verdicts:
        assert verdict in lines and verdict[1:].replace("'", "&#39;") in page
