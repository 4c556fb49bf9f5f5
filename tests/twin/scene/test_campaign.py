"""Campaigns: values drawn for each seed, deviations of real hardware from descriptions, and rejected plans."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.virtual_sensors import scene_of
from twin.scene.campaign import Campaign, Imperfections, Take, _SampledImperfections, list_takes, load_campaign
from twin.scene.description import load_scene
from uwlts.errors import DescriptionError
from uwlts.model.library import list_names, load_sensor
from uwlts.model.sensor import Sensor

SIZES = {
    "circle_centre_std_mm": 0.002,
    "target_stretch_std": 1e-4,
    "target_bow_std_mm": 0.02,
    "circle_detection_std_px": 0.03,
    "target_tilt_std_deg": 0.1,
    "stage_position_std_mm": 0.003,
    "stage_lead_std": 5e-5,
    "stage_misalignment_std_deg": 0.2,
    "temperature_half_width_c": 5.0,
    "window_tilt_std_deg": 0.3,
    "glass_thickness_std_mm": 0.05,
    "glass_index_std": 1e-3,
    "focus_std_mm": 10.0,
    "sheet_bow_std_deg": 0.15,
    "waist_std": 0.1,
    "waist_distance_std_mm": 20.0,
    "step_height_half_width_mm": 0.02,
}
RECORDINGS = [
    {"scene": "target", "name": "target"},
    {"scene": "target-through-window", "name": "target-water", "media": ["water"]},
    {"scene": "step"},
    {"scene": "plane", "media": ["air", "water"], "placements": ["near", "far-turned"]},
    {"scene": "pipe", "name": "line", "motion": {"count": 1}, "stripe_along": "height", "as_described": True},
]
NAMES = [
    "target",
    "target-water",
    "step-standoff-water",
    "plane-near-air",
    "plane-near-water",
    "plane-far-turned-air",
    "plane-far-turned-water",
    "line",
]
TARGETS, STEP, PLANES = NAMES[:2], NAMES[2], NAMES[3:7]
SEEDS = 200


def campaign(recordings: list[dict[str, Any]] = RECORDINGS, **sizes: float) -> Campaign:
    about = {"title": "test", "sensor": "thesis", "as_built": "thesis-as-built", "imperfections": sizes}
    return Campaign.model_validate(about | {"recordings": recordings})


def drawn(seed: int = 0, *, every: int = 1, **sizes: float) -> dict[str, Take]:
    return {take.name: take for take in list_takes(campaign(**sizes), seed=seed, every=every)}


@pytest.fixture(scope="module")
def drawings() -> list[dict[str, Take]]:
    """Return the takes of many seeds with all imperfections, but no errors of position, which would hide the lead.

    No imperfection changes the draws of another one, as tested below.
    """
    chosen = campaign(RECORDINGS[:4], **SIZES | {"stage_position_std_mm": 0.0})
    return [{take.name: take for take in list_takes(chosen, seed=seed)} for seed in range(SEEDS)]


def differing(one: Any, other: Any, *, at: str = "") -> set[str]:
    """Return the differences between two dumps of descriptions: keys joined by dots, without list indices."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return set().union(*(differing(one[key], other[key], at=f"{at}.{key}") for key in one))
    if isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        return set().union(*(differing(a, b, at=at) for a, b in zip(one, other, strict=True)))
    return set() if one == other else {at.removeprefix(".")}


def dumped(take: Take) -> dict[str, Any]:
    return {"scene": take.scene.model_dump(), "built": take.built.model_dump(), "sensor": take.sensor.model_dump()}


def assert_spread(values: Any, std: float) -> None:
    """Independent draws (N, ...) about 0 have a standard deviation.

    For N normal draws it has the relative uncertainty 1 / sqrt(2 N), and the mean has 1 / sqrt(N): 4.5 times either.
    For evenly spread draws both uncertainties are smaller.
    """
    values = np.ravel(values)
    assert len(values) >= SEEDS
    assert values.std() == pytest.approx(std, rel=4.5 / math.sqrt(2 * len(values)))
    assert abs(values.mean()) < 4.5 * std / math.sqrt(len(values))


