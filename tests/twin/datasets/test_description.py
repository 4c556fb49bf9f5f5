"""Descriptions of data sets: distributions, paths, splits, and rejected descriptions."""

import math
from itertools import pairwise
from typing import get_args

import numpy as np
import pytest
from scipy import stats

from tests.virtual_sensors import altered
from twin.datasets.data_set import DataSetDescription, Normal, OneOf, Uniform, load_description
from twin.datasets.generation import choose_split, draw_scene
from uwlts.errors import DescriptionError
from uwlts.model.library import list_names, load_sensor
from uwlts.storage.data_set import Split

TINY = {"title": "tiny", "scene": "plane", "sensor": "thesis-small"}
POWER = "sensor.laser.power_mw"


def described(**changes: object) -> DataSetDescription:
    """A small description with changes."""
    return load_description(DataSetDescription.model_validate(TINY | changes))


SHARES = np.linspace(0.005, 0.995, 199)
EXPECTED = {
    "uniform": (Uniform(kind="uniform", least=-2.0, most=6.0), stats.uniform(-2.0, 8.0)),
    "log_uniform": (Uniform(kind="log_uniform", least=0.1, most=40.0), stats.loguniform(0.1, 40.0)),
    "normal": (Normal(kind="normal", mean=3.0, std=2.0), stats.norm(3.0, 2.0)),
    "cut": (Normal(kind="normal", mean=3.0, std=2.0, least=2.0, most=9.0), stats.truncnorm(-0.5, 3.0, 3.0, 2.0)),
}


@pytest.mark.parametrize("name", EXPECTED)
def test_distributions_are_the_inverse_of_scipys(name):
    distribution, reference = EXPECTED[name]
    values = [float(distribution.quantile(share)) for share in SHARES]
    np.testing.assert_allclose(reference.cdf(values), SHARES, atol=1e-9)


def test_choices_come_as_often_as_their_weights_say():
    choice = OneOf(kind="choice", values=("a", "b", "c"), weights=(1.0, 2.0, 1.0))
    drawn = [choice.quantile(share) for share in (np.arange(400) + 0.5) / 400]
    assert [drawn.count(value) for value in "abc"] == [100, 200, 100]
    assert OneOf(kind="choice", values=(1, 2)).quantile(0.5) == 2


def test_every_path_of_every_scene_has_numbers_of_its_own():
    vary = {POWER: {"kind": "uniform", "least": 1.0, "most": 2.0}}
    alone = described(vary=vary)
    both = described(vary={"scene.objects.0.reflectance": {"kind": "uniform", "least": 0.1, "most": 0.9}} | vary)
    assert [draw_scene(alone, k).values[POWER] for k in range(5)] == [
        draw_scene(both, k).values[POWER] for k in range(5)
    ]
    values = [draw_scene(both, k).values for k in range(400)]
    power, reflectance = (np.array([each[path] for each in values], float) for path in both.vary)
    # Of 400 independent pairs the correlation exceeds 0.2 once in 16,000; the seeds are fixed.
    assert abs(np.corrcoef(power, reflectance)[0, 1]) < 0.2
    assert draw_scene(both, 3, attempt=1).values != draw_scene(both, 3).values
    assert draw_scene(described(vary=vary, seed=1), 0).values != draw_scene(alone, 0).values


def test_values_go_where_their_paths_lead():
    vary = {
        POWER: {"kind": "choice", "values": [12.5]},
        "as_built.camera.window.tilt_x_deg": {"kind": "choice", "values": [0.3]},
        "scene.objects.0.position_mm.2": {"kind": "choice", "values": [7.0]},
        "scene.water": {"kind": "choice", "values": ["coastal"]},
        "effects.glare": {"kind": "choice", "values": [0.07]},
        "sensor.detector.pattern_seed": {"kind": "uniform", "least": 4.6, "most": 5.4},
        "frame.exposure": {"kind": "uniform", "least": 0.5, "most": 2.0},
    }
    base = described(vary=vary, motion={"count": 3})
    drawn = draw_scene(base, 0)
    assert drawn.sensor.laser.power_mw == drawn.as_built.laser.power_mw == 12.5
    assert (drawn.sensor.camera.window.tilt_x_deg, drawn.as_built.camera.window.tilt_x_deg) == (0.0, 0.3)
    assert drawn.scene.objects[0].position_mm == (0.0, 0.0, 7.0)
    assert drawn.scene.water == "coastal"
    assert drawn.options.flaws.glare == pytest.approx(0.07)
    assert drawn.sensor.detector.pattern_seed == 5 and type(drawn.values["sensor.detector.pattern_seed"]) is int
    assert len(set(drawn.exposures)) == 3 and all(0.5 <= factor <= 2.0 for factor in drawn.exposures)
    assert base.scene.objects[0].position_mm == (0.0, 0.0, 0.0), "the base stays as it is"


def test_splits_are_by_scene_and_keep_their_members_as_scenes_are_added():
    few, many = described(scenes=20), described(scenes=2000)
    for scene in range(20):
        assert choose_split(few, scene) == choose_split(many, scene)
    members = [choose_split(many, scene) for scene in range(2000)]
    for split, share in zip(get_args(Split), (0.8, 0.1, 0.1), strict=True):
        # Multiples of the golden section fill every interval nearly evenly.
        assert members.count(split) == pytest.approx(2000 * share, abs=5)
    assert {choose_split(described(splits={"train": 0, "validation": 0, "test": 1}), k) for k in range(50)} == {"test"}


