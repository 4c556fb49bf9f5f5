"""Errors of inspections of rendered scans; `docs/studies/prediction.py` has the probability of detection.

    python docs/studies/inspection.py FOLDER [--write]

Renders the scenes of `inspection_scenes.py` by two draws of sensor, noise, pits and welds, calibrates jointly, and
compares with the closed form: values of inspections, and false claims of change.
"""

from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from cyclopts import App
from inspection_scenes import (
    AXIS_Z_MM,
    DIAMETER_MM,
    OVALITY,
    SIDES_DEG,
    WATERS,
    Pits,
    cloud_of,
    large_pits,
    record,
    small_pits,
)
from result_tables import publish, table
from scipy.spatial.transform import Rotation

import uwlts
from twin.scene.description import load_scene
from twin.scene.forms import Weld
from twin.scene.forms.parts import weld_height
from uwlts.inspection.features import Feature, FeatureKind, Inspection
from uwlts.storage.capture_writer import CaptureWriter

HOLLOWS = FeatureKind.PIT, FeatureKind.DENT
BLEMISHES = *HOLLOWS, FeatureKind.PROTRUSION
HEAD = ["of", "value", "number", "spread", "truth within the 95 % interval"]
DRAWS = 0, 5
SHOWN = ("depth", "length", "lost area", "diameter", "ovality", "height", "width", "largest undercut")
"""Values in the table."""
PICTURE = Path(__file__).parents[1] / "pictures" / "inspection-pits.png"
Pairs = list[tuple[Feature, dict[str, float]]]


def around(folder: Path, water: str) -> uwlts.PointCloud:
    """The pipe from six sides as one scan with known poses, in the pipe's frame."""
    joined = folder / water / "pipe-around.h5"
    if not joined.exists():
        with uwlts.read(folder / water / f"pipe-side-{SIDES_DEG[0]}.h5") as first:
            header, kind = first.header, first.dtype
        time_s = 0.0
        with CaptureWriter(joined, header, dtype=kind) as writer:
            for side in SIDES_DEG:
                with uwlts.read(folder / water / f"pipe-side-{side}.h5") as capture:
                    for frame in capture:
                        pose = np.eye(4)
                        pose[:3, :3] = Rotation.from_euler("x", -side, degrees=True).as_matrix()
                        at = frame.stage_mm * np.array(capture.header.stage_direction) - [0.0, 0.0, AXIS_Z_MM]
                        pose[:3, 3] = pose[:3, :3] @ at
                        time_s += 1.0
                        writer.append(replace(frame, pose=pose, time_s=time_s))
    return cloud_of(folder, water, "pipe-around")


def distances(pits: Pits, places: np.ndarray) -> np.ndarray:
    """Distances (..., P) of places (..., 3) in the scene from the pits' middles, along the surface, in mm."""
    x, y, z = np.moveaxis(places, -1, 0)[..., None]
    return np.hypot(pits.along - x, pits.around - DIAMETER_MM / 2 * np.arctan2(y, AXIS_Z_MM - z))


def matched(found: Inspection, pits: Pits) -> list[Feature | None]:
    """Return the feature at each pit (None if there is no feature), the deepest of several."""
    result: list[Feature | None] = [None] * len(pits.depth)
    for feature in reversed(found.select(*HOLLOWS)):
        away = distances(pits, feature.place_mm)
        nearest = int(np.argmin(away / pits.diameter))
        if away[nearest] < pits.diameter[nearest] / 2 + 0.5:
            result[nearest] = feature
    return result


def false_ones(found: Inspection, pits: Pits) -> int:
    """Count the features outside all pits."""
    return sum(
        bool(np.all(distances(pits, each.place_mm) > pits.diameter / 2 + 0.5)) for each in found.select(*BLEMISHES)
    )


def true_values(diameter: float, depth: float, edge: float) -> dict[str, float]:
    """Values of a pit depth (1 - t^2)^2 within the contour of an edge's depth."""
    t = np.sqrt(1 - np.sqrt(min(edge / depth, 1.0)))
    radius = diameter / 2
    lost = 2 * depth * radius * (t - 2 * t**3 / 3 + t**5 / 5)
    return {
        "depth": depth,
        "length": 2 * radius * t,
        "width": 2 * radius * t,
        "area": np.pi * (radius * t) ** 2,
        "lost area": lost,
    }