def assert_independent(one: Any, other: Any) -> None:
    """The correlation of N independent pairs is uncertain by 1 / sqrt(N)."""
    assert abs(np.corrcoef(one, other)[0, 1]) < 4.5 / math.sqrt(len(one))


def plate(take: Take):
    (found,) = (thing for thing in take.scene.objects if thing.kind == "circle_plate")
    return found


def deflection_deg(take: Take) -> np.ndarray:
    """Return the components (3,) of the angle between the stage's true direction and the recorded one."""
    return np.degrees(take.scene.motion.unit_direction() - take.scene.motion.recorded_direction())


# --- seeds


def test_takes_are_named_by_scene_placement_and_medium():
    assert list(drawn()) == NAMES
    found = drawn()["plane-far-turned-air"].scene
    assert (found.placement, found.medium) == ("far-turned", "air")


def test_one_seed_draws_the_same_again():
    assert list_takes(campaign(**SIZES), seed=3) == list_takes(campaign(**SIZES), seed=3)


def test_another_seed_draws_all_anew():
    one, other = drawn(3, **SIZES), drawn(4, **SIZES)
    for name in NAMES[:-1]:
        assert one[name].built != other[name].built
        assert one[name].scene != other[name].scene
    seeds = [take.seed for takes_of_seed in (one, other) for take in takes_of_seed.values()]
    assert len(set(seeds)) == 2 * len(NAMES), "noise of its own in every recording"


def test_recordings_do_not_depend_on_which_others_there_are():
    alone = list_takes(campaign([RECORDINGS[3]], **SIZES), seed=5)
    whole = drawn(5, **SIZES)
    assert len(alone) == len(PLANES)
    assert all(take == whole[take.name] for take in alone)


# --- imperfections

CHANGED = {
    "circle_centre_std_mm": {"scene.objects.centre_std_mm": TARGETS},
    "target_stretch_std": {"scene.objects.stretch": TARGETS},
    "target_bow_std_mm": {"scene.objects.bow_mm": TARGETS},
    "circle_detection_std_px": {"scene.objects.detection_std_px": TARGETS},
    "target_tilt_std_deg": {"scene.objects.rotation_deg": TARGETS},
    "stage_position_std_mm": {"scene.motion.position_errors_mm": NAMES[:-1]},
    "stage_lead_std": {"scene.motion.position_errors_mm": NAMES[:-1]},
    "stage_misalignment_std_deg": {"scene.motion.direction": NAMES[:-1]},
    "temperature_half_width_c": {"built.media.water.temperature_c": NAMES[:-1]},
    "window_tilt_std_deg": {f"built.camera.window.tilt_{axis}_deg": NAMES[:-1] for axis in "xy"},
    "glass_thickness_std_mm": {"built.camera.window.thickness_mm": NAMES[:-1]},
    "glass_index_std": {f"built.camera.window.{key}": NAMES[:-1] for key in ("glass", "absorption_per_m")},
    "focus_std_mm": {"built.camera.focus_distance_mm": NAMES[:-1]},
    "sheet_bow_std_deg": {"built.laser.bow_deg": NAMES[:-1]},
    "waist_std": {"built.laser.waist_radius_mm": NAMES[:-1]},
    "waist_distance_std_mm": {"built.laser.waist_distance_mm": NAMES[:-1]},
    "step_height_half_width_mm": {"scene.objects.position_mm": [STEP]},
}


def test_every_imperfection_is_tested():
    assert CHANGED.keys() == SIZES.keys() == Imperfections.model_fields.keys()


@pytest.mark.parametrize("name", CHANGED)
def test_an_imperfection_alone_changes_what_it_is_about_and_nothing_else(name: str):
    without, alone, others = drawn(1), drawn(1, **{name: SIZES[name]}), drawn(1, **SIZES | {name: 0.0})
    for take in NAMES:
        expected = {path for path, where in CHANGED[name].items() if take in where}
        assert differing(dumped(without[take]), dumped(alone[take])) == expected, take
        assert without[take].seed == alone[take].seed
        left = set() if name in ("stage_position_std_mm", "stage_lead_std") else expected
        assert not left & differing(dumped(without[take]), dumped(others[take])), f"{take}: the others leave it alone"