WRONG = {
    "no such key": ({"vary": {POWER: {"kind": "uniform", "leest": 1, "most": 2}}}, "leest: unknown key"),
    "no such kind": ({"vary": {POWER: {"kind": "gauss", "mean": 1}}}, "uniform"),
    "no such path": (
        {"vary": {"sensor.laser.power": {"kind": "choice", "values": [1]}}},
        "no 'laser.power': there is no 'power', but wavelength_nm",
    ),
    "no such object": (
        {"vary": {"scene.objects.1.reflectance": {"kind": "choice", "values": [0.1]}}},
        "there is no '1', but 0 to 0",
    ),
    "a table": ({"vary": {"sensor.laser": {"kind": "choice", "values": [1]}}}, "'laser' is a table; name one of"),
    "no such root": (
        {"vary": {"camera.f_number": {"kind": "choice", "values": [1]}}},
        "begins with sensor., as_built.",
    ),
    "no such effect": ({"vary": {"effects.glitter": {"kind": "choice", "values": [1]}}}, "unknown effect 'glitter'"),
    "no strength": (
        {"vary": {"effects.colour-filter": {"kind": "choice", "values": [1]}}},
        "does not have a strength; name it in effects",
    ),
    "a word for a number": ({"vary": {POWER: {"kind": "choice", "values": ["strong"]}}}, "in place of the number 7"),
    "another size": ({"vary": {"sensor.camera.width_px": {"kind": "choice", "values": [64]}}}, "have the same size"),
    "ends exchanged": (
        {"vary": {POWER: {"kind": "uniform", "least": 2, "most": 1}}},
        "least 2 must be smaller than most 1",
    ),
    "no logarithm": ({"vary": {POWER: {"kind": "log_uniform", "least": 0, "most": 1}}}, "it must be above 0"),
    "nothing between": (
        {"vary": {POWER: {"kind": "normal", "mean": 0, "std": 1, "least": 9, "most": 10}}},
        "less than a millionth",
    ),
    "weights": ({"vary": {POWER: {"kind": "choice", "values": [1, 2], "weights": [1]}}}, "1 weights for 2 values"),
    "shares": ({"splits": {"train": 0.5}}, "add up to 0.7; expected 1"),
    "no such label": ({"labels": ["centres"]}, "labels.0"),
    "no target": ({"labels": ["target"]}, "for scenes with a calibration target"),
    "a wrong value": ({"vary": {POWER: {"kind": "choice", "values": [-1.0]}}}, "drawn: sensor.laser.power_mw = -1.0"),
    "a blurred exposure": (
        {"motion": {"speed_mm_per_s": 5.0}, "vary": {"frame.exposure": {"kind": "choice", "values": [2.0]}}},
        "vary sensor.exposure.laser_ms instead",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said(name, tmp_path):
    changes, message = WRONG[name]
    with pytest.raises(DescriptionError) as caught:
        given = load_description(_written(tmp_path, TINY | changes))
        draw_scene(given, 0)
    assert message in str(caught.value)


def _written(folder, table):
    import tomli_w

    path = folder / "described.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return path


def test_scene_and_sensor_beside_a_description_are_found(tmp_path):
    (tmp_path / "mine.toml").write_text('base = "plane"\ntitle = "my plane"\n', encoding="utf-8")
    (tmp_path / "cam.toml").write_text('base = "thesis"\nname = "cam"\n', encoding="utf-8")
    found = load_description(
        _written(tmp_path, {"title": "t", "scene": "mine.toml", "sensor": "cam.toml"}), scenes=7, seed=9
    )
    assert (found.scene.title, found.sensor.name, found.scenes, found.seed) == ("my plane", "cam", 7, 9)
    assert load_description(DataSetDescription.model_validate(found.model_dump())) == found


@pytest.mark.parametrize("name", list_names("datasets"))
def test_presets_draw_valid_scenes_over_all_of_their_ranges(name):
    preset = load_description(name)
    drawn = [draw_scene(preset, scene) for scene in range(12)]
    assert {each.scene.title for each in drawn} == {preset.scene.title}
    assert len({str(each.values) for each in drawn}) == 12
    for path, distribution in preset.vary.items():
        if not isinstance(distribution, OneOf):
            ends = [preset.draw_value(path, share) for share in (0.001, 0.5, 0.999)]
            assert all(isinstance(end, str) or math.isfinite(end) for end in ends)
            assert all(a <= b for a, b in pairwise(ends)), path


@pytest.mark.parametrize("bits", [8, 12])
def test_presets_take_another_sensor_as_it_is(bits):
    """Its stand-off, lens and wavelength are not those of the preset; 12 bits cannot be JPEG."""
    far = {"laser": {"wavelength_nm": 532.0, "baseline_mm": 520.0}, "detector": {"bits": bits}}
    own = altered(load_sensor("thesis-small"), far)
    for name in ("stripe-clean", "stripe-tank"):
        preset, taken = load_description(name), load_description(name, sensor=own, scenes=2)
        assert taken.scenes == 2 and taken.sensor == own
        fixed = {path for path in preset.vary if path.startswith(("sensor.", "as_built."))}
        varied = {"sensor.lamp.irradiance_w_per_m2", "sensor.lamp.ambient_w_per_m2"} & fixed
        lost = {"effects.jpeg"} if bits > 8 else set()
        assert preset.vary.keys() - taken.vary.keys() == (fixed - varied) | lost
        drawn = draw_scene(taken, 0)
        assert drawn.sensor.laser == drawn.as_built.laser == own.laser
        assert drawn.sensor.camera == own.camera
