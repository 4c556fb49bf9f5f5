"""Descriptions by name or path: bases, cycles, and messages that say what to change."""

from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from uwlts.errors import DescriptionError, RangeError
from uwlts.model.library import (
    find_description,
    library_folder,
    list_names,
    load_sensor,
    merge_tables,
    read_table,
    validate_description,
)
from uwlts.model.sensor import Medium, Sensor

SMALL = 'base = "thesis"\nname = "small"\n[camera]\nwidth_px = 64\n'


def written(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def refused(path: Path, *words: str) -> str:
    with pytest.raises(DescriptionError) as caught:
        load_sensor(path)
    message = str(caught.value)
    assert all(word in message for word in words), message
    return message


def test_every_shipped_sensor_is_valid():
    shipped = list_names("sensors")
    assert {"thesis", "thesis-as-built"} <= set(shipped)
    for name in shipped:
        sensor = load_sensor(name)
        assert sensor.name == name and {"air", "water"} <= set(sensor.media)
        assert find_description(name, "sensors") == library_folder() / "sensors" / f"{name}.toml"


def test_names_are_of_their_own_folder():
    assert "spheres" in list_names()
    assert not set(list_names()) & set(list_names("sensors"))
    with pytest.raises(DescriptionError, match="known are thesis, thesis-as-built"):
        load_sensor("spheres")


def test_path_and_name_of_the_same_sensor_agree():
    path = find_description("thesis", "sensors")
    assert load_sensor(path) == load_sensor(str(path)) == load_sensor("thesis")


@pytest.mark.parametrize("name", ["", "no-such-sensor", "thesis.json", "../spheres.h5"])
def test_unknown_name_lists_the_known_ones(name: str):
    with pytest.raises(DescriptionError, match=r"nothing is called .*thesis.*\.toml"):
        load_sensor(name)


def test_missing_file(tmp_path: Path):
    refused(tmp_path / "none.toml", "no description at", "none.toml")
    (tmp_path / "folder.toml").mkdir()
    refused(tmp_path / "folder.toml", "no description at")


def test_base_is_filled_in_and_only_differences_count(tmp_path: Path):
    thesis, small = load_sensor("thesis"), load_sensor(written(tmp_path / "small.toml", SMALL))
    assert (small.name, small.camera.width_px) == ("small", 64)
    camera = small.camera.model_copy(update={"width_px": thesis.camera.width_px})
    assert small.model_copy(update={"name": "thesis", "camera": camera}) == thesis


def test_the_laser_may_be_placed_in_the_other_way_than_in_the_base(tmp_path: Path):
    there = "[laser]\norigin_mm = [-120.0, 0.0, 0.0]\naxis = [0.6, 0.0, 0.8]\n"
    laser = load_sensor(written(tmp_path / "mine.toml", 'base = "thesis"\nname = "mine"\n' + there)).laser
    assert laser.origin_mm == (-120.0, 0.0, 0.0) and laser.baseline_mm is None
    both = 'base = "thesis"\nname = "both"\n' + there + "baseline_mm = 100.0\n"
    with pytest.raises(DescriptionError, match="place the laser by"):
        load_sensor(written(tmp_path / "both.toml", both))


def test_base_of_a_base(tmp_path: Path):
    written(tmp_path / "small.toml", SMALL)
    path = written(tmp_path / "smaller.toml", 'base = "small"\n[camera]\nheight_px = 32\n')
    camera = load_sensor(path).camera
    assert (camera.width_px, camera.height_px) == (64, 32)


@pytest.mark.parametrize("base", ["small", "small.toml", "./small"])
def test_base_beside_the_file_wherever_the_program_runs(tmp_path: Path, monkeypatch, base: str):
    written(tmp_path / "sensors" / "small.toml", SMALL)
    path = written(tmp_path / "sensors" / "mine.toml", f'base = "{base}"\nname = "mine"\n')
    monkeypatch.chdir(tmp_path)
    assert load_sensor(path).camera.width_px == 64
    assert load_sensor(path.relative_to(tmp_path)).camera.width_px == 64


def test_file_may_be_called_like_its_shipped_base(tmp_path: Path, monkeypatch):
    path = written(tmp_path / "thesis.toml", SMALL)
    monkeypatch.chdir(tmp_path)
    assert load_sensor(path).camera.width_px == 64
    assert load_sensor("thesis.toml").camera.width_px == 64
    assert load_sensor("thesis").camera.width_px == 1280, "a name means the shipped description"


@pytest.mark.parametrize("ring", [1, 2, 3])
def test_cycles_are_reported_with_their_path(tmp_path: Path, ring: int):
    for number in range(ring):
        written(tmp_path / f"ring{number}.toml", f'base = "ring{(number + 1) % ring}"\n')
    # A file that names itself looks for a shipped description of this name.
    told = ("its own base", "ring0.toml -> ring1.toml", "-> ring0.toml") if ring > 1 else ("nothing is called 'ring0'",)
    refused(tmp_path / "ring0.toml", *told)


def test_a_circle_of_bases_is_refused_despite_different_paths(tmp_path: Path):
    """Paths that differ in writing, not in meaning."""
    written(tmp_path / "a" / "one.toml", 'base = "../b/two"\n')
    written(tmp_path / "b" / "two.toml", 'base = "../a/one"\n')
    refused(tmp_path / "a" / "one.toml", "its own base")


@pytest.mark.parametrize("base", ["3", '["thesis"]', '{ name = "thesis" }', "true"])
def test_base_must_be_a_name(tmp_path: Path, base: str):
    refused(written(tmp_path / "a.toml", f"base = {base}\n"), "a.toml: base is", "expected the name or path")


def test_unknown_base(tmp_path: Path):
    refused(written(tmp_path / "a.toml", 'base = "thesiss"\n'), "nothing is called 'thesiss'", "thesis-as-built")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[camera]\nwidth = 64\n", ("camera.width: unknown key", "unit suffix", "width_px, height_px")),
        ("colour = 'red'\n", ("colour: unknown key",)),
        ("[camera]\nwidth_px = 64.5\n", ("camera.width_px", "64.5")),
        ("[camera]\nwidth_px = 4\n", ("camera.width_px", "16", "found 4")),
        ("[camera]\nfocal_length_mm = nan\n", ("camera.focal_length_mm", "finite")),
        ("[camera]\nfocal_length_mm = inf\n", ("camera.focal_length_mm", "finite")),
        ("[camera]\nfocal_length_mm = '12.5 mm'\n", ("camera.focal_length_mm", "12.5 mm")),
        ("[camera]\nstripe_along = 'diagonal'\n", ("camera.stripe_along", "'width' or 'height'", "diagonal")),
        ("camera = 3\n", ("camera", "found 3")),
        ("[camera.window]\nglass = 'cheese'\n", ("unknown glass 'cheese'; known are N-BK7",)),
        ("[camera.window]\nglass = 1.0\n", ("camera.window.glass",)),
        ("[laser]\nfan_angle_deg = -45.0\n", ("laser.fan_angle_deg", "-45")),
        ("[detector]\nbits = 9\n", ("detector.bits", "found 9")),
        ("[media.lake]\nkind = 'fresh'\nsalinity_g_kg = 3.0\n", ("media.lake", "salinity 3 g/kg")),
        ("[laser]\naxis = [0, 0, 1]\n", ("laser: place the laser by",)),
        ("[volume]\nnear_mm = 500\n", ("volume: near_mm 500 must be smaller than far_mm 420",)),
        ("[media.brine]\nkind = 'custom'\n", ("media.brine: a custom medium needs its index",)),
        ("[media.brine]\nkind = 'sea'\n", ("media.brine: sea water with salinity 0 g/kg: set salinity_g_kg",)),
        ("[media.sea]\nkind = 'see'\n", ("media.sea.kind", "'sea'", "see")),
    ],
)
def test_wrong_keys_are_named_with_what_was_found(tmp_path: Path, text: str, words: tuple[str, ...]):
    refused(written(tmp_path / "a.toml", f'base = "thesis"\n{text}'), "a.toml", *words)


