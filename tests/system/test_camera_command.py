"""`uwlts camera`: a folder of photographs becomes a camera that `uwlts import` reads, and a page with every image."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tests.oracles import drawings
from tests.system.in_process import uwlts
from tests.system.test_imported_calibration import CENTRE, CHESSBOARD, SIZE, F, photographs, poses
from uwlts.storage.import_.camera_files import read_intrinsics
from uwlts.storage.mount_files import read_mount

TARGET = 'kind = "chessboard"\ncolumns = 9\nrows = 6\nsquare_mm = 15.0\n'


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Photographs of a chessboard, one with a stripe across, one of nothing, one truncated, one of another size."""
    folder, rng = tmp_path_factory.mktemp("photographs"), np.random.default_rng(2)
    for number, pose in enumerate(poses(CHESSBOARD)):
        plain, lasered = photographs(CHESSBOARD, *pose, rng)
        cv2.imwrite(str(folder / f"board{number}.png"), lasered if number == 3 else plain)
    cv2.imwrite(str(folder / "nothing.png"), np.full(SIZE[::-1], 90, np.uint8))
    cv2.imwrite(
        str(folder / "a-large.png"),
        cv2.resize(photographs(CHESSBOARD, *poses(CHESSBOARD)[0], rng)[0], None, fx=2, fy=2),
    )
    (folder / "truncated.png").write_bytes((folder / "board0.png").read_bytes()[:5000])
    return folder


def test_photographs_give_the_camera_and_name_what_was_left_out(folder: Path, tmp_path: Path):
    (tmp_path / "board.toml").write_text(TARGET)
    out = tmp_path / "camera.yaml"
    done = uwlts("camera", str(folder), "--target", str(tmp_path / "board.toml"), "--out", str(out))
    assert done.returncode == 0, done.stderr
    known, estimated = read_intrinsics(out), yaml.safe_load(out.read_text())["estimated"]
    std = dict(zip(estimated["parameters"], estimated["standard_uncertainties"], strict=True))
    assert known.size_px == SIZE and "f" in std
    # Drawn without distortion; four standard uncertainties.
    assert known.fx_px == known.fy_px == pytest.approx(F, abs=4 * std["f"])
    assert (known.cx_px, known.cy_px) == (
        pytest.approx(CENTRE[0], abs=4 * std["cx"]),
        pytest.approx(CENTRE[1], abs=4 * std["cy"]),
    )
    assert std["f"] < 3e-3 * F
    assert estimated["images"] == [f"board{number}.png" for number in range(8)]
    for name, reason in {
        "nothing.png": "found no chessboard of 9 x 6 inner corners",
        "a-large.png": f"pixels; most images have {SIZE[0]} x {SIZE[1]}",
        "truncated.png": "truncated or damaged",
    }.items():
        assert reason in estimated["left_out"][name] and f"warning: {name}: " in done.stderr
    page = out.with_suffix(".html").read_text()
    assert page.count("<img") == 8 + 2, "every image that can be read is shown"
    # A second time it refuses to replace what it wrote.
    again = uwlts("camera", str(folder), "--target", str(tmp_path / "board.toml"), "--out", str(out))
    assert again.returncode != 0 and "exists" in again.stderr


