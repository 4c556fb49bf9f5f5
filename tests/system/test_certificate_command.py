"""The command that writes and checks certificates, on a calibration of views made by Fermat's principle."""

import json
import shutil
import subprocess
from contextlib import chdir
from pathlib import Path

import pytest

from tests.system.in_process import uwlts
from tests.uwlts.joint_views import joint_calibration

pytestmark = pytest.mark.slow


def run(*arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    with chdir(folder):
        return uwlts(*arguments)


@pytest.fixture(scope="module")
def calibration(thesis, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("certificates") / "calibration.json"
    joint_calibration(thesis, columns=15).save(path)
    return path


@pytest.fixture
def folder(calibration, tmp_path) -> Path:
    shutil.copy(calibration, tmp_path)
    return tmp_path


def test_a_certificate_is_written_and_checked(folder: Path):
    done = run("certificate", "calibration.json", folder=folder)
    assert done.returncode == 0, done.stderr
    assert "expanded uncertainty (k = 2)" in done.stdout
    assert "next: an image of the target in water" in done.stdout
    page = (folder / "calibration.certificate.html").read_text(encoding="utf-8")
    content = json.loads((folder / "calibration.certificate.json").read_text(encoding="utf-8"))
    assert content["sha256"] in page
    assert content["lengths"] and content["cannot_tell"] and content["next_shots"]
    checked = run("certificate", "calibration.json", "--check", "calibration.certificate.json", folder=folder)
    assert (checked.returncode, checked.stderr) == (0, "")
    assert "is unchanged, and belongs to calibration.json" in checked.stdout


def test_changes_are_found(folder: Path):
    assert run("certificate", "calibration.json", folder=folder).returncode == 0
    path = folder / "calibration.json"
    path.write_text(path.read_text(encoding="utf-8").replace('"thesis"', '"theses"', 1), encoding="utf-8")
    checked = run("certificate", "calibration.json", "--check", "calibration.certificate.json", folder=folder)
    assert checked.returncode == 1
    assert "is not the calibration certified by calibration.certificate.json" in checked.stdout


def test_nothing_is_replaced_unasked_nor_the_calibration_at_all(folder: Path):
    before = (folder / "calibration.json").read_bytes()
    own = run("certificate", "calibration.json", "--out", "calibration.html", "--overwrite", folder=folder)
    assert own.returncode == 2
    assert "it is an input of this command" in own.stderr
    (folder / "cert.json").write_text("{}", encoding="utf-8")
    there = run("certificate", "calibration.json", "--out", "cert.html", folder=folder)
    assert there.returncode == 2
    assert "cert.json exists already" in there.stderr
    assert not (folder / "cert.html").exists()
    assert (folder / "calibration.json").read_bytes() == before


def test_beside_another_calibration_and_without_a_joint_estimate(folder: Path):
    assert run("nominal", "thesis", "--medium", "water", "--out", "nominal.json", folder=folder).returncode == 0
    done = run("certificate", "calibration.json", "--before", "nominal.json", "--out", "cert.html", folder=folder)
    assert done.returncode == 0, done.stderr
    assert "Comparison with nominal.json" in (folder / "cert.html").read_text(encoding="utf-8")
    plain = run("certificate", "nominal.json", folder=folder)
    assert plain.returncode == 2
    assert "calibrate jointly" in plain.stderr
    assert not list(folder.glob("nominal.certificate.*"))
    wrong = run("certificate", "nominal.json", "--check", "nominal.json", folder=folder)
    assert wrong.returncode == 2
    assert "is JSON but not a certificate" in wrong.stderr
