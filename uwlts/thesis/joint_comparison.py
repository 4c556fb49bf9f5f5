"""Comparison of the joint calibration with the thesis's two methods, on scans that no calibration has used.

The thesis's two methods use the target in air, without or with the camera's window, and the steps. The joint
calibration uses the evidence of both, then also the target in water, then also half of the scans of spheres in water.
The errors are those of the other half, and of all scans in air.
"""

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import count, groupby
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from matplotlib.figure import Figure

from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.joint.procedure import solve_jointly
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions
from uwlts.evaluation.artefact_figures import evaluate_cloud
from uwlts.evaluation.evaluate import compare_cloud_with_truth
from uwlts.evaluation.figure_uncertainty import figure_uncertainties, shift_std_mm
from uwlts.files.json_files import json_text
from uwlts.files.writing import write_atomically
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.artefacts import parse_artefact
from uwlts.model.calibration import Calibration
from uwlts.model.placement import apparent_depth_mm
from uwlts.optics.design import SheetGeometry, speckle_limit_um
from uwlts.pages.toolkit import COLOURS, figure_svg, legend_below, new_figure, render_page
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.runtime.progress import ProgressListener, ignore_progress
from uwlts.runtime.workers import Send, run_jobs
from uwlts.storage.capture import Capture
from uwlts.storage.truth import read_truth, truth_path
from uwlts.stripe import find_stripes
from uwlts.thesis.campaign_folder import CampaignFolder, ScanFile, up_to_date
from uwlts.thesis.measurements import PROPOSED, TWO, calibrations
from uwlts.thesis.results import (
    JointMethod,
    JointResults,
    JointSummary,
    MediumSummary,
    Method,
    PlaneScatter,
    SphereErrors,
)

RESULTS = "joint.json"
JOINT: tuple[JointMethod, ...] = get_args(JointMethod)
_USED = ("near", "standoff", "far")
"""Placements of the spheres in water that a calibration may use."""
_COVERAGE = 1.96  # standard deviations on either side that contain 95 % of a normal distribution
_BESIDE = 0.16  # distance between methods, relative to the distance between campaigns
SPACING, DIAMETERS = "SSE", ("diameter error sphere 1", "diameter error sphere 2")
SHIFTS = ("mean error X", "mean error Y", "mean error Z")
"""Mean errors of all points of a scan."""


def joint_calibration(folder: CampaignFolder, method: JointMethod) -> tuple[Calibration, float]:
    """Calibrate a campaign jointly, and save the calibration with the others; return it with the solution time, s.

    The scans of spheres were recorded in another water than the calibration, whose index follows from their roundness.
    Their sizes are not used.

    Raises CaptureError if a recording is missing or damaged; CalibrationError if the recordings do not determine a
    calibration, or contradict each other.
    """
    options = CalibrationOptions(poses="stage", same_water=False, sizes_known=False)
    same = method == "joint_same_evidence"
    used = [scan.path for scan in folder.scans() if _is_used(scan)] if method == "joint_with_scans" else []
    with ExitStack() as stack:
        kinds = ("bare", "air") if same else ("bare", "air", "water")
        targets = [stack.enter_context(Capture(folder.target(kind))) for kind in kinds]
        steps = [stack.enter_context(Capture(path)) for path in folder.steps()]
        scans = [stack.enter_context(Capture(path)) for path in used]
        gathered = gather_jointly(targets, steps, scans, options=options)
    start = time.perf_counter()
    calibration = solve_jointly(gathered, options=options).calibration
    taken_s = time.perf_counter() - start
    calibration.save(folder.path / "calibrations" / f"{method.replace('_', '-')}.json", overwrite=True)
    return calibration, taken_s


def _is_used(scan: ScanFile) -> bool:
    """Return whether the joint calibration with scans uses a scan, so that its errors are not evaluated."""
    return scan.thing == "spheres" and scan.medium == "water" and scan.placement in _USED


def compare_campaigns(
    folders: Sequence[CampaignFolder],
    *,
    workers: int | None = None,
    again: bool = False,
    progress: ProgressListener = ignore_progress,
) -> list[JointResults]:
    """Evaluate scans of spheres and planes with all calibrations, with the joint calibrations' uncertainties.

    The results of each campaign are saved in its folder, and read from there unless ``again`` is set or a recording is
    newer. ``progress(done, total)`` counts scans.

    Raises CaptureError, CalibrationError, EvaluationError if a recording is missing or damaged, does not determine a
    calibration, or does not show its artefact; SetupError if a worker process was ended from outside.
    """
    total, numbers = sum(len(_list_compared_scans(folder)) for folder in folders), count(1)
    return run_jobs(
        partial(_compare, again), folders, workers=workers, on_message=lambda _: progress(next(numbers), total)
    )


def _list_compared_scans(folder: CampaignFolder) -> list[ScanFile]:
    return [scan for scan in folder.scans() if scan.thing in ("spheres", "plane") and not _is_used(scan)]


