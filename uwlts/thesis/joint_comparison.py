"""The joint calibration compared with the thesis's two ways, on the same images of its campaign."""

import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import uwlts
from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.joint.procedure import solve_jointly
from uwlts.calibration.sequential import CalibrationOptions
from uwlts.measurement.figure_uncertainty import figure_uncertainties
from uwlts.measurement.reconstruction import reconstruct_stripes
from uwlts.metrology.artefacts import evaluate_cloud
from uwlts.model.artefacts import parse_artefact
from uwlts.model.calibration import Calibration
from uwlts.optics.design import speckle_limit_um
from uwlts.report.inventory import nominal_setup
from uwlts.report.page_toolkit import COLOURS, legend_below, new_figure, render_page, svg_of
from uwlts.runtime.workers import Tell, work_through
from uwlts.storage.calibration_file import write_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.files import written_aside
from uwlts.stripe import find_stripes
from uwlts.thesis.campaign import CampaignFolder, ScanFile, keep, kept, up_to_date
from uwlts.thesis.measurements import PROPOSED, TWO, calibrations

RESULTS = "joint.json"
FORMAT, VERSION = "uwlts-joint-comparison", 1
ONE_REFRACTION, TWO_REFRACTIONS, JOINT = "one_refraction", "two_refractions", "joint"
_COVERAGE = 1.96
SPACING, DIAMETERS = "SSE", ("diameter error sphere 1", "diameter error sphere 2")
Progress = Callable[[int, int], None]


def joint_calibration(folder: CampaignFolder) -> tuple[Calibration, float]:
    """The joint calibration from a campaign, kept with the others; the time to solve it in s.

    Targets, steps, and the scans of spheres in water: these were made in another water than the calibration, whose
    index their roundness tells. Of their sizes it is told nothing.

    Raises
    ------
    CaptureError
        A recording is missing or damaged.
    CalibrationError
        The recordings do not determine a calibration, or contradict each other.
    """
    options = CalibrationOptions(poses="stage", same_water=False, sizes_known=False)
    with ExitStack() as stack:
        targets = [stack.enter_context(Capture(folder.target(kind))) for kind in ("bare", "air", "water")]
        steps = [stack.enter_context(Capture(path)) for path in folder.steps()]
        wet = [scan.path for scan in folder.scans() if scan.thing == "spheres" and scan.medium != "air"]
        scans = [stack.enter_context(Capture(path)) for path in wet]
        gathered = gather_jointly(targets, steps, scans, options=options)
    start = time.perf_counter()
    calibration = solve_jointly(gathered, options=options).calibration
    taken_s = time.perf_counter() - start
    write_calibration(folder.path / "calibrations" / "joint.json", calibration, overwrite=True)
    return calibration, taken_s


def compare_campaigns(
    folders: Sequence[CampaignFolder],
    *,
    workers: int | None = None,
    again: bool = False,
    progress: Progress = lambda done, total: None,
) -> list[dict[str, Any]]:
    """Errors of every scan of spheres and planes by the three ways, with the joint one's uncertainties, as plain JSON.

    Those of each campaign are kept in its folder, and read from there unless ``again`` is set or a recording is newer.
    ``progress(done, total)`` counts scans.

    Raises
    ------
    CaptureError, CalibrationError, EvaluationError
        A recording is missing or damaged, does not determine a calibration, or does not show its artefact.
    SetupError
        A process that works on a campaign was ended from outside.
    """
    total, done = sum(len(_compared(folder)) for folder in folders), 0

    def heard(_: None) -> None:
        nonlocal done
        done += 1
        progress(done, total)

    jobs = [_Job(folder, again) for folder in folders]
    return work_through(_compare, jobs, workers=workers, heard=heard)


@dataclass(frozen=True)
class _Job:
    folder: CampaignFolder
    again: bool


def _compared(folder: CampaignFolder) -> list[ScanFile]:
    return [scan for scan in folder.scans() if scan.thing in ("spheres", "plane")]


