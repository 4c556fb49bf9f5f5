"""Values that a sensor's description inherits and that no longer fit are named; those that fit are not."""

import math
import warnings
from pathlib import Path

import pytest

from uwlts.errors import DescriptionWarning
from uwlts.model.library import Level, find_misfits, list_names, load_sensor

OWN = 'name = "mine"\nnotes = "a sensor of its own"\n'


def warned(folder: Path, text: str, base: str = "thesis") -> list[str]:
    """Return the warnings about a description that is based on another one."""
    path = folder / "mine.toml"
    path.write_text(f'base = "{base}"\n{text}', encoding="utf-8")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_sensor(path)
    assert all(issubclass(each.category, DescriptionWarning) for each in caught)
    return [str(each.message) for each in caught]


def keys(messages: list[str]) -> list[str]:
    return [message.split()[1] for message in messages]


def test_the_shipped_sensors_inherit_nothing_that_does_not_fit():
    names = list_names("sensors")
    assert len(names) >= 4
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in names:
            load_sensor(name)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[camera]\nwidth_px = 640\nheight_px = 512\npixel_size_um = 10.6\n",
        "[camera]\nfocal_length_mm = 12.9\n[laser]\nbaseline_mm = 263.0\nwavelength_nm = 638.0\n",
        "[stage]\ntravel_mm = 300.0\n[media.water]\ntemperature_c = 10.0\n",
    ],
)
def test_another_image_size_and_small_adjustments_are_not_warned_of(tmp_path, text):
    assert warned(tmp_path, text) == []


def test_another_stand_off_is_said_with_the_values_to_set(tmp_path):
    found = warned(tmp_path, OWN + "[laser]\nbaseline_mm = 150.0\n")
    assert keys(found) == ["camera.focus_distance_mm", "laser.waist_distance_mm", "volume.near_mm"]
    # 150 / tan 35 deg = 214.22 mm and 150 / sin 35 deg = 261.5 mm; 214.22 - 62.8 - 5.93 = 145.5 mm.
    assert all(
        "is inherited from 'thesis', but this description changes laser.baseline_mm (265 to 150)" in m for m in found
    )
    assert "= 378.5 " in found[0]
    assert "214.2 mm from the pupil" in found[0]
    # Apparent distance in water: 62.8 + 5.93 / 1.52 + 145.49 / 1.33122 = 175.99 mm.
    assert "176.0 in water" in found[0]
    assert "from the stand-off, 261.5" in found[1]
    assert "145.5 mm from the window, is outside the measuring volume" in found[2]


def test_a_volume_beside_the_stand_off_is_said_without_a_base(thesis):
    whole = Level("own", thesis.model_dump(mode="json"), thesis.model_dump(mode="json"))
    assert find_misfits([whole], thesis) == []
    beside = thesis.model_copy(update={"volume": thesis.volume.model_copy(update={"near_mm": 90.0, "far_mm": 200.0})})
    # 265 / tan 35 deg - 62.8 - 5.93 = 309.7 mm.
    (found,) = find_misfits([whole], beside)
    assert found.startswith(
        "own: the stand-off, 309.7 mm from the window, is outside the measuring volume of 90 to 200 mm"
    )


def test_a_description_that_follows_the_stand_off_is_not_warned_of(tmp_path):
    text = OWN + "[laser]\nbaseline_mm = 150.0\nwaist_distance_mm = 261.5\n[camera]\nfocus_distance_mm = 176.0\n"
    assert warned(tmp_path, text + "[volume]\nnear_mm = 90.0\nfar_mm = 200.0\n") == []


def test_another_wavelength_is_said_for_values_that_belong_to_it(tmp_path):
    found = warned(tmp_path, "[laser]\nwavelength_nm = 520.0\n")
    glass = ["camera.window.glass", "laser.window.glass"]
    assert keys(found) == ["name", "notes", "laser.waist_radius_mm", "detector.quantum_efficiency", *glass]
    assert "Fujinon" in found[1]
    # A waist of the same optics is proportional to the wavelength: 0.3 * 520 / 635.
    assert "focus 520 nm to 0.246 mm" in found[2]
    named = "[camera.window]\nglass = 'acrylic'\n[laser.window]\nglass = 'soda-lime'\n"
    named += "[detector]\nquantum_efficiency = 0.6\n"
    own = OWN + "[laser]\nwavelength_nm = 520.0\nwaist_radius_mm = 0.25\n"
    assert warned(tmp_path, own + named) == []


def test_another_lens_is_said_for_focus_distortion_and_notes(tmp_path):
    text = "[camera]\nfocal_length_mm = 25.0\n"
    assert keys(warned(tmp_path, text)) == ["name", "notes"]
    # At another stand-off the longer lens is blurred, too; the as-built description has a distortion of its own.
    found = warned(tmp_path, OWN + text + "[laser]\nbaseline_mm = 150.0\n", base="thesis-as-built")
    assert keys(found) == ["camera.focus_distance_mm", "laser.waist_distance_mm", "volume.near_mm", "camera.distortion"]
    assert "inherited from 'thesis'," in found[0]
    assert "inherited from 'thesis-as-built'," in found[3]


def test_an_intermediate_base_that_changes_nothing_again_does_not_hide_the_misfit(tmp_path):
    (tmp_path / "middle.toml").write_text(f'base = "thesis"\n{OWN}[laser]\nbaseline_mm = 150.0\n', encoding="utf-8")
    assert "camera.focus_distance_mm" in keys(warned(tmp_path, "[stage]\ntravel_mm = 300.0\n", base="middle"))


def test_another_medium_is_said_for_its_optical_constants(tmp_path):
    lake = '[media.lake]\nkind = "custom"\nindex = 1.36\nabsorption_per_m = 0.5\nscattering_per_m = 1.0\n'
    (tmp_path / "middle.toml").write_text(f'base = "thesis"\n{OWN}{lake}', encoding="utf-8")
    found = warned(tmp_path, '[media.lake]\nkind = "fresh"\nwater = "harbour"\n', base="middle")
    assert keys(found) == ["media.lake.index", "media.lake.absorption_per_m", "media.lake.scattering_per_m"]
    assert "media.lake.water (now 'harbour')" in found[2]
    assert warned(tmp_path, OWN + '[media.water]\nkind = "sea"\nsalinity_g_kg = 35.0\n') == []


def test_the_blur_is_that_of_a_thin_lens(tmp_path):
    # A description whose focus is wrong by just less and just more than 2 px of blur at the farther end, in air.
    pupil, pixels, standoff = 12.5 / 4, 12.5 / 0.0053, 150 / math.tan(math.radians(35))
    for blur, expected in ((1.9, []), (2.1, ["camera.focus_distance_mm"])):
        focus = 1 / (1 / standoff - blur / pupil / pixels)
        (tmp_path / "middle.toml").write_text(
            f'base = "thesis"\n{OWN}[camera]\nfocus_distance_mm = {focus}\n[volume]\nnear_mm = 90.0\n', encoding="utf-8"
        )
        laser = "[laser]\nbaseline_mm = 150.0\nwaist_distance_mm = 261.5\n"
        assert keys(warned(tmp_path, OWN + laser, base="middle")) == expected