def test_any_printed_target_has_a_targets_imperfections():
    board = {"kind": "chessboard", "columns": 7, "rows": 6, "square_mm": 10.0}
    scene = scene_of({"kind": "target_plate"}, target=board)
    found = _SampledImperfections(campaign(**SIZES), 1).apply_imperfections(scene, np.random.default_rng(1)).objects[0]
    assert (found.centre_std_mm, found.detection_std_px, found.errors_seed) == (0.002, 0.03, 1)
    assert found.bow_mm != 0
    assert np.count_nonzero(found.rotation_deg) == 2


def test_without_imperfections_everything_is_as_built():
    for name, take in drawn(1).items():
        described = name == "line"
        sensor = load_sensor("thesis" if described else "thesis-as-built")
        if described:
            sensor = sensor.model_copy(update={"camera": sensor.camera.model_copy(update={"stripe_along": "height"})})
        assert take.built == sensor
        scene = load_scene(
            {"line": "pipe", "target-water": "target-through-window"}.get(name, name.split("-")[0]),
            placement=take.scene.placement,
            medium=take.scene.medium,
        )
        # Errors of size 0 vanish for any seed.
        changed = differing(scene.model_dump(), take.scene.model_dump())
        stage = {f"motion.{key}" for key in ("count", "nominal_direction", "position_errors_mm")}
        assert changed <= stage | {"objects.errors_seed"}
        assert ("motion.count" in changed) == described
        assert take.scene.motion.recorded_direction() == tuple(scene.motion.unit_direction())
        np.testing.assert_allclose(take.scene.motion.unit_direction(), scene.motion.unit_direction(), atol=1e-15)
        assert all(shot.travelled_mm == shot.stage_mm for shot in take.scene.motion.shots())


def test_what_the_capture_states_stays_nominal():
    nominal = drawn(2)
    for name, take in drawn(2, **SIZES).items():
        assert take.sensor == nominal[name].sensor
        assert take.sensor.model_dump(exclude={"camera"}) == load_sensor("thesis").model_dump(exclude={"camera"})
        scene, described = take.scene, nominal[name].scene
        assert scene.motion.recorded_direction() == described.motion.recorded_direction()
        assert [shot.stage_mm for shot in scene.motion.shots()] == [shot.stage_mm for shot in described.motion.shots()]
        assert (scene.artefact, scene.target) == (described.artefact, described.target)
    assert drawn(2, **SIZES)[STEP].scene.artefact["height_mm"] == 23.17


def test_a_recording_as_described_has_no_imperfections():
    take = drawn(2, **SIZES)["line"]
    assert take.built == take.sensor
    assert take.sensor.camera.stripe_along == "height"
    assert take.scene == load_scene("pipe", motion=load_scene("pipe").motion.model_dump() | {"count": 1})


def test_one_sensor_records_a_whole_campaign():
    found = drawn(2, **SIZES)
    sensors = [found[name].built.model_dump(exclude={"media"}) for name in NAMES[:-1]]
    assert all(sensor == sensors[0] for sensor in sensors)


@pytest.mark.slow
def test_size_of_the_waters_temperature(drawings):
    warmer = {
        name: [found[name].built.media["water"].temperature_c - 25.0 for found in drawings] for name in NAMES[:-1]
    }
    for name in ("target", "plane-near-water"):
        assert_spread(warmer[name], 5.0 / math.sqrt(3))
        # The largest of 200 uniform draws is within 5 % of the end, except once in 30000 times.
        assert 4.75 < np.abs(warmer[name]).max() <= 5.0
    assert warmer["target"] == warmer["target-water"] == warmer[STEP]
    assert all(warmer[name] == warmer["plane-near-water"] for name in PLANES)
    assert_independent(warmer["target"], warmer["plane-near-water"])
    assert drawings[0]["target"].built.media["air"] == load_sensor("thesis-as-built").media["air"]