def _compare(job: _Job, tell: Tell) -> dict[str, Any]:
    """Tells of every scan."""
    folder, path = job.folder, job.folder.path / RESULTS
    if not job.again and up_to_date(path):
        for _ in _compared(folder):
            tell(None)
        return kept(path, format=FORMAT, version=VERSION)
    by_turns = calibrations(folder)
    joint, solve_s = joint_calibration(folder)
    spheres, planes = [], []
    for scan in _compared(folder):
        known = {JOINT: joint, ONE_REFRACTION: by_turns[PROPOSED, scan.medium]}
        if (TWO, scan.medium) in by_turns:
            known[TWO_REFRACTIONS] = by_turns[TWO, scan.medium]
        if scan.thing == "spheres":
            spheres.append(_of_spheres(scan, known))
        else:
            planes.append(_of_plane(scan, joint))
        tell(None)
    results = {"campaign": folder.path.name, "solve_s": solve_s, "spheres": spheres, "planes": planes}
    return keep(path, results, format=FORMAT, version=VERSION)


def _of_spheres(scan: ScanFile, known: dict[str, Calibration]) -> dict[str, Any]:
    with Capture(scan.path) as capture:
        artefact, stripes = parse_artefact(capture.header.artefact), find_stripes(capture)
        found: dict[str, Any] = {"placement": scan.placement, "medium": scan.medium}
        for way, calibration in known.items():
            cloud = reconstruct_stripes(capture, stripes, calibration, with_uncertainty=way == JOINT)
            evaluation = evaluate_cloud(cloud, artefact)
            found[way] = {name: evaluation.figures_mm[name] for name in (SPACING, *DIAMETERS)}
            if way == JOINT:
                std = figure_uncertainties(cloud, evaluation)
                found["std"] = {name: std[name].expanded_mm / 2 for name in found[way]}
    return found


def _of_plane(scan: ScanFile, joint: Calibration) -> dict[str, Any]:
    """Scatter of a plane about its fit, over the speckle limit along the laser's axis at its distance."""
    with Capture(scan.path) as capture:
        header = capture.header
        cloud = reconstruct_stripes(capture, find_stripes(capture), joint)
        std_mm = evaluate_cloud(cloud, parse_artefact(header.artefact)).figures_mm["STD"]
        setup, leaning = nominal_setup(header.sensor, header.medium)
        frame = joint.object_transform()
        depth = float(np.mean(cloud.points_mm @ frame[2, :3]) + frame[2, 3])
        camera = header.sensor.camera
        window = setup.window if joint.window is None else replace(setup.window, distance_mm=joint.window.distance_mm)
        across = 1e-3 * speckle_limit_um(
            wavelength_nm=joint.wavelength_nm,
            focal_length_mm=camera.focal_length_mm,
            f_number=camera.f_number,
            distance_mm=float(window.reach_mm(depth)),
        )
    limit = across * leaning / np.tan(setup.triangulation_angle_rad)
    return {"placement": scan.placement, "medium": scan.medium, "std_mm": std_mm, "over_limit": float(std_mm / limit)}


