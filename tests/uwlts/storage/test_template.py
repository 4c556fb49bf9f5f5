"""Templates of import descriptions: what images show, questions for the rest, and an import after the answers."""

import re
import shutil
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest

import twin
from twin.scene.description import load_scene
from uwlts.errors import DescriptionError, ImageError, OutputError
from uwlts.storage.import_.folder import import_images
from uwlts.storage.import_.template import write_template

DATA = Path(__file__).parents[2] / "data"
ANSWERS = {
    "medium": '"air"',
    "pixel_size_um": "5.3",
    "focal_length_mm": "12.5",
    "focus_distance_mm": "190.0",
    "window.mounted": "false",
    "origin_mm": "[-120.0, 0.0, 0.0]",
    "axis": "[120.0, 0.0, 190.0]",
    "waist_distance_mm": "225.0",
    "wavelength_nm": "635.0",
    "near_mm": "60.0",
    "far_mm": "280.0",
    "square_mm": "10.0",
    "margin_mm": "60.0",
    "pitch_mm": "9.375",
    "diameter_mm": "5.0",
    "step_mm": "0.5",
    "direction": "[1.0, 0.0, 0.0]",
    "bits": "12",
}


def answered(path: Path) -> dict:
    """Replace all questions of a description; return its content."""
    text = re.sub(r'^([\w.]+) = "\?"', lambda found: f"{found[1]} = {ANSWERS[found[1]]}", path.read_text(), flags=re.M)
    path.write_text(text)
    return tomllib.loads(text)


def test_board_and_line_in_one_image(tmp_path: Path):
    """Photographs by others, whose laser was on the left."""
    folder = tmp_path / "etna"
    folder.mkdir()
    for number in (1, 2, 3, 4, 5, 7):
        shutil.copy(DATA / "etna" / f"frame{number:04}.jpg", folder)
    text = write_template(folder).read_text()
    assert "6 of 1280 x 1024 pixels, uint8, grey, numbered 1 to 7; 1 file is missing" in text
    assert "As the laser is left of the camera" in text
    given = answered(folder / "import.toml")
    assert given["laser"] == given["lamp"] == ["frame????.jpg"]
    assert given["stage"] == {"free": True}
    assert given["sensor"]["camera"]["stripe_along"] == "height"
    assert given["target"].items() >= {"kind": "chessboard", "columns": 7, "rows": 6}.items()
    imported = import_images(folder, tmp_path / "etna.h5")
    assert (imported.laser, imported.lamp) == (6, 6)


def test_line_with_its_background_in_colour(tmp_path: Path):
    folder = tmp_path / "bust"
    shutil.copytree(DATA / "ciclop" / "bust", folder)
    write_template(folder)
    given = answered(folder / "import.toml")
    assert given["laser"] == ["laser_x???_y?.png"]
    assert given["background"] == ["laser-background_x???_y?.png"]
    assert given["channel"] == "red"
    assert "target" not in given
    assert import_images(folder, tmp_path / "bust.h5").laser == 1


def test_photographs_of_a_board_alone(tmp_path: Path):
    folder = tmp_path / "board"
    folder.mkdir()
    for file in sorted((DATA / "ciclop" / "chessboard").iterdir())[:4]:
        image = cv2.imread(str(file))
        whole = np.full((1280, 960, 3), 128, np.uint8)
        whole[: image.shape[0], : image.shape[1]] = image
        cv2.imwrite(str(folder / f"{file.name[:7]}.png"), whole)
    text = write_template(folder).read_text()
    assert "No laser line was found" in text
    assert "three equal channels" in text
    given = answered(folder / "import.toml")
    assert given["target"].items() >= {"kind": "chessboard", "columns": 11, "rows": 6}.items()
    assert import_images(folder, tmp_path / "board.h5").lamp == 4


@pytest.mark.slow
def test_rendered_images_with_a_gap(tmp_path: Path):
    """Judge the thresholds, which were chosen on photographs: laser above the camera, 12 bit, circles with marks."""
    motion = {
        "direction": [0.0, 0.0, 1.0],
        "start_mm": -120.0,
        "step_mm": 20.0,
        "count": 6,
        "lights": ["lamp", "laser"],
    }
    recording = twin.render(load_scene("target", motion=motion), as_built="thesis-as-built")
    folder = tmp_path / "photographs"
    folder.mkdir()
    for number, (image, laser_on) in enumerate(zip(recording.images, recording.laser_on, strict=True)):
        if number // 2 != 4:
            name = f"{'laser' if laser_on else 'lamp'}_{number // 2:02}.png"
            cv2.imwrite(str(folder / name), 16 * image.astype(np.uint16))
    text = write_template(folder).read_text()
    assert "numbered 0 to 5; 1 file is missing by the numbers in the names" in text
    assert "As the laser is above the camera" in text
    assert re.search(r"largest grey value found is \d+", text)
    given = answered(folder / "import.toml")
    assert (given["laser"], given["lamp"]) == (["laser_??.png"], ["lamp_??.png"])
    assert given["sensor"]["camera"]["stripe_along"] == "width"
    assert given["target"]["kind"] == "circle grid"
    imported = import_images(folder, tmp_path / "photographs.h5")
    assert (imported.laser, imported.lamp) == (5, 5)


def test_questions_are_named_and_nothing_is_replaced(tmp_path: Path):
    folder = tmp_path / "scan"
    folder.mkdir()
    rows, columns = np.arange(240)[:, None], np.arange(320)
    for number in range(3):
        line = 12 + 200 * np.exp(-(((columns - 150 - 5 * number - rows / 20) / 2) ** 2))
        noisy = np.random.default_rng(number).normal(line, 1).clip(0, 255).astype(np.uint8)
        cv2.imwrite(str(folder / f"scan{number}.png"), noisy)
    path = write_template(folder, tmp_path / "mine.toml")
    text = path.read_text()
    assert "If the laser is left of the camera" in text
    assert "If the laser is right of the camera" in text
    with pytest.raises(DescriptionError, match=r"stage.step_mm.*'\?'"):
        import_images(folder, tmp_path / "scan.h5", description=path)
    path.write_text(text.replace('step_mm = "?"', "step_mm = 0.5").replace('direction = "?"', "direction = [1, 0, 0]"))
    with pytest.raises(DescriptionError) as caught:
        import_images(folder, tmp_path / "scan.h5", description=path)
    for key in ("camera.pixel_size_um", "laser.origin_mm", "camera.window.mounted"):
        assert f"{key}: " in str(caught.value)
    with pytest.raises(OutputError, match="replaces nothing"):
        write_template(folder, path)
    assert path.read_text().count("?") == text.count("?") - 2
    answered(path)
    assert import_images(folder, tmp_path / "scan.h5", description=path).laser == 3


def test_images_of_several_sizes_and_no_folder(tmp_path: Path):
    with pytest.raises(ImageError, match="holds no image"):
        write_template(tmp_path / "missing")
    cv2.imwrite(str(tmp_path / "a1.png"), np.zeros((64, 96), np.uint8))
    cv2.imwrite(str(tmp_path / "b1.png"), np.zeros((96, 64), np.uint8))
    with pytest.raises(ImageError, match=r"64 x 96, 96 x 64|96 x 64, 64 x 96"):
        write_template(tmp_path)
    assert not (tmp_path / "import.toml").exists()