@pytest.mark.slow
def test_size_of_the_targets_errors(drawings):
    assert_spread([plate(found["target"]).bow_mm for found in drawings], 0.02)
    found = drawn(7, **SIZES)
    plates = [plate(found[name]) for name in TARGETS]
    assert [each.centre_std_mm for each in plates] == [0.002] * 2
    assert [each.detection_std_px for each in plates] == [0.03] * 2
    assert plates[0].bow_mm == plates[1].bow_mm != 0, "the same plate"
    assert plates[0].errors_seed == plates[1].errors_seed != plate(drawn(8, **SIZES)["target"]).errors_seed


@pytest.mark.slow
def test_size_of_window_focus_sheet_and_print(drawings):
    def values(sensor: Sensor) -> list[float]:
        window, laser = sensor.camera.window, sensor.laser
        waist = math.log(laser.waist_radius_mm)
        of_window = window.thickness_mm, window.index(laser.wavelength_nm), window.tilt_x_deg, window.tilt_y_deg
        return [*of_window, sensor.camera.focus_distance_mm, waist, laser.waist_distance_mm, laser.bow_deg]

    names = ["glass_thickness_std_mm", "glass_index_std", *["window_tilt_std_deg"] * 2, "focus_std_mm", "waist_std"]
    names += ["waist_distance_std_mm", "sheet_bow_std_deg", *["target_stretch_std"] * 2]
    takes = [found["target"] for found in drawings]
    found = np.array([[*values(take.built), *plate(take).stretch] for take in takes])
    errors = found - [*values(load_sensor("thesis-as-built")), 0.0, 0.0]
    for column, name in zip(errors.T, names, strict=True):
        assert_spread(column, SIZES[name])
    for one, other in itertools.combinations(errors.T, 2):
        assert_independent(one, other)


@pytest.mark.slow
def test_size_of_the_targets_tilt(drawings):
    """The target is mounted again for every recording, with rotations about X and Y, not about Z."""
    tilts = np.array([[plate(found[name]).rotation_deg for name in TARGETS] for found in drawings])
    assert (tilts[..., 2] == 0).all()
    assert_spread(tilts[..., :2], 0.1)
    assert_independent(tilts[:, 0, 0], tilts[:, 0, 1])
    assert_independent(tilts[:, 0, 0], tilts[:, 1, 0])


def test_size_of_the_stages_errors():
    one, other = (drawn(seed, stage_position_std_mm=0.003) for seed in (0, 1))
    errors = [takes_of[name].scene.motion.position_errors_mm for takes_of in (one, other) for name in PLANES]
    assert all(len(each) == 150 for each in errors)
    assert_spread(errors, 0.003)
    assert_independent(errors[0], errors[1])
    assert_independent(errors[0], errors[4])
    assert_independent(errors[0][1:], errors[0][:-1])


@pytest.mark.slow
def test_size_of_the_stages_lead(drawings):
    shares = []
    for found in drawings:
        shots = [shot for name in ("target", "plane-near-air") for shot in found[name].scene.motion.shots()]
        stage, travelled = np.array([(shot.stage_mm, shot.travelled_mm) for shot in shots]).T
        share = (travelled - stage) @ stage / (stage @ stage)
        # The sum of position and error is rounded to some 3e-14 mm.
        np.testing.assert_allclose(travelled - stage, share * stage, atol=1e-12)
        shares.append(share)
    assert_spread(shares, 5e-5)


@pytest.mark.slow
def test_size_of_the_stages_misalignment(drawings):
    by_name = {name: np.array([deflection_deg(found[name]) for found in drawings]) for name in NAMES[:-1]}
    for name in (STEP, *PLANES):
        np.testing.assert_array_equal(by_name[name], by_name[STEP])
    # The travel itself shortens by half the square of the angle: draws stay below 5 times 0.2 deg, 0.0175 either.
    along_x, along_z = by_name[STEP], by_name["target"]
    assert np.abs(along_x[:, 0]).max() < np.degrees(0.0175**2)
    assert np.abs(along_z[:, 2]).max() < np.degrees(0.0175**2)
    assert_spread(along_x[:, 1:], 0.2)
    assert_spread(along_z[:, :2], 0.2)
    assert_independent(along_x[:, 1], along_x[:, 2])
    # The sensor is mounted again for each target.
    assert_independent(along_x[:, 1], along_z[:, 1])
    assert_independent(along_z[:, 0], by_name["target-water"][:, 0])