def joint_summary(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures of all campaigns: errors of all scans, share of the intervals that hold the truth, time to solve."""
    summary: dict[str, Any] = {"campaigns": len(results)}
    for medium in ("water", "air"):
        spheres = [s for result in results for s in result["spheres"] if s["medium"] == medium]
        ways = [way for way in (ONE_REFRACTION, TWO_REFRACTIONS, JOINT) if spheres and way in spheres[0]]
        planes = [p["over_limit"] for result in results for p in result["planes"] if p["medium"] == medium]
        inside = [abs(s[JOINT][n]) <= _COVERAGE * s["std"][n] for s in spheres for n in (SPACING, *DIAMETERS)]
        summary[medium] = {
            "spacing_error_mm": {way: [s[way][SPACING] for s in spheres] for way in ways},
            "diameter_error_mm": {way: [s[way][n] for s in spheres for n in DIAMETERS] for way in ways},
            "plane_std_over_speckle_limit": planes,
            "coverage_95": float(np.mean(inside)) if inside else None,
        }
    return summary["water"] | {"solve_s": [result["solve_s"] for result in results]} | summary


def summary_lines(summary: dict[str, Any]) -> list[str]:
    """The summary in words."""
    lines = []
    for medium in ("water", "air"):
        part = summary[medium]
        for what, name in (("sphere spacing", "spacing_error_mm"), ("sphere diameter", "diameter_error_mm")):
            means = ", ".join(
                f"{way.replace('_', ' ')} {np.mean(np.abs(errors)):.4f} mm (largest {np.max(np.abs(errors)):.4f})"
                for way, errors in part[name].items()
            )
            if means:
                lines.append(f"{medium}, error of the {what}, mean of the absolute values: {means}")
        if part["coverage_95"] is not None:
            lines.append(f"{medium}, truth within the stated 95 % intervals: {100 * part['coverage_95']:.0f} %")
        if over := part["plane_std_over_speckle_limit"]:
            lines.append(f"{medium}, scatter of planes over the speckle limit: {np.mean(over):.2f} on average")
    return [*lines, f"joint estimate solved in {', '.join(f'{s:.1f}' for s in summary['solve_s'])} s"]


_WORDS = {ONE_REFRACTION: "one refraction", TWO_REFRACTIONS: "two refractions", JOINT: "joint"}
_QUANTITIES = {"spacing_error_mm": ("sphere spacing", (SPACING,)), "diameter_error_mm": ("sphere diameter", DIAMETERS)}
# Side by side within each campaign.
_BESIDE = {ONE_REFRACTION: -0.2, TWO_REFRACTIONS: 0.0, JOINT: 0.2}


def write_joint_comparison(
    folder: Path, results: Sequence[dict[str, Any]], *, overwrite: bool = False
) -> dict[str, Any]:
    """Write report.html and summary.json into a folder, each whole or not at all; OutputError where that fails."""
    summary = joint_summary(results)
    with (
        written_aside(folder / "report.html", overwrite=overwrite) as page,
        written_aside(folder / "summary.json", overwrite=overwrite) as aside,
    ):
        page.write_text(joint_page(results, summary), encoding="utf-8")
        aside.write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return summary


def joint_page(results: Sequence[dict[str, Any]], summary: dict[str, Any]) -> str:
    """The page as text, from the results of `compare_campaigns` and their `joint_summary`."""
    media = [medium for medium in ("water", "air") if any(summary[medium]["spacing_error_mm"].values())]
    return render_page(
        "uwlts.thesis",
        "joint.html.j2",
        software=f"uwlts {uwlts.__version__}",
        campaigns=summary["campaigns"],
        solve_s=max(summary["solve_s"]),
        media=[
            {
                "name": medium,
                "rows": _rows(summary[medium]),
                "over_limit": summary[medium]["plane_std_over_speckle_limit"],
                "coverage": summary[medium]["coverage_95"],
                "picture": svg_of(_errors_figure(results, medium)),
            }
            for medium in media
        ],
    )


def _rows(part: dict[str, Any]) -> list[dict[str, Any]]:
    """Mean and largest error by quantity and way, and how many times the joint one's mean."""
    rows = []
    for name, (quantity, _) in _QUANTITIES.items():
        means = {way: float(np.mean(np.abs(errors))) for way, errors in part[name].items()}
        rows += [
            {
                "quantity": quantity,
                "way": _WORDS[way],
                "mean": mean,
                "largest": float(np.max(np.abs(part[name][way]))),
                "times": mean / means[JOINT],
                "number": len(part[name][way]),
            }
            for way, mean in means.items()
        ]
    return rows


def _errors_figure(results: Sequence[dict[str, Any]], medium: str) -> Figure:
    """Errors of all scans by campaign; the joint ones with their stated 95 % intervals."""
    figure, panels = new_figure(9.0, 3.4, columns=len(_QUANTITIES))
    for axes, (quantity, figures) in zip(panels, _QUANTITIES.values(), strict=True):
        for colour, (way, words) in zip((COLOURS[5], COLOURS[1], COLOURS[0]), _WORDS.items(), strict=True):
            points = [
                (place + _BESIDE[way] + 0.03 * (number - 2.5), 1000 * scan[way][figure], 1000 * scan["std"][figure])
                for place, result in enumerate(results)
                for number, scan in enumerate(s for s in result["spheres"] if s["medium"] == medium and way in s)
                for figure in figures
            ]
            if points:
                x, y, std = np.array(points).T
                is_joint = way == JOINT
                name = f"{words}, with the stated 95 % intervals" if is_joint else words
                axes.errorbar(x, y, _COVERAGE * std if is_joint else None, fmt="o", ms=4, color=colour, label=name)
        axes.set(title=f"{quantity} in {medium}", xlabel="campaign", ylabel="error / µm", xticks=range(len(results)))
    legend_below(figure)
    return figure
