"""The joint calibration compared with the thesis's two ways, on the same images of its campaign."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from itertools import count, groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

import uwlts
from uwlts.calibration.joint.gathering import gather_jointly
from uwlts.calibration.joint.procedure import solve_jointly
from uwlts.calibration.sequential import CalibrationOptions
from uwlts.measurement.figure_uncertainty import figure_uncertainties
from uwlts.measurement.reconstruction import reconstruct_stripes
from uwlts.metrology.artefacts import evaluate_cloud
from uwlts.model.any_calibration import AnyCalibration
from uwlts.model.artefacts import parse_artefact
from uwlts.model.calibration import Calibration
from uwlts.optics.design import nominal_setup, speckle_limit_um
from uwlts.report.page_toolkit import COLOURS, legend_below, new_figure, render_page, svg_of
from uwlts.runtime.workers import Send, work_through
from uwlts.storage.calibration_file import write_calibration
from uwlts.storage.capture import Capture
from uwlts.storage.files import json_text, written_aside
from uwlts.stripe import find_stripes
from uwlts.thesis.campaign import CampaignFolder, ScanFile, up_to_date
from uwlts.thesis.measurements import PROPOSED, TWO, calibrations
from uwlts.thesis.results import JointResults, JointSummary, MediumSummary, Method, PlaneScatter, SphereErrors

RESULTS = "joint.json"
_COVERAGE = 1.96  # standard deviations on either side that hold 95 % of a normal distribution
SPACING, DIAMETERS = "SSE", ("diameter error sphere 1", "diameter error sphere 2")
Progress = Callable[[int, int], None]


def joint_calibration(folder: CampaignFolder) -> tuple[Calibration, float]:
    """The joint calibration from a campaign, kept with the others; the time to solve it in s.

    Targets, steps, and the scans of spheres in water: these were made in another water than the calibration, whose
    index follows from their roundness. Their sizes are not used. CaptureError where a recording is missing or damaged,
    CalibrationError where they do not determine a calibration, or contradict each other.
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
) -> list[JointResults]:
    """Errors of every scan of spheres and planes by the three calibrations, with the joint one's uncertainties.

    Those of each campaign are kept in its folder, and read from there unless ``again`` is set or a recording is newer.
    ``progress(done, total)`` counts scans. CaptureError, CalibrationError or EvaluationError where a recording is
    missing or damaged, does not determine a calibration, or does not show its artefact; SetupError where a process that
    works on a campaign was ended from outside.
    """
    total, numbers = sum(len(_compared(folder)) for folder in folders), count(1)
    return work_through(
        partial(_compare, again), folders, workers=workers, on_message=lambda _: progress(next(numbers), total)
    )


def _compared(folder: CampaignFolder) -> list[ScanFile]:
    return [scan for scan in folder.scans() if scan.thing in ("spheres", "plane")]


def _compare(again: bool, folder: CampaignFolder, send: Send) -> JointResults:
    """Results of a campaign; ``send`` is called for every scan."""
    path = folder.path / RESULTS
    if not again and up_to_date(path):
        for _ in _compared(folder):
            send(None)
        return JointResults.read(path)
    sequential = calibrations(folder)
    joint, solve_s = joint_calibration(folder)
    spheres, planes = [], []
    for scan in _compared(folder):
        if scan.thing == "spheres":
            one, two = (sequential.get((method, scan.medium)) for method in (PROPOSED, TWO))
            spheres.append(_of_spheres(scan, {"joint": joint, "one_refraction": one, "two_refractions": two}))
        else:
            planes.append(_of_plane(scan, joint))
        send(None)
    return JointResults(campaign=folder.path.name, solve_s=solve_s, spheres=spheres, planes=planes).keep(path)


def _of_spheres(scan: ScanFile, known: Mapping[Method, AnyCalibration | None]) -> SphereErrors:
    errors, std_mm = {}, {}
    with Capture(scan.path) as capture:
        artefact, stripes = parse_artefact(capture.header.artefact or {}), find_stripes(capture)
        for method, calibration in known.items():
            if calibration is None:
                continue
            cloud = reconstruct_stripes(capture, stripes, calibration, with_uncertainty=method == "joint")
            evaluation = evaluate_cloud(cloud, artefact)
            errors[method] = {name: evaluation.figures_mm[name] for name in (SPACING, *DIAMETERS)}
            if method == "joint":
                expanded = figure_uncertainties(cloud, evaluation)
                std_mm = {name: expanded[name].expanded_mm / 2 for name in errors[method]}
    return SphereErrors(placement=scan.placement, medium=scan.medium, std=std_mm, **errors)


def _of_plane(scan: ScanFile, joint: Calibration) -> PlaneScatter:
    """Scatter of a plane about its fit, over the speckle limit along the laser's axis at its distance."""
    with Capture(scan.path) as capture:
        header = capture.header
        cloud = reconstruct_stripes(capture, find_stripes(capture), joint)
        std_mm = evaluate_cloud(cloud, parse_artefact(header.artefact or {})).figures_mm["STD"]
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
    return PlaneScatter(scan.placement, scan.medium, std_mm, float(std_mm / limit))