def figure_rows(name: str, pairs: Pairs) -> list[list[str]]:
    """Rows of a table of errors: value, number, bias, spread, mean standard uncertainty, coverage."""
    rows = []
    for value in SHOWN:
        known = [(feature[value], truth[value]) for feature, truth in pairs if value in feature and value in truth]
        if not known:
            continue
        error = np.array([each.value - truth for each, truth in known])
        inside = sum(each.low <= truth <= each.high for each, truth in known)
        rows.append([name, value, f"{len(known)}", f"{error.std():.4f}", f"{inside} of {len(known)}"])
    return rows


def true_weld(weld: Weld) -> dict[str, float]:
    """Values of a weld by their definitions, from its closed form on a fine grid."""
    x, y = np.arange(-24.5, 24.6, 0.25), np.arange(-15, 15, 0.005)
    sections = np.array([weld_height(weld, np.full(len(y), at), y) for at in x])
    toes, angles = [], []
    for section in sections:
        top, peak = section.max(), int(np.argmax(section))
        ends, slopes = [], []
        for half, sign in ((np.arange(peak, -1, -1), -1), (np.arange(peak, len(y)), 1)):
            at = [y[half[int(np.argmax(section[half] < share * top))]] for share in (0.5, 0.1)]
            slope = 0.4 * top / abs(at[1] - at[0])
            ends.append(at[1] + sign * 0.1 * top / slope)
            slopes.append(180 - np.degrees(np.arctan(slope)))
        toes.append(ends[1] - ends[0])
        angles.append(slopes)
    left, right = np.median(angles, axis=0)
    undercuts = dict.fromkeys(("undercut left", "undercut right", "largest undercut"), weld.undercut_depth_mm)
    crest = sections.max(axis=1)
    # A section is as long as the distance between profiles, 1 mm; this is the mean of three sections.
    highest = float(np.convolve(crest, np.full(12, 1 / 12), "valid").max())
    sizes = {"height": float(crest.mean()), "largest height": highest, "width": float(np.median(toes))} | undercuts
    return sizes | {"toe angle left": left, "toe angle right": right, "misalignment": 0.0}


def pit_pairs(found: list[Feature | None], pits: Pits, chosen: np.ndarray) -> Pairs:
    """Return features and true values of the found pits among those chosen, (P,) bool."""
    return [
        (each, true_values(diameter, depth, each["edge depth"].value))
        for each, diameter, depth, one in zip(found, pits.diameter, pits.depth, chosen, strict=True)
        if each is not None and one
    ]


def pits_in(folder: Path, water: str, draw: int) -> dict[str, Pairs]:
    """Return found and true values of small and large pits by their diameters; false indications are printed."""
    small, large = small_pits(draw), large_pits(draw)
    inspected = uwlts.inspect_pipe(cloud_of(folder, water, "pipe-after"))
    corroded = uwlts.inspect_pipe(cloud_of(folder, water, "pipe-corroded"), wall_mm=9.5)
    plain = uwlts.inspect_pipe(cloud_of(folder, water, "pipe-before"))
    false = false_ones(inspected, small), false_ones(corroded, large), len(plain.select(*BLEMISHES))
    print(f"{water}, {draw}: indications that are no pit: small, large, none: {false}; {inspected.notes[-1]}")
    found = matched(inspected, small)
    pairs = {
        f"pits, {diameter:g} mm wide, 0.1 to 0.4 mm deep": pit_pairs(
            found, small, (small.diameter == diameter) & (small.depth > 0.1)
        )
        for diameter in np.unique(small.diameter)
    }
    chosen = pit_pairs(matched(corroded, large), large, large.diameter >= 10)
    return pairs | {"pits, 10 to 24 mm wide, 0.4 to 5 mm deep": chosen}


