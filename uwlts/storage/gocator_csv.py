"""CSV files of LMI Gocator sensors: sections with a name, rows of names and values, and a line End.

The sections are described in the Gocator user manual ("CSV converter tool") and that of GoPxL ("CSV File Format").
Lengths are in mm.
"""

from pathlib import Path

import numpy as np

from uwlts.errors import DescriptionError

_SECTIONS = ("Profile", "RawProfile", "Part", "Surface", "SurfacePointCloud")
_FRAME, _AXIS, _Y = "Frame", "Axis", "Y"


def is_gocator_csv(content: bytes) -> bool:
    """Return whether a table is such a file, by the name of its first section."""
    return content[:20].split(b"\n")[0].strip(b" ,\r") == b"Info" and b"\nEnd" in content


def read_gocator_csv(content: bytes, path: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """Read the points of all profiles, or of the surface, as columns (N,), and notes.

    The columns are x, y, z, intensity and, for profiles, pose (the frame). Missing points are NaN. Raises
    DescriptionError if there is no such section, or it is damaged.
    """
    sections = _sections(content.decode("latin-1").splitlines())
    for name in _SECTIONS:
        if (rows := sections.get(name)) is None:
            continue
        try:
            match name:
                case "Profile" | "RawProfile":
                    columns = _read_profiles(rows[2:])
                case "SurfacePointCloud":
                    columns = _read_points(rows[3:])
                case _:
                    columns = _read_surface(rows[2:])
            offsets = {n: float(v) for n, v in zip(rows[0], rows[1], strict=False) if n.endswith("Offset") and float(v)}
        except (ValueError, IndexError, KeyError, StopIteration) as error:
            raise DescriptionError(f"{path}: the section {name} is damaged or incomplete: {error}") from error
        notes = [f"read the section {name} of a Gocator's CSV file"]
        notes += [f"offsets are not added: {', '.join(f'{n} {v:g} mm' for n, v in offsets.items())}"] if offsets else []
        return columns, notes
    raise DescriptionError(
        f"{path} is a Gocator's CSV file with the sections {', '.join(sections)}; this reads {', '.join(_SECTIONS)}"
    )


def _sections(lines: list[str]) -> dict[str, list[list[str]]]:
    """Return the cells of the rows of each section."""
    found: dict[str, list[list[str]]] = {}
    rows: list[list[str]] | None = None
    for line in lines:
        cells = [cell.strip() for cell in line.split(",")]
        if cells[0] == "End":
            rows = None
        elif rows is None:
            rows = found.setdefault(cells[0], []) if cells[0] else None
        elif any(cells):
            rows.append(cells)
    return found


def _read_profiles(rows: list[list[str]]) -> dict[str, np.ndarray]:
    names = rows[0]
    frame, axis, y = names.index(_FRAME), names.index(_AXIS), names.index(_Y)
    first = axis + 1
    profiles: dict[tuple[str, str], dict[str, np.ndarray]] = {}
    for row in rows[1:]:
        if len(row) != len(names):
            raise ValueError(f"a row has {len(row)} cells, the names {len(names)}")
        profiles.setdefault((row[frame], row[frame + 1]), {_Y: _numbers([row[y]])})[row[axis]] = _numbers(row[first:])
    parts: list[list[np.ndarray]] = []
    for (number, _), profile in profiles.items():
        z = profile["Z"]
        x = profile["X"] if "X" in profile else _numbers(names[first:])
        intensity = profile.get("I", np.full(len(z), np.nan))
        parts.append([x, np.full(len(z), profile[_Y][0]), z, intensity, np.full(len(z), float(number))])
    if not parts:
        raise ValueError("it has no profiles")
    return dict(zip(("x", "y", "z", "intensity", "pose"), map(np.concatenate, zip(*parts, strict=True)), strict=True))


def _read_surface(rows: list[list[str]]) -> dict[str, np.ndarray]:
    x = _numbers(rows[0][1:])
    table = [_numbers(row) for row in rows[1:]]
    if not table or any(len(row) != 1 + len(x) for row in table):
        raise ValueError(f"expected rows of a Y value and {len(x)} ranges")
    numbers = np.array(table)
    return {"x": np.tile(x, len(table)), "y": np.repeat(numbers[:, 0], len(x)), "z": numbers[:, 1:].ravel()}


def _read_points(rows: list[list[str]]) -> dict[str, np.ndarray]:
    """Read rows of x, y and z of one point after the other; a comma may end a row."""
    parts = [_numbers(row[:-1] if len(row) % 3 == 1 and not row[-1] else row) for row in rows]
    if wrong := next((len(part) for part in parts if len(part) % 3), 0):
        raise ValueError(f"a row has {wrong} cells; expected x, y and z of each point")
    return dict(zip("xyz", np.concatenate(parts).reshape(-1, 3).T, strict=True))


def _numbers(cells: list[str]) -> np.ndarray:
    return np.array([float(cell) if cell else np.nan for cell in cells])