def _compare(again: bool, folder: CampaignFolder, send: Send) -> JointResults:
    """Evaluate a campaign; ``send`` is called for every scan."""
    path = folder.path / RESULTS
    if not again and up_to_date(path):
        for _ in _list_compared_scans(folder):
            send(None)
        return JointResults.read_file(path)
    sequential = calibrations(folder)
    joint: dict[JointMethod, Calibration] = {}
    solve_s: dict[JointMethod, float] = {}
    for way in JOINT:
        joint[way], solve_s[way] = joint_calibration(folder, way)
    spheres, planes = [], []
    for scan in _list_compared_scans(folder):
        if scan.thing == "spheres":
            ways: dict[Method, tuple[str, str]] = {
                "one_refraction": (PROPOSED, scan.medium),
                "two_refractions": (TWO, scan.medium),
            }
            known: dict[Method, AnyCalibration] = {
                way: sequential[found] for way, found in ways.items() if found in sequential
            }
            spheres.append(_evaluate_spheres(scan, known | joint))
        else:
            planes.append(_evaluate_plane(scan, joint["joint_with_scans"]))
        send(None)
    return JointResults(campaign=folder.path.name, solve_s=solve_s, spheres=spheres, planes=planes).keep(path)


def _evaluate_spheres(scan: ScanFile, known: Mapping[Method, AnyCalibration]) -> SphereErrors:
    errors: dict[Method, dict[str, float]] = {}
    std_mm: dict[JointMethod, dict[str, float]] = {}
    truth = read_truth(truth_path(scan.path))[1]
    with Capture(scan.path) as capture:
        artefact, stripes = parse_artefact(capture.header.artefact or {}), find_stripes(capture)
        for method, calibration in known.items():
            cloud = reconstruct_stripes(capture, stripes, calibration, with_uncertainty=method in JOINT)
            evaluation = evaluate_cloud(cloud, artefact)
            compared = compare_cloud_with_truth(cloud, truth)
            errors[method] = {name: evaluation.figures_mm[name] for name in (SPACING, *DIAMETERS)}
            errors[method] |= zip(SHIFTS, compared.shift_mm.tolist(), strict=True)
            if method in JOINT:
                expanded = figure_uncertainties(cloud, evaluation)
                std_mm[method] = {name: expanded[name].expanded_mm / 2 for name in (SPACING, *DIAMETERS)}
                std_mm[method] |= zip(SHIFTS, shift_std_mm(cloud, compared.matched).tolist(), strict=True)
    return SphereErrors(scan.placement, scan.medium, errors, std_mm)


def _evaluate_plane(scan: ScanFile, joint: Calibration) -> PlaneScatter:
    """Return the plane's residual standard deviation, and its ratio to the speckle limit at that distance."""
    with Capture(scan.path) as capture:
        header = capture.header
        cloud = reconstruct_stripes(capture, find_stripes(capture), joint)
        std_mm = evaluate_cloud(cloud, parse_artefact(header.artefact or {})).figures_mm["STD"]
        geometry = SheetGeometry.from_description(header.sensor, header.medium)
        frame = joint.object_transform()
        depth = float(np.mean(cloud.points_mm @ frame[2, :3]) + frame[2, 3])
        camera, window = header.sensor.camera, geometry.window
        distance = window.distance_mm if joint.window is None else joint.window.distance_mm
        apparent = apparent_depth_mm(
            depth, distance, window.thickness_mm, glass_index=window.glass_index, medium_index=window.medium_index
        )
        across = 1e-3 * speckle_limit_um(
            wavelength_nm=joint.wavelength_nm,
            focal_length_mm=camera.focal_length_mm,
            f_number=camera.f_number,
            distance_mm=apparent,
        )
    motion = geometry.crossing_motion()
    limit = across * abs(motion @ geometry.laser.axis / motion[int(geometry.along_width)])
    return PlaneScatter(scan.placement, scan.medium, std_mm, float(std_mm / limit))


def joint_summary(results: Sequence[JointResults]) -> JointSummary:
    """Summarise all campaigns: errors of scans, coverage of the 95 % intervals, and solution times."""
    water, air = (_medium_summary(results, medium) for medium in ("water", "air"))
    solve_s: dict[JointMethod, list[float]] = {way: [result.solve_s[way] for result in results] for way in JOINT}
    return JointSummary(**dict(water), solve_s=solve_s, campaigns=len(results), water=water, air=air)


