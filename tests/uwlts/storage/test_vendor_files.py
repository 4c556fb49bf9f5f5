"""Files of other makers: CSV of scanCONTROL sensors."""

from pathlib import Path

import numpy as np
import pytest

import uwlts
from uwlts.storage.cloud_files import read_cloud

BLOCK = "scanCONTROL 2950-100\nSerial number{0}218020023\nMeasuring range{0}100{0}mm\n\nDate{0}12.03.2024 10:11\n"
ROWS = [[0.5 * i, 0.25 * p, 90 + 0.125 * i, 300 + i] for p in range(3) for i in range(20)]


@pytest.mark.parametrize("mark", ";,\t")
@pytest.mark.parametrize("decimal", ".,")
@pytest.mark.parametrize(
    ("names", "scale"),
    [
        ("Profile X-Value[mm] Y-Value[mm] Z-Value[mm] Intensity", 1.0),
        ("Profile X/um Y/um Z/um Intensity", 1e-3),
        ("Profile X Y Z Intensity", 1.0),
    ],
)
def test_lines_before_the_names_of_columns_are_said_and_omitted(
    tmp_path: Path, mark: str, decimal: str, names: str, scale: float
):
    if mark == decimal:
        return
    rows = ["0 " + " ".join(map(str, row)) for row in ROWS]
    text = "\n".join([names, *rows]).replace(".", decimal).replace(" ", mark)
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "a.csv").write_text(BLOCK.format(mark) + text, encoding=encoding)
        cloud = read_cloud(tmp_path / "a.csv")
        assert np.allclose(cloud.points_mm, scale * np.array(ROWS)[:, :3], rtol=1e-15)
        assert cloud.intensity.tolist() == [row[3] for row in ROWS]
        assert "lines before the names of columns are omitted (4): scanCONTROL 2950-100" in cloud.warnings[0]


@pytest.mark.parametrize("line", ["Unit;m", "# units = [m]", "// Length unit: metres", "Unit,m"])
@pytest.mark.parametrize("names", ["X;Y;Z", ""])
def test_a_line_beside_a_table_may_state_the_unit(tmp_path: Path, line: str, names: str):
    if not names and line[0] not in "#/":
        return
    rows = "\n".join(";".join(map(str, row[:3])) for row in ROWS)
    (tmp_path / "a.csv").write_text(f"{line}\n{names}\n{rows}\n")
    assert np.array_equal(read_cloud(tmp_path / "a.csv").points_mm, 1000 * np.array(ROWS)[:, :3])
    assert np.array_equal(read_cloud(tmp_path / "a.csv", unit="m").points_mm, read_cloud(tmp_path / "a.csv").points_mm)
    with pytest.raises(uwlts.Error, match="states m, but the unit mm was given"):
        read_cloud(tmp_path / "a.csv", unit="mm")
    (tmp_path / "a.csv").write_text(f"{line}\nX [mm];Y [mm];Z [mm]\n{rows}\n")
    with pytest.raises(uwlts.Error, match="names columns in mm, and states the unit m"):
        read_cloud(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(f"# unit: mm\n{line}\nX;Y;Z\n{rows}\n")
    assert "may state another unit" in " ".join(read_cloud(tmp_path / "a.csv").warnings)


def test_rows_that_are_counted_need_names(tmp_path: Path):
    text = "".join(f"{number} {row[0]} {row[1]} {row[2]}\n" for number, row in enumerate(ROWS, start=1))
    (tmp_path / "a.xyz").write_text(text)
    with pytest.raises(uwlts.Error, match="counts its rows in the first column: name the columns"):
        read_cloud(tmp_path / "a.xyz")
    (tmp_path / "a.xyz").write_text(f"n x y z\n{text}")
    assert np.array_equal(read_cloud(tmp_path / "a.xyz").points_mm, np.array(ROWS)[:, :3])


def test_profiles_without_positions_and_repeated_names_are_refused(tmp_path: Path):
    rows = "\n".join(";".join(map(str, row[:3])) for row in ROWS)
    (tmp_path / "a.csv").write_text(f"scanCONTROL\nProfile;X;Z\n{rows}\n")
    with pytest.raises(uwlts.Error, match="expected x, y and z"):
        read_cloud(tmp_path / "a.csv")
    (tmp_path / "a.csv").write_text(f"scanCONTROL\nX;Y;Z\n{rows}\nX;Y;Z\n{rows}\n")
    with pytest.raises(uwlts.Error, match="no table of numbers"):
        read_cloud(tmp_path / "a.csv")