@pytest.mark.slow
def test_size_of_the_steps_height(drawings):
    heights = []
    for found in drawings:
        blocks = [thing for thing in found[STEP].scene.objects if thing.kind == "block"]
        fronts = sorted(block.position_mm[2] - block.size_mm[2] / 2 for block in blocks)
        heights.append(fronts[1] - fronts[0])
        assert fronts[0] == pytest.approx(-11.585), "the upper face stays"
    assert_spread(np.array(heights) - 23.17, 0.02 / math.sqrt(3))
    assert 0.95 * 0.02 < np.abs(np.array(heights) - 23.17).max() <= 0.02 + 1e-9


# --- thinned scans


@pytest.mark.parametrize("every", [7, 10, 30])
def test_scans_are_thinned_and_calibrations_are_not(every: int):
    whole, thinned = drawn(1), drawn(1, every=every)
    for name in (*TARGETS, STEP, "line"):
        assert thinned[name].scene.motion == whole[name].scene.motion, name
    for name in PLANES:
        kept = [shot.stage_mm for shot in thinned[name].scene.motion.shots()]
        np.testing.assert_allclose(kept, [shot.stage_mm for shot in whole[name].scene.motion.shots()][::every])
        assert len(kept) == math.ceil(150 / every)
        assert len(thinned[name].scene.motion.position_errors_mm) == len(kept)


def test_a_scan_keeps_at_least_five_profiles():
    assert drawn(1, every=30)["plane-near-air"].scene.motion.count == 5
    assert drawn(1, every=31)["plane-near-air"].scene.motion.count == 150


# --- descriptions from files


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


HEAD = 'title = "test"\nsensor = "thesis"\nas_built = "thesis"\n'
PLANE = '[[recordings]]\nscene = "plane"\n'


def test_the_campaigns_water_replaces_that_of_scenes_in_water():
    described = campaign(RECORDINGS[:4]).model_copy(update={"water": "coastal"})
    waters = {take.name: take.scene.water for take in list_takes(described, seed=0)}
    assert {name: water for name, water in waters.items() if water is None} == dict.fromkeys(
        ["target", "plane-near-air", "plane-far-turned-air"]
    )
    assert {water for water in waters.values() if water is not None} == {"coastal"}


def test_each_campaign_draws_its_own_pits_and_undercuts():
    described = campaign([{"scene": "pits"}, {"scene": "undercut"}, {"scene": "pitted-pipe"}])
    seeds = np.array([[take.scene.objects[0].seed for take in list_takes(described, seed=seed)] for seed in (0, 1)])
    assert (seeds[0, :2] != seeds[1, :2]).all()
    assert (seeds[:, 2] == 0).all(), "pits of given depths stay"


def test_shipped_campaigns_can_be_drawn():
    assert "thesis" in list_names("campaigns")
    for name in list_names("campaigns"):
        shipped = load_campaign(name)
        assert len(list_takes(shipped, seed=0)) >= len(shipped.recordings)


def test_paths_start_at_the_campaigns_folder(tmp_path: Path, monkeypatch):
    folder, elsewhere = tmp_path / "mine", tmp_path / "elsewhere"
    folder.mkdir()
    elsewhere.mkdir()
    written(folder / "sensor.toml", 'base = "thesis"\nname = "mine"\n')
    written(folder / "board.toml", 'base = "plane"\ntitle = "Board"\n')
    head = 'title = "test"\nsensor = "sensor.toml"\nas_built = "sensor.toml"\n'
    written(folder / "campaign.toml", f'{head}[[recordings]]\nscene = "board.toml"\n')
    monkeypatch.chdir(elsewhere)
    (take,) = list_takes(load_campaign("../mine/campaign.toml"), seed=0)
    assert (take.name, take.scene.title) == ("board-standoff-water", "Board")
    assert take.sensor.name == take.built.name == "mine"
    (take,) = list_takes(load_campaign(folder / "campaign.toml"), seed=0)
    assert take.name == "board-standoff-water"