def test_all_wrong_keys_are_reported_at_once(tmp_path: Path):
    path = written(tmp_path / "a.toml", "name = 3\nspeed = 1\n")
    message = refused(path, "is not a valid sensor:", "camera: missing")
    assert len(message.splitlines()) > 5
    assert "speed: unknown key" in message


@pytest.mark.parametrize("degrees", [-1.0, 30.5, 99.0])
def test_formula_out_of_its_range_names_the_file(tmp_path: Path, degrees: float):
    path = written(tmp_path / "a.toml", f'base = "thesis"\n[media.water]\ntemperature_c = {degrees}\n')
    with pytest.raises(RangeError, match=rf"a\.toml.*temperature_c is {degrees:g}, but .*Quan and Fry.* from 0 to 30"):
        load_sensor(path)


@pytest.mark.parametrize(
    "content",
    [b"name = ", b"[camera\n", b"\xff\xfe\x00", b"name = 'a'\nname = 'b'\n", b"\x89HDF\r\n\x1a\n", b"x=" + b"[" * 9999],
    ids=["half a line", "half a table", "not UTF-8", "twice", "HDF5", "nested deeply"],
)
def test_invalid_toml_is_refused(tmp_path: Path, content: bytes):
    path = tmp_path / "a.toml"
    path.write_bytes(content)
    refused(path, "a.toml is not valid TOML")


def test_model_names_are_shown_as_words():
    class ReferenceValues(Medium):
        pass

    with pytest.raises(DescriptionError, match="is not a valid reference values:"):
        validate_description(ReferenceValues, {}, "here")


def test_sensor_survives_its_own_dump():
    sensor = load_sensor("thesis-as-built")
    assert Sensor.model_validate_json(sensor.model_dump_json()) == sensor


def test_base_stays_out_of_the_table(tmp_path: Path):
    assert "base" not in read_table(written(tmp_path / "a.toml", SMALL), "sensors")


TABLES = st.recursive(
    st.integers() | st.text(max_size=3) | st.lists(st.integers(), max_size=3),
    lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3),
    max_leaves=8,
)
TABLE = st.dictionaries(st.sampled_from("abc"), TABLES, max_size=3)


def leaves(table: dict, way: tuple = ()) -> dict:
    found = {}
    for key, value in table.items():
        found |= leaves(value, (*way, key)) if isinstance(value, dict) else {(*way, key): value}
    return found


@settings(deadline=None)
@given(base=TABLE, changes=TABLE)
def test_merging_applies_all_changes_and_nothing_else(base: dict, changes: dict):
    before = repr((base, changes))
    result = merge_tables(base, changes)
    assert repr((base, changes)) == before
    after, wanted = leaves(result), leaves(changes)
    assert wanted.items() <= after.items()
    # All other values are from the base, in tables that no change replaced as a whole.
    for way, value in after.items():
        if way not in wanted:
            assert leaves(base)[way] == value
    assert merge_tables(base, {}) == base
    assert merge_tables({}, changes) == changes
    assert merge_tables(result, changes) == result
