"""Time and memory of commands on large clouds: ``python -m tests.bench.large_clouds [--write]``, 10^7 points each.

The clouds are two scans of a pipe with pits, made with NumPy only, in files of 24 bytes per point, and a ride.
Each command runs alone in a process of its own.
"""

import tempfile
from pathlib import Path

import numpy as np
from cyclopts import App

from docs.studies.result_tables import publish, table
from tests.bench.streams import RECONSTRUCT, run_alone, write_ride
from tests.oracles.pipes import Bump, scan_pipe
from uwlts.runtime.command_line import show

_RADIUS_MM, _ARC, _NOISE_MM = 57.15, 1.2, 0.02
_POINTS_AT_ONCE = 1_000_000
"""Points of a section of the pipe: the oracle makes several arrays of this size."""
_POINTS_OF_PROFILE = 624
_POINTS_PER_MM2 = 40.0


def main(points: int = 10_000_000, *, write: bool = False) -> int:
    """Print the cost of each command.

    Parameters
    ----------
    points
        Points of each cloud.
    write
        Put the table into its page of docs/results.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seed, cloud in enumerate(("before.ply", "after.ply")):
            _write_pipe(folder / cloud, points, seed=seed)
        write_ride(folder, points // _POINTS_OF_PROFILE)
        commands = (
            (RECONSTRUCT, 4.0),
            ("uwlts export after.ply --out after.laz", 4.0),
            ("uwlts inspect after.ply --wall-mm 9.5 --out after.json", 4.0),
            ("uwlts compare after.ply before.ply --out change.html", 8.0),
            ("uwlts register before.ply after.ply --out both.h5", 8.0),
        )
        missed, rows = 0, []
        for line, limit_gb in commands:
            cost = run_alone(line, folder, limit_gb)
            kept = cost.peak_gb <= cost.limit_gb
            missed += not kept
            memory = f"{cost.peak_gb:.1f} GB", f"{cost.limit_gb:g} GB{'' if kept else ', missed'}"
            rows.append([f"`{line}`", f"{cost.processor_s:.0f} s", *memory])
            show([" ".join(rows[-1])])
    head = ["command", "processor time", "peak memory", "limit"]
    publish({"large clouds": table(head, rows)}, write=write)
    return 1 if missed else 0


def _write_pipe(path: Path, points: int, *, seed: int) -> None:
    """Write a part of a pipe with a pit every 50 mm as PLY; all points are within a window of the angle."""
    rng = np.random.default_rng(seed)
    spacing = 1.0 / np.sqrt(_POINTS_PER_MM2)
    length = points / (_POINTS_PER_MM2 * _ARC * _RADIUS_MM)
    sections = max(1, round(points / _POINTS_AT_ONCE))
    parts = []
    for number in range(sections):
        section = scan_pipe(
            rng,
            axis=(1.0, 0.0, 0.0),
            radius_mm=_RADIUS_MM,
            length_mm=length / sections,
            arc=_ARC,
            spacing_mm=spacing,
            noise_mm=_NOISE_MM,
            bumps=[Bump(along_mm=0.0, angle=0.5 * _ARC, diameter_mm=10.0, height_mm=-1.0)],
            lost=0.0,
        )
        along, angle = section.own_places(section.points_mm)
        size = np.linalg.norm(((section.points_mm - section.shift_mm) @ section.turn)[:, :2], axis=1)
        x = along + (number - 0.5 * (sections - 1)) * length / sections
        parts.append(
            np.stack([x, size * np.sin(angle - 0.5 * _ARC), 400.0 - size * np.cos(angle - 0.5 * _ARC)], axis=1)
        )
    rows = np.concatenate(parts)
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(head.encode() + rows.astype("<f8").tobytes())


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