def test_the_sensor_as_built_is_that_of_the_last_sensor_named(tmp_path: Path):
    written(tmp_path / "mine.toml", 'base = "thesis-small"\nname = "mine"\n')
    built = {}
    for name, text in {
        "base": 'base = "thesis"\n',
        "other": 'base = "thesis"\nsensor = "mine.toml"\n',
        "both": 'base = "other"\nas_built = "thesis-small-as-built"\n',
        "again": 'base = "both"\ntitle = "again"\n',
    }.items():
        described = load_campaign(written(tmp_path / f"{name}.toml", text))
        built[name] = Path(described.sensor).stem, Path(described.as_built).stem
    assert built == {
        "base": ("thesis", "thesis-as-built"),
        "other": ("mine", "mine"),
        "both": ("mine", "thesis-small-as-built"),
        "again": ("mine", "thesis-small-as-built"),
    }


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD, "recordings: missing"),
        (HEAD + "recordings = []", "recordings: Tuple should have at least 1 item"),
        (PLANE, "title: missing"),
        (f'{HEAD}colour = "red"\n{PLANE}', "colour: unknown key"),
        (f"{HEAD}[imperfections]\nwindow_tilt_deg = 1.0\n{PLANE}", "imperfections.window_tilt_deg: unknown key"),
        (f"{HEAD}[imperfections]\nwindow_tilt_std_deg = -1.0\n{PLANE}", "imperfections.window_tilt_std_deg"),
        (f"{HEAD}[imperfections]\nwindow_tilt_std_deg = nan\n{PLANE}", "imperfections.window_tilt_std_deg"),
        (f'{HEAD}{PLANE}place = "near"\n', "place: unknown key"),
        (f'{HEAD}{PLANE}media = "air"\n', "media"),
        (f'{HEAD}{PLANE}stripe_along = "depth"\n', "stripe_along"),
    ],
)
def test_campaigns_that_are_wrong(tmp_path: Path, text: str, says: str):
    path = written(tmp_path / "campaign.toml", text)
    with pytest.raises(DescriptionError, match=r"campaign\.toml is not a valid campaign") as raised:
        load_campaign(path)
    assert says in str(raised.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD + PLANE + PLANE, "several recordings would be called plane-standoff-water: give each its own name"),
        (HEAD + f'{PLANE}name = "a"\nmedia = ["air", "water"]\n', "several recordings would be called a"),
        (HEAD + '[[recordings]]\nscene = "teapot"\n', "nothing is called 'teapot'; known are"),
        (HEAD + '[[recordings]]\nscene = "teapot.toml"\n', "no description at"),
        (HEAD + f'{PLANE}placements = ["moon"]\n', "placement 'moon' is not one of near, standoff, far"),
        (HEAD + f"{PLANE}motion = {{ steps = 3 }}\n", "motion.steps: unknown key"),
        (HEAD.replace('sensor = "thesis"', 'sensor = "eye"') + PLANE, "nothing is called 'eye'"),
        (HEAD.replace('as_built = "thesis"', 'as_built = "eye"') + PLANE, "nothing is called 'eye'"),
        (HEAD.replace('as_built = "thesis"', 'as_built = "thesis-small"') + PLANE, "'thesis' differ in image size"),
    ],
)
def test_campaigns_that_cannot_be_taken(tmp_path: Path, text: str, says: str):
    with pytest.raises(DescriptionError) as raised:
        list_takes(load_campaign(written(tmp_path / "campaign.toml", text)), seed=0)
    assert says in str(raised.value)


def test_a_step_standard_without_blocks(tmp_path: Path):
    """Only its height's error needs blocks."""
    scene = 'title = "Step"\n[artefact]\nkind = "step"\n[[objects]]\nkind = "sphere"\ndiameter_mm = 9.0\n'
    recordings = [{"scene": str(written(tmp_path / "smooth.toml", scene)), "name": "a"}]
    with pytest.raises(DescriptionError, match=r"Step: a step standard of 0 blocks.*step_height_half_width_mm to 0"):
        list_takes(campaign(recordings, step_height_half_width_mm=0.02), seed=0)
    assert [take.name for take in list_takes(campaign(recordings, window_tilt_std_deg=0.1), seed=0)] == ["a"]