def joint_summary(results: Sequence[JointResults]) -> JointSummary:
    """Errors of all campaigns' scans, share of the intervals that hold the truth, time to solve."""
    water, air = (_medium_summary(results, medium) for medium in ("water", "air"))
    solve_s = [result.solve_s for result in results]
    return JointSummary(**dict(water), solve_s=solve_s, campaigns=len(results), water=water, air=air)


def _medium_summary(results: Sequence[JointResults], medium: str) -> MediumSummary:
    spheres = [scan for result in results for scan in result.spheres if scan.medium == medium]
    methods = list(spheres[0].by_method()) if spheres else []
    inside = [abs(scan.joint[n]) <= _COVERAGE * scan.std[n] for scan in spheres for n in (SPACING, *DIAMETERS)]
    return MediumSummary(
        spacing_error_mm={m: [scan.by_method()[m][SPACING] for scan in spheres] for m in methods},
        diameter_error_mm={m: [scan.by_method()[m][n] for scan in spheres for n in DIAMETERS] for m in methods},
        plane_std_over_speckle_limit=[p.over_limit for r in results for p in r.planes if p.medium == medium],
        coverage_95=float(np.mean(inside)) if inside else None,
    )


class _Row(NamedTuple):
    """Mean and largest size of a quantity's errors by one calibration, mm, and that mean over the joint one's."""

    quantity: str
    method: str
    mean: float
    largest: float
    times: float
    number: int


def _rows(part: MediumSummary) -> list[_Row]:
    rows = []
    for quantity, errors_mm in (("sphere spacing", part.spacing_error_mm), ("sphere diameter", part.diameter_error_mm)):
        sizes: dict[Method, np.ndarray] = {method: np.abs(errors) for method, errors in errors_mm.items()}
        for method, size in sizes.items():
            times = size.mean() / sizes["joint"].mean()
            rows.append(_Row(quantity, _WORDS[method], size.mean(), size.max(), times, len(size)))
    return rows


def summary_lines(summary: JointSummary) -> list[str]:
    """The summary as sentences."""
    lines = []
    for medium, part in (("water", summary.water), ("air", summary.air)):
        for name, rows in groupby(_rows(part), lambda row: row.quantity):
            means = ", ".join(f"{row.method} {row.mean:.4f} mm (largest {row.largest:.4f})" for row in rows)
            lines.append(f"{medium}, error of the {name}, mean of the absolute values: {means}")
        if part.coverage_95 is not None:
            lines.append(f"{medium}, truth within the stated 95 % intervals: {100 * part.coverage_95:.0f} %")
        if over := part.plane_std_over_speckle_limit:
            lines.append(f"{medium}, scatter of planes over the speckle limit: {np.mean(over):.2f} on average")
    return [*lines, f"joint estimate solved in {', '.join(f'{s:.1f}' for s in summary.solve_s)} s"]


_WORDS: dict[Method, str] = {"one_refraction": "one refraction", "two_refractions": "two refractions", "joint": "joint"}
# Side by side within each campaign.
_BESIDE: dict[Method, float] = {"one_refraction": -0.2, "two_refractions": 0.0, "joint": 0.2}


def write_joint_comparison(folder: Path, results: Sequence[JointResults], *, overwrite: bool = False) -> JointSummary:
    """Write report.html and summary.json into a folder, each whole or not at all; OutputError where that fails."""
    summary = joint_summary(results)
    media = [
        (medium, part, _rows(part), svg_of(_errors_figure(results, medium))) for medium, part in summary.media().items()
    ]
    software = f"uwlts {uwlts.__version__}"
    text = render_page("uwlts.thesis", "joint.html.j2", software=software, summary=summary, media=media)
    with (
        written_aside(folder / "report.html", overwrite=overwrite) as page,
        written_aside(folder / "summary.json", overwrite=overwrite) as aside,
    ):
        page.write_text(text, encoding="utf-8")
        aside.write_text(json_text(summary, indent=1), encoding="utf-8")
    return summary


def _errors_figure(results: Sequence[JointResults], medium: str) -> Figure:
    """Errors of all scans by campaign; the joint ones with their stated 95 % intervals."""
    figure, panels = new_figure(9.0, 3.4, columns=2)
    quantities = (("sphere spacing", (SPACING,)), ("sphere diameter", DIAMETERS))
    for axes, (quantity, figures) in zip(panels, quantities, strict=True):
        for colour, (method, words) in zip((COLOURS[5], COLOURS[1], COLOURS[0]), _WORDS.items(), strict=True):
            points = [
                (place + _BESIDE[method] + 0.03 * (number - 2.5), 1000 * errors[name], 1000 * scan.std[name])
                for place, result in enumerate(results)
                for number, scan in enumerate(scan for scan in result.spheres if scan.medium == medium)
                if (errors := scan.by_method().get(method))
                for name in figures
            ]
            if points:
                x, y, std = np.array(points).T
                is_joint = method == "joint"
                label = f"{words}, with the stated 95 % intervals" if is_joint else words
                axes.errorbar(x, y, _COVERAGE * std if is_joint else None, fmt="o", ms=4, color=colour, label=label)
        axes.set(title=f"{quantity} in {medium}", xlabel="campaign", ylabel="error / µm", xticks=range(len(results)))
    legend_below(figure)
    return figure