def _medium_summary(results: Sequence[JointResults], medium: str) -> MediumSummary:
    spheres = [scan for result in results for scan in result.spheres if scan.medium == medium]
    methods = list(spheres[0].errors_mm) if spheres else []
    inside: dict[JointMethod, list[bool]] = {
        way: [
            abs(scan.errors_mm[way][name]) <= _COVERAGE * scan.std_mm[way][name]
            for scan in spheres
            for name in (SPACING, *DIAMETERS, *SHIFTS)
        ]
        for way in JOINT
    }
    return MediumSummary(
        spacing_error_mm={m: [scan.errors_mm[m][SPACING] for scan in spheres] for m in methods},
        diameter_error_mm={m: [scan.errors_mm[m][n] for scan in spheres for n in DIAMETERS] for m in methods},
        shift_mm={m: [scan.errors_mm[m][n] for scan in spheres for n in SHIFTS] for m in methods},
        plane_std_over_speckle_limit=[p.over_limit for r in results for p in r.planes if p.medium == medium],
        coverage_95={way: float(np.mean(held)) for way, held in inside.items() if held},
    )


class _Row(NamedTuple):
    """Mean and maximum absolute error of a quantity for one calibration, mm."""

    quantity: str
    method: str
    mean: float
    largest: float
    number: int
    joint: bool


def _rows(part: MediumSummary) -> list[_Row]:
    rows = []
    quantities = {
        "sphere spacing": part.spacing_error_mm,
        "sphere diameter": part.diameter_error_mm,
        "place, along an axis": part.shift_mm,
    }
    for quantity, errors_mm in quantities.items():
        sizes: dict[Method, np.ndarray] = {method: np.abs(errors) for method, errors in errors_mm.items()}
        for method, size in sizes.items():
            rows.append(_Row(quantity, _WORDS[method], size.mean(), size.max(), len(size), method in JOINT))
    return rows


def summary_lines(summary: JointSummary) -> list[str]:
    """Describe the summary in sentences."""
    lines = []
    for medium, part in (("water", summary.water), ("air", summary.air)):
        for name, rows in groupby(_rows(part), lambda row: row.quantity):
            means = ", ".join(f"{row.method} {row.mean:.4f} mm (largest {row.largest:.4f})" for row in rows)
            lines.append(f"{medium}, error of the {name}, mean of the absolute values: {means}")
        for way, held in part.coverage_95.items():
            lines.append(f"{medium}, {_WORDS[way]}, truth within the stated 95 % intervals: {100 * held:.0f} %")
        if over := part.plane_std_over_speckle_limit:
            lines.append(f"{medium}, scatter of planes divided by the speckle limit: {np.mean(over):.2f} on average")
    solved = "; ".join(
        f"{_WORDS[way]} {', '.join(f'{s:.1f}' for s in times)}" for way, times in summary.solve_s.items()
    )
    return [*lines, f"solved in s: {solved}"]


_WORDS: dict[Method, str] = {
    "one_refraction": "one refraction",
    "two_refractions": "two refractions",
    "joint_same_evidence": "joint, same evidence",
    "joint_with_target_in_water": "joint, with the target in water",
    "joint_with_scans": "joint, with scans too",
}


def write_joint_comparison(folder: Path, results: Sequence[JointResults], *, overwrite: bool = False) -> JointSummary:
    """Write report.html and summary.json into a folder, each atomically.

    Raises OutputError if a file cannot be written.
    """
    summary = joint_summary(results)
    media = [
        (medium, part, _rows(part), figure_svg(_errors_figure(results, medium)))
        for medium, part in summary.media().items()
    ]
    text = render_page("uwlts.thesis", "joint.html.j2", summary=summary, media=media, words=_WORDS)
    with (
        write_atomically(folder / "report.html", overwrite=overwrite) as page,
        write_atomically(folder / "summary.json", overwrite=overwrite) as aside,
    ):
        page.write_text(text, encoding="utf-8")
        aside.write_text(json_text(summary, indent=1), encoding="utf-8")
    return summary


def _errors_figure(results: Sequence[JointResults], medium: str) -> Figure:
    """Plot the errors of all scans by campaign and method, with 95 % intervals for joint calibrations."""
    figure, panels = new_figure(9.0, 3.4, columns=2)
    quantities = (("sphere spacing", (SPACING,)), ("sphere diameter", DIAMETERS))
    for axes, (quantity, figures) in zip(panels, quantities, strict=True):
        for number, (method, words) in enumerate(_WORDS.items()):
            points = [
                (
                    place + _BESIDE * (number - (len(_WORDS) - 1) / 2),
                    1000 * errors[name],
                    _COVERAGE * 1000 * scan.std_mm[method][name] if method in JOINT else 0.0,
                )
                for place, result in enumerate(results)
                for scan in result.spheres
                if scan.medium == medium and (errors := scan.errors_mm.get(method))
                for name in figures
            ]
            if points:
                x, y, half = np.array(points).T
                axes.errorbar(x, y, half, fmt="o", ms=3, elinewidth=0.8, color=COLOURS[number], label=words)
        axes.set(title=f"{quantity} in {medium}", xlabel="campaign", ylabel="error / µm", xticks=range(len(results)))
    legend_below(figure)
    return figure