def wholes_in(folder: Path, water: str) -> dict[str, Pairs]:
    """Return found and true values of the pipe from six sides, and of welds."""
    pipe = uwlts.inspect_pipe(around(folder, water))
    truth = {"diameter": DIAMETER_MM, "ovality": DIAMETER_MM * OVALITY}
    pairs: dict[str, Pairs] = {"pipe from six sides": [(pipe.features[0], truth)], "welds": []}
    for path in sorted(folder.glob(f"weld*-{water}.toml")):
        weld = load_scene(str(path)).objects[0]
        assert isinstance(weld, Weld)
        found = uwlts.inspect_weld(cloud_of(folder, water, path.stem.removesuffix(f"-{water}")))
        pairs["welds"].append((found.features[0], true_weld(weld)))
    return pairs


def unchanged_rows(folder: Path, water: str, draw: int) -> list[list[str]]:
    """Return rows of false claims of change, outside the pits."""
    before, rows = cloud_of(folder, water, "pipe-before"), []
    for name, pits in (("pipe-after", small_pits(draw)), ("pipe-corroded", large_pits(draw))):
        change = uwlts.compare_clouds(cloud_of(folder, water, name), before, same_water=True)
        reach = pits.diameter / 2 + change.disc_mm / 2
        clear = change.compared & np.all(distances(pits, change.points_mm) > reach, axis=1)
        share = f"{100 * float(change.significant[clear].mean()):.1f} %"
        pit = "small" if name == "pipe-after" else "large"
        rows.append([f"{draw}", water, pit, share])
    return rows


def main(folder: Path, *, write: bool = False) -> None:
    """Render and print the tables; with `--write`, put them into their pages, and draw the picture."""
    pairs: dict[str, Pairs] = {}
    changes = []
    for draw in DRAWS:
        own = folder / str(draw)
        record(own, draw)
        for water in WATERS:
            for name, some in (pits_in(own, water, draw) | wholes_in(own, water)).items():
                pairs.setdefault(name, []).extend(some)
            changes += unchanged_rows(own, water, draw)
    head = ["draw", "water", "pits", "claimed"]
    tables = {"inspected values": table(HEAD, [row for name, some in pairs.items() for row in figure_rows(name, some)])}
    tables["changes of rendered pipes"] = table(head, changes)
    publish(tables, write=write)
    if write:
        draw_map(folder / str(DRAWS[0]), PICTURE)


def draw_map(folder: Path, path: Path) -> None:
    """The corroded pipe unrolled, with the pits that were found and their depths."""
    cloud = cloud_of(folder, "coastal", "pipe-corroded")
    found = uwlts.inspect_pipe(cloud, wall_mm=9.5)
    x, y, z = cloud.points_mm[::2].T
    figure, ax = plt.subplots(figsize=(9, 4.4), layout="constrained")
    colours = ax.scatter(
        DIAMETER_MM / 2 * np.arctan2(y, AXIS_Z_MM - z),
        x,
        c=found.deviation_mm[::2],
        s=5,
        cmap="magma",
        vmin=-3,
        vmax=0.2,
        linewidths=0,
    )
    for feature in found.select(*BLEMISHES):
        x, y, z = feature.place_mm
        depth = feature["depth"]
        text = f"{depth.value:.2f} ± {0.5 * (depth.high - depth.low):.2f}"
        at = DIAMETER_MM / 2 * np.arctan2(y, AXIS_Z_MM - z), x
        ax.annotate(
            text,
            at,
            (at[0], at[1] + 0.55 * feature.extent_mm[0] + 1),
            ha="center",
            color="#1d6fb8",
            fontsize=8,
            fontweight="bold",
        )
        ax.add_patch(
            plt.Rectangle(
                (at[0] - feature.extent_mm[1] / 2, at[1] - feature.extent_mm[0] / 2),
                *feature.extent_mm[[1, 0]],
                fill=False,
                color="#1d6fb8",
            )
        )
    figure.colorbar(colours, label="distance from the undamaged pipe / mm")
    ax.set(
        xlabel="around the pipe / mm",
        ylabel="along the pipe / mm",
        aspect="equal",
        title="Pits found in coastal water, depth and half its 95 % interval / mm",
    )
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
