"""Twin of a sensor from a scan: its description is fitted to the images, and the scan is rendered again."""

from pathlib import Path

import numpy as np
import tomli_w

from twin.experiments.runner import run_program
from twin.recording.render import simulate
from twin.rendering_options import CPU, Variant
from twin.scene.description import load_scene
from uwlts.errors import CaptureError, OutputError
from uwlts.files.writing import write_atomically
from uwlts.model.sensor import Table
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.storage.capture import Capture, CaptureHeader


def follow(
    capture: str | Path,
    *,
    calibration: str | Path,
    scene: str | Path | None = None,
    placement: str | None = None,
    reflectance: float = 0.8,
    repeats: str | Path | None = None,
    compared_with: str | Path | None = None,
    out: str | Path = "runs/follow",
    spp: int = 16,
    seed: int = 1,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> Path:
    """Fit the description of a sensor and its water to a scan, render the scan with it, and compare both.

    The commands of ``uwlts`` run as separate programs, which share no optics with the twin. They write
    OUT/followed.toml and OUT/followed.json (`uwlts radiometry`). Without a scene, the surface is reconstructed from the
    scan (`uwlts reconstruct`, `uwlts mesh`). The path of the page, OUT/follow.html, is returned. It shows both captures
    and the differences that the twin does not explain.

    Parameters
    ----------
    capture
        Scan by a stage, real or rendered.
    calibration
        Calibration of the sensor.
    scene
        Name or path of the scene that was scanned; its motion is replaced by that of the scan. By default, the surface
        is reconstructed from the scan.
    placement
        Named position of the objects, of those of the scene.
    reflectance
        Diffuse reflectance of the surface; of a given scene, that of its objects.
    repeats
        Laser images that were repeated at one position and exposure, for the camera's gain.
    compared_with
        OUT/followed.json of an earlier day; the changes are printed with their significance.
    out
        Folder for all results.
    overwrite
        Replace existing results.
    spp, seed, variant
        As for `simulate`.
    progress
        Called with the number of images rendered and the total number.

    Returns
    -------
    pathlib.Path
        The page, ``OUT/follow.html``.

    Raises
    ------
    CaptureError
        The scan cannot be read, or its images are not at even steps of a stage.
    CommandFailed
        A command of ``uwlts`` failed; its output gives the reason.
    DescriptionError, DesignError, OutputError, SetupError
        As for `simulate`.
    """
    folder = Path(out)
    page = folder / "follow.html"
    if page.exists() and not overwrite:
        raise OutputError(f"{page} exists already; give another folder, or `overwrite` to replace it")
    with Capture(capture) as scan:
        motion, header = _motion_of(scan), scan.header
    folder.mkdir(parents=True, exist_ok=True)
    scan_path, known = str(capture), ["--calibration", str(calibration)]
    fitted = folder / "followed.toml"
    more = ["--repeats", str(repeats)] if repeats else []
    more += ["--compared-with", str(compared_with)] if compared_with else []
    surface = ["--reflectance", f"{reflectance:.9g}"]
    _run("radiometry", scan_path, *known, *surface, *more, "--out", str(fitted))
    if scene is None:
        cloud, mesh = folder / "scan.cloud.h5", folder / "surface.ply"
        _run("reconstruct", scan_path, *known, "--out", str(cloud))
        _run("mesh", str(cloud), "--out", str(mesh))
        table = _reconstructed_scene(header, mesh.name, reflectance)
    else:
        described = load_scene(scene, placement=placement, medium=header.medium_name)
        table = described.model_dump(mode="json", exclude_none=True)
    again = folder / "scene.toml"
    with write_atomically(again, overwrite=True) as aside:
        aside.write_text(tomli_w.dumps(table | {"motion": motion}), encoding="utf-8")
    rendered = folder / "rendered.h5"
    options = {"spp": spp, "seed": seed, "variant": variant, "progress": progress, "overwrite": True}
    simulate(again, sensor=fitted, out=rendered, **options)
    compared = ["--compared-with", str(fitted.with_suffix(".json")), "--earlier-capture", scan_path]
    outputs = ["--out", str(folder / "rendered.toml"), "--page", str(page)]
    _run("radiometry", str(rendered), *known, *surface, *compared, *outputs)
    return page


def _motion_of(scan: Capture) -> Table:
    """Return the motion of a scene that repeats the laser images of a scan, without repetitions at a place."""
    places = np.unique(scan.stage_mm[scan.laser_on])
    steps = np.diff(places)
    if np.isfinite(scan.pose).any() or len(places) < 2 or np.ptp(steps) > 0.01 * steps.min():
        found = f"{len(places)} positions" + (f", {steps.min():g} to {steps.max():g} mm apart" if len(steps) else "")
        raise CaptureError(
            f"{scan.path.name} has laser images at {found}; expected even steps of a stage, without poses"
        )
    motion: Table = {
        "start_mm": float(places[0]),
        "step_mm": float(steps.mean()),
        "count": len(places),
        "direction": list(scan.header.stage_direction),
    }
    return motion


def _reconstructed_scene(header: CaptureHeader, mesh: str, reflectance: float) -> Table:
    surface: Table = {"kind": "mesh", "path": mesh, "reflectance": reflectance}
    return {"title": f"Surface of {header.name}", "medium": header.medium_name, "objects": [surface]}


def _run(command: str, *words: str) -> None:
    """Run a command of the sensor's software as a separate program, which replaces its outputs."""
    run_program("uwlts", command, *words, "--overwrite")