def test_photographs_give_the_mount_of_a_camera_without_a_laser(folder: Path, tmp_path: Path):
    mount, target = (np.eye(4) for _ in range(2))
    mount[:3, :3], mount[:3, 3] = Rotation.from_euler("xyz", (10, -35, 80), degrees=True).as_matrix(), (40, -25, 110)
    target[:3, :3], target[:3, 3] = Rotation.from_euler("xyz", (170, 5, -10), degrees=True).as_matrix(), (700, 100, 50)
    names, at = sorted(path.name for path in folder.glob("*.png")), {}
    for number, (rotation, translation) in enumerate(poses(CHESSBOARD)):
        seen = np.eye(4)
        seen[:3, :3], seen[:3, 3] = rotation, translation
        at[f"board{number}.png"] = target @ np.linalg.inv(seen) @ np.linalg.inv(mount)
    rows = [at.get(name, np.eye(4)).ravel() for name in names]
    np.savetxt(tmp_path / "poses.csv", rows, delimiter=",")
    (folder / "target.toml").write_text(TARGET)
    asked = ("mount", str(folder), str(tmp_path / "poses.csv"), "--out", str(tmp_path / "mount.json"))
    refused, done = uwlts(*asked, "--radius-mm", "20"), uwlts(*asked)
    np.savetxt(tmp_path / "poses.csv", rows[1:], delimiter=",")
    fewer = uwlts(*asked, "--overwrite")
    (folder / "target.toml").unlink()
    assert refused.returncode == 2 and "photographs of a target need poses, and nothing else" in refused.stderr
    assert fewer.returncode == 2 and "found 10 poses for 11 images" in fewer.stderr
    assert done.returncode == 0, done.stderr
    found = read_mount(tmp_path / "mount.json")
    assert {pose.name: pose.reason is None for pose in found.poses} == {name: name in at for name in names}
    # The robot is exact, but not known to be: four standard uncertainties, which contain those of the lens.
    turn = Rotation.from_matrix(found.transform()[:3, :3] @ mount[:3, :3].T).as_rotvec()
    error = np.append(found.transform()[:3, 3] - mount[:3, 3], turn)
    assert (np.abs(error) < 4 * found.std()).all()
    assert (np.abs(error[:3]) < 1.0).all() and np.degrees(np.abs(error[3:])).max() < 0.3


def test_a_channel_that_is_none_is_refused(folder: Path, tmp_path: Path):
    (folder / "target.toml").write_text(TARGET)
    done = uwlts("camera", str(folder), "--out", str(tmp_path / "camera.yaml"), "--channel", "infrared")
    (folder / "target.toml").unlink()
    assert done.returncode != 0 and "channel is 'infrared': expected red, green" in done.stderr


@pytest.mark.parametrize(
    ("target", "message"),
    [
        (None, "no description of the target"),
        (TARGET.replace("9", "7"), "the target was found in 0 of 3 images"),
        ('kind = "chess"', "kind is one of"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(folder: Path, tmp_path: Path, target: str | None, message: str):
    # Searching an image without the target takes longest.
    (tmp_path / "images").mkdir()
    for number in range(3):
        shutil.copy(folder / f"board{number}.png", tmp_path / "images")
    words = ["camera", str(tmp_path / "images"), "--out", str(tmp_path / "camera.yaml")]
    if target is not None:
        (tmp_path / "board.toml").write_text(target)
        words += ["--target", str(tmp_path / "board.toml")]
    done = uwlts(*words)
    assert done.returncode != 0 and message in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "camera.yaml").exists()


def test_a_polynomial_for_a_wide_lens_names_the_lens(tmp_path: Path):
    """As the documentation prints it; without the option the model follows the lens."""
    centre, rng = (281.3, 222.2), np.random.default_rng(4)
    for number, turns in enumerate([(10, -20, 8), (-18, 12, -10), (20, 15, 95), (-10, -22, 185), (4, 3, 40)]):
        place = drawings.pose(turns, (0.0, 0.0, 150.0))
        place[:3, 3] -= place[:3, :3] @ [140.0, 80.0, 0.0]
        board, rays = drawings.chessboard(15, 9, 20.0), drawings.equidistant(250.0, centre)
        image = drawings.draw(board, rays, place, size=(560, 448), rng=rng, samples=2)
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    (tmp_path / "target.toml").write_text('kind = "chessboard"\ncolumns = 15\nrows = 9\nsquare_mm = 20.0\n')
    out = tmp_path / "camera.yaml"
    done = uwlts("camera", str(tmp_path), "--out", str(out), "--distortion", "k1", "k2")
    assert (
        done.returncode == 0 and "this is a wide-angle lens, which bends straight lines more than k1 k2" in done.stderr
    )
    done = uwlts("camera", str(tmp_path), "--out", str(out), "--overwrite")
    assert done.returncode == 0 and "wide-angle" not in done.stderr
    known = read_intrinsics(out)
    assert known.distortion.is_rational() and known.fx_px == pytest.approx(250.0, abs=0.5)
    assert (known.cx_px, known.cy_px) == pytest.approx(centre, abs=0.5)
