"""Residuals that the second half of each set of real images must show, computed from the first half.

    python -m docs.studies.real_halves                     # the expectations, without the second halves
    python -m docs.studies.real_halves --measured --write  # also what the second halves show

Halves are every second image of a set, or every second window of 64 lines of a single image (`tests/data`). A residual
is known for G images or windows of a half. The logarithms of these values have a mean and a scatter s; the mean of H
others is expected within t s sqrt(1 / G + 1 / H) of it, with Student's t for 95 %. The stated residual follows from the
stated uncertainties of the first half for independent errors, and has the same relative interval.
"""

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import copy
from tempfile import TemporaryDirectory

import numpy as np
from cyclopts import App
from scipy.stats import t as students_t

import uwlts
from docs.studies.result_tables import ROOT, name_once, publish, table
from uwlts.calibration.camera.camera_parameters import TargetImage
from uwlts.calibration.camera.lens import LensChoice, calibrate_lens
from uwlts.calibration.guidance import estimate_pose
from uwlts.calibration.sequential.sequential_calibration import CalibrationOptions, CalibrationResult, gather, solve
from uwlts.calibration.sequential.sheet_fit import points_on_target
from uwlts.fitting.least_squares import MAD_TO_STD
from uwlts.model.calibration import CameraModel
from uwlts.model.mount import PlaneFound
from uwlts.optics.camera import project
from uwlts.radiometry.domain_gap import measure_domain_gap
from uwlts.reconstruction.point_uncertainty import estimate_stripe_noise_px
from uwlts.reconstruction.reconstruct import reconstruct_stripes
from uwlts.storage.capture import Capture
from uwlts.storage.image_file import read_image
from uwlts.storage.import_.folder import import_images
from uwlts.storage.pose_files import read_poses
from uwlts.stripe import PeakRule, StripeOptions, extract_stripe, find_stripes
from uwlts.targets import ChessboardTarget
from uwlts.targets.detection import detect_lattice

DATA = ROOT / "tests" / "data"
LINES, JUMP_PX, BLOCK = 64, 8.0, 8
"""Lines of a window, largest step between its neighbouring lines, and lines of a mean."""
DOT_DEGREE = 9
"""Degree of the smooth map of dots, as in tests/system/test_real_images.py."""
OPTIONS = CalibrationOptions(poses="free", lens=LensChoice())


