"""Twin of a drawn sensor and water: what is fitted to its scan, and the page that compares scan and rendering."""

import pytest

import twin
import uwlts
from docs.studies.radiometry import DESCRIBED, SCENE, SENSOR
from uwlts.cli import app
from uwlts.errors import CaptureError, DescriptionError
from uwlts.radiometry.result import read_estimates
from uwlts.runtime.console import run

WATER = "absorption_per_m = 0.6\nscattering_per_m = 0.5\nphase = 'petzold'"
BUILT = DESCRIBED | {"power": 9.0, "waist": 0.9, "black": 80.0, "water": WATER}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scan of an inclined wall by a sensor other than the described one, and the calibration."""
    folder = tmp_path_factory.mktemp("follow")
    (folder / "described.toml").write_text(SENSOR.format(**DESCRIBED))
    (folder / "built.toml").write_text(SENSOR.format(**BUILT))
    scene = folder / "wall.toml"
    scene.write_text(SCENE.format(start=-65.0, step=13.0, count=11, reflectance=0.8, turn=45.0))
    sensors = {"sensor": folder / "described.toml", "as_built": folder / "built.toml"}
    twin.simulate(scene, **sensors, out=folder / "scan.h5", seed=3)
    uwlts.nominal(folder / "described.toml", medium="water").save(folder / "calibration.json")
    return folder


def test_drawn_values_are_found_and_rendered_again(folder):
    """All estimates are within 5 of their standard uncertainties, and so are those of the rendered scan.

    The stated uncertainties are known to a sixth; with 5 of them, one of 10,000 estimates is outside.
    """
    page = twin.follow(
        folder / "scan.h5", calibration=folder / "calibration.json", scene=folder / "wall.toml", out=folder / "runs"
    )
    found = {each.name: each for each in read_estimates(folder / "runs" / "followed.json")}
    true = {
        "power_reflectance_mw": 9.0 * 0.8,
        "attenuation_per_m": 1.1,
        "scattering_per_m": 0.5,
        "sheet_radius_mm": 0.9,
    }
    for name, value in true.items():
        assert abs(found[name].value - value) < 5 * found[name].std, name
        assert found[name].std < 0.15 * value, name
    assert "gain_dn_per_e" not in found
    again = {each.name: each for each in read_estimates(folder / "runs" / "rendered.json")}
    for name in true:
        assert abs(again[name].value - found[name].value) < 5 * (again[name].std + found[name].std), name
    sensor = uwlts.load_sensor(folder / "runs" / "followed.toml")
    assert sensor.laser.power_mw == pytest.approx(found["power_reflectance_mw"].value / 0.8)
    assert sensor.medium("water").scattering_per_m == pytest.approx(found["scattering_per_m"].value)
    text = page.read_text(encoding="utf-8")
    assert "Not explained" in text and "scan.h5" in text and "rendered.h5" in text


def test_flat_surface_does_not_separate_attenuation_and_power(folder, tmp_path):
    scene = tmp_path / "flat.toml"
    scene.write_text(SCENE.format(start=-65.0, step=13.0, count=6, reflectance=0.8, turn=0.0))
    twin.simulate(scene, sensor=folder / "described.toml", out=tmp_path / "flat.h5")
    found = uwlts.fit_radiometry(tmp_path / "flat.h5", folder / "calibration.json")
    assert any(text.startswith("attenuation and laser power") for text in found.not_separable)
    assert found.outlook.attenuation_per_m is None
    assert found.outlook.reach_mm > 0


def test_wrong_input_is_refused(folder, tmp_path, capsys, monkeypatch):
    calibration = folder / "calibration.json"
    with pytest.raises(DescriptionError, match="reflectance is 0"):
        uwlts.fit_radiometry(folder / "scan.h5", calibration, reflectance=0.0)
    with pytest.raises(CaptureError, match="give the result beside it"):
        uwlts.fit_radiometry(folder / "scan.h5", calibration, compared_with=tmp_path / "old.toml")
    words = ["radiometry", folder / "scan.h5", "--calibration", calibration, "--out", tmp_path / "a.toml"]
    monkeypatch.setattr("sys.argv", ["uwlts", *map(str, words), "--page", str(tmp_path / "a.html")])
    assert run(app) == 2 and "--earlier-capture" in capsys.readouterr().err
    assert not (tmp_path / "a.toml").exists()