@dataclass(frozen=True)
class Row:
    """Residual of a set: limits (value, low, high) by the first half and as stated, and the second half's value."""

    name: str
    residual: str
    unit: str
    expected: tuple[float, float, float] | None
    stated: tuple[float, float, float] | None
    found: float | None

    @classmethod
    def of(
        cls,
        name: str,
        residual: str,
        unit: str,
        first: Sequence[float] | np.ndarray,
        second: Sequence[float] | np.ndarray,
        *,
        others: int,
        stated: Sequence[float] | np.ndarray = (),
    ) -> "Row":
        """Return the row of residuals (G,) and their stated values; ``second`` (H,) is empty if it is not known yet."""
        logs = np.log(first)
        reach = float(students_t.ppf(0.975, len(logs) - 1) * logs.std(ddof=1) * math.sqrt(1 / len(logs) + 1 / others))

        def limits(values: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
            middle = float(np.log(values).mean())
            return math.exp(middle), math.exp(middle - reach), math.exp(middle + reach)

        found = math.exp(float(np.log(second).mean())) if len(second) else None
        return cls(name, residual, unit, limits(first), limits(stated) if len(stated) else None, found)

    def cells(self) -> list[str]:
        """Return the cells of the table: expected intervals, or if the second half is known its ratios to them."""
        if self.found is None:
            cells = [self.name, f"{self.residual}, {self.unit}".removesuffix(", ")]
            for limits in (self.expected, self.stated):
                known = [f"{each:.0f}" if abs(each) > 100 else f"{each:.3g}" for each in limits or ()]
                cells.append("{} ({} to {})".format(*known) if known else "nothing")
            return cells
        cells = [self.name, self.residual]
        for limits in (self.expected, self.stated):
            if limits is None:
                cells.append("")
                continue
            ratio = f"{self.found / limits[0]:.2f}" if limits[0] > 0 else "inside"
            cells.append(ratio if limits[1] <= self.found <= limits[2] else f"{ratio}, outside")
        return cells


def smooth_residuals(centre: np.ndarray) -> tuple[float, float]:
    """Return the scatter of centres (`LINES`,) about their parabola, and of means of eight times the root of eight."""
    scatters = []
    for values in (centre, centre.reshape(-1, BLOCK).mean(axis=1)):
        place = np.arange(len(values))
        left = values - np.polynomial.Polynomial.fit(place, values, 2)(place)
        scatters.append(math.sqrt(float(left @ left) / (len(values) - 3)))
    return scatters[0], math.sqrt(BLOCK) * scatters[1]


def windows(centre_px: np.ndarray) -> list[np.ndarray]:
    """Return the centres (`LINES`,) of all windows without a gap or a jump in the centres (L,)."""
    lines = np.flatnonzero(np.isfinite(centre_px))
    apart = (np.diff(lines) > 1) | (np.abs(np.diff(centre_px[lines])) > JUMP_PX)
    runs = np.split(centre_px[lines], np.flatnonzero(apart) + 1)
    return [run[at : at + LINES] for run in runs for at in range(0, len(run) - LINES + 1, LINES)]


def stripe_residuals(groups: Sequence[np.ndarray]) -> np.ndarray:
    """Return stated noise, scatter about parabolas, and that of means (3, G) of groups of windows (W, `LINES`)."""
    result = []
    for group in groups:
        frame, line = np.indices(group.shape)
        noise = float(estimate_stripe_noise_px(frame.ravel(), line.ravel(), group.ravel()).mean())
        smooth = np.exp(np.log([smooth_residuals(each) for each in group]).mean(axis=0))
        result.append([noise, *smooth])
    return np.array(result).T


def stripe_rows(name: str, halves: Sequence[list[np.ndarray]]) -> Iterator[Row]:
    """Yield the rows of a stripe from the groups of both halves; the second is empty if it is not known yet."""
    first, *second = (stripe_residuals(half) for half in halves if half)
    others = len(halves[0])
    for k, residual in enumerate(("centre noise", "centres about parabolas", "means of 8 centres")):
        found = second[0][k] if second else ()
        yield Row.of(name, residual, "px", first[k], found, others=others, stated=first[0])


def single_images(measured: bool) -> Iterator[Row]:
    """Yield the rows of the stripes of single images."""
    for folder, corner, rules in (
        ("board", "x200_y440", (PeakRule.FIRST, PeakRule.LAST)),
        ("bust", "x400_y0", (PeakRule.STRONGEST,)),
    ):
        image = np.ascontiguousarray(read_image(DATA / "ciclop" / folder / f"laser_{corner}.png")[:, :, 2])
        for rule in rules:
            stripe = extract_stripe(image, stripe_along="height", options=StripeOptions(peak=rule), saturation=255.0)
            groups = [each[None] for each in windows(stripe.centre_px)]
            name = f"`ciclop/{folder}`" + (f", {rule} line" if len(rules) > 1 else "")
            yield from stripe_rows(name, (groups[::2], groups[1::2] if measured else []))


def dot_rows(measured: bool) -> Iterator[Row]:
    """Yield the rows of dots: distances of every second dot from a smooth map, which the first half determines.

    The groups are sixteen parts of the image.
    """
    for number in ("01", "02", "05"):
        image = read_image(DATA / "dot-patterns" / f"dot_pattern_{number}.jpg")
        found = detect_lattice(image if image.ndim == 2 else np.ascontiguousarray(image[:, :, 1]))
        steps = found.indices - found.indices.mean(axis=0)
        x, y = (2 * steps / np.ptp(steps, axis=0).max()).T
        terms = np.column_stack([x**i * y**j for i in range(DOT_DEGREE + 1) for j in range(DOT_DEGREE + 1 - i)])
        centres, first = found.circles.centres, found.indices.sum(axis=1) % 2 == 0
        smooth = np.linalg.lstsq(terms[first], centres[first], rcond=None)[0]
        away = np.linalg.norm(centres - terms @ smooth, axis=1)
        columns, rows = (np.digitize(each, np.quantile(each, (0.25, 0.5, 0.75))) for each in (x, y))
        rms = [
            [math.sqrt(float(np.mean(away[half & (4 * columns + rows == k)] ** 2))) for k in range(16)]
            for half in ((first, ~first) if measured else (first,))
        ]
        # Fitted residuals are smaller than errors by the fitted terms; those of other dots are larger.
        count, used = np.count_nonzero(first), terms.shape[1]
        expected = math.sqrt((count + used) / (count - used)) * np.array(rms[0])
        name = f"`dot-patterns`, {number}"
        yield Row.of(name, "dots from a smooth map", "px", expected, rms[1] if measured else (), others=16)


def corner_rms(model: CameraModel, image: TargetImage) -> float:
    """Return the rms distance of an image's corners from their prediction by a camera, with the best pose."""
    pose = estimate_pose(image, model)
    seen = project(model, image.points_mm @ pose[:3, :3].T + pose[:3, 3])
    return math.sqrt(float(np.mean(np.sum((image.pixels - seen) ** 2, axis=1))))


def camera_rows(name: str, images: list[TargetImage], size: tuple[int, int], measured: bool) -> Iterator[Row]:
    """Yield the rows of a camera: corners of images that were not used, and the focal length of the second half."""

    def calibrate(chosen: list[TargetImage]):
        return calibrate_lens(chosen, width_px=size[0], height_px=size[1], choice=LensChoice())

    first, second = images[::2], images[1::2] if measured else []
    lens = calibrate(first)
    pairs = zip(lens.without, lens.images, strict=True)
    left_out = [corner_rms(one.model, image) for one, image in pairs if one is not None]
    # A pose of six parameters is fitted to each image.
    stated = [math.sqrt(2 - 6 / len(image.pixels)) * lens.solution.sigma_px for image in lens.images]
    found = [corner_rms(lens.solution.model, image) for image in second]
    residual = "corners of unused images"
    yield Row.of(name, residual, "px", left_out, found, others=len(images) // 2, stated=stated)
    key = next(iter(lens.values()))
    value, std = lens.values()[key], lens.std()[key]
    # The difference of independent halves has twice the variance of one.
    reach = float(students_t.ppf(0.975, len(lens.images) - 1)) * math.sqrt(2) * std
    other = calibrate(second).values() if measured else {}
    yield Row(name, f"focal length {key}", "px", None, (value, value - reach, value + reach), other.get(key))


def ciclop_board(measured: bool) -> Iterator[Row]:
    """Yield the rows of the chessboard's 16 views, in pixels of the whole images."""
    target, images = ChessboardTarget(columns=11, rows=6, square_mm=13.0), []
    for path in sorted((DATA / "ciclop" / "chessboard").iterdir()):
        corner = [int(text) for text in re.findall(r"_x(\d+)_y(\d+)", path.name)[0]]
        view = target.detect(read_image(path))
        images.append(TargetImage(view.points_mm, view.pixels + corner))
    yield from camera_rows("`ciclop/chessboard`", images, (960, 1280), measured)


def inlier_rms(away: np.ndarray) -> float:
    """Return the root mean square of distances without those above five robust standard deviations."""
    return math.sqrt(float(np.mean(away[np.abs(away) < 5 * MAD_TO_STD * np.median(np.abs(away))] ** 2)))


def sheet_rms(sensor: CalibrationResult, image: TargetImage, pixels: np.ndarray) -> float:
    """Return the rms distance, mm, of stripe pixels on a board from a calibrated sheet."""
    pose, plate = estimate_pose(image, sensor.camera.model), sensor.air.target.plate_mm
    points = points_on_target(sensor.camera.model, [pixels], pose[None], plate_mm=plate).points_mm
    sheet = sensor.calibration.sheet
    return inlier_rms(points @ np.array(sheet.normal) - sheet.offset_mm)


def etna(measured: bool, folder: Path) -> Iterator[Row]:
    """Yield the rows of the photographs of a plate with a board and a stripe."""
    name = "`etna`"
    import_images(DATA / "etna", folder / "etna.h5", description=DATA / "etna.toml")
    with Capture(folder / "etna.h5") as capture:
        evidence = gather([capture], [], options=OPTIONS)
        stripes = find_stripes(capture)
        numbers = np.unique(stripes.frame)
        first, second = numbers[::2], numbers[1::2]
        air, count = evidence.air, len(numbers)
        if len(air.images) != count:
            raise SystemExit(f"error: the board is found in {len(air.images)} of {count} images")
        chosen = np.arange(0, count, 2)

        def only(some: np.ndarray) -> CalibrationResult:
            return solve(replace(evidence, air=air.only(some, [air.images[n] for n in some])), options=OPTIONS)

        groups = []
        for number in numbers:
            centre = np.full(capture.header.sensor.camera.height_px, np.nan)
            own = stripes[stripes.frame == number]
            centre[own.line] = own.centre_px
            groups.append(np.array(windows(centre)))
        yield from stripe_rows(name, (groups[::2], groups[1::2] if measured else []))
        yield from camera_rows(name, air.images, (1280, 1024), measured)

        sensor = only(chosen)
        left_out = [sheet_rms(only(chosen[chosen != n]), air.images[n], air.stripes[n]) for n in chosen]
        stated = [sensor.sheet.rms_mm] * len(chosen)
        found = [sheet_rms(sensor, air.images[n], air.stripes[n]) for n in chosen + 1] if measured else ()
        residual = "points of unused images from the sheet"
        yield Row.of(name, residual, "mm", left_out, found, others=len(second), stated=stated)
        reach = float(students_t.ppf(0.975, len(chosen) - 1)) * math.sqrt(2) * math.degrees(sensor.sheet.normal_std_rad)
        turned = None
        if measured:
            one, other = (np.array(each.calibration.sheet.normal) for each in (sensor, only(chosen + 1)))
            turned = math.degrees(math.acos(min(float(one @ other), 1.0)))
        yield Row(name, "angle between the sheets", "deg", None, (0.0, 0.0, reach), turned)

        poses = read_poses(DATA / "etna" / "poses.csv", pose_format="quaternion-xyzw", unit="m")[0]

        def profiles(some: np.ndarray) -> list[np.ndarray]:
            cloud = reconstruct_stripes(capture, stripes[np.isin(stripes.frame, some)], sensor.calibration)
            # Without a stage, positions count the images.
            at = cloud.points_mm - np.outer(capture.stage_mm[cloud.frame], capture.header.stage_direction)
            return [at[cloud.frame == n] for n in some]

        mount = uwlts.calibrate_mount(profiles(first), poses[::2], artefact_kind="plane")
        left_out = [pose.held_out_mm for pose in mount.poses if pose.held_out_mm]
        stated = [math.hypot(mount.point_std_mm, mount.pose_std_mm)] * len(left_out)
        found, plate = [], mount.artefact
        assert isinstance(plate, PlaneFound)
        for pose, seen in zip(poses[1::2], profiles(second) if measured else [], strict=measured):
            at = pose @ mount.transform()
            found.append(inlier_rms((seen @ at[:3, :3].T + at[:3, 3]) @ np.array(plate.normal) - plate.distance_mm))
        residual = "profiles of unused poses from the plate"
        yield Row.of(name, residual, "mm", left_out, found, others=len(second), stated=stated)


def gap_rows(measured: bool, folder: Path) -> Iterator[Row]:
    """Yield the row of the domain gap between the halves of the photographs."""
    for half in (0, 1):
        (folder / f"half{half}").mkdir()
        for number in range(1 + half, 17, 2):
            copy(DATA / "etna" / f"frame{number:04d}.jpg", folder / f"half{half}")
    halves = [folder / f"half{half}" for half in ((0, 1) if measured else (0,))]
    gap = measure_domain_gap([], real=halves)
    floor = gap.floors[0]
    limits = (floor.gap, floor.gap - 1.96 * floor.std, floor.gap + 1.96 * floor.std)
    found = next((each.gap for each in gap.gaps), None)
    yield Row("`etna`", "domain gap between the halves", "", None, limits, found)


def main(*, measured: bool = False, write: bool = False) -> None:
    """Print the expectations, or put them into the page; with the second halves if ``measured``."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        rows = [
            *single_images(measured),
            *ciclop_board(measured),
            *dot_rows(measured),
            *etna(measured, folder),
            *gap_rows(measured, folder),
        ]
    head = ["relative to the first", "to the stated"] if measured else []
    head = ["set", "residual", *(head or ("expected by the first half", "expected as stated"))]
    title = "real halves, measured" if measured else "real halves, expected"
    publish({title: table(head, name_once([row.cells() for row in rows]))}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
