"""Report of a campaign: numbers compared with calculations by hand, and a page that loads nothing."""

import base64
import gzip
import io
import json
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from matplotlib.colors import to_hex
from rich.console import Console

from uwlts.errors import CaptureError, DescriptionError, OutputError
from uwlts.evaluation.evaluate import StoredUncertainty, evaluate
from uwlts.model.any_calibration import calibration_digest
from uwlts.model.calibration import Calibration
from uwlts.model.library import load_sensor
from uwlts.model.sensor import Sensor
from uwlts.optics.nominal import nominal_calibration
from uwlts.pages.numbers import format_fixed, format_length, format_to_scale
from uwlts.pages.toolkit import figure_png, figure_svg, write_page
from uwlts.report import plot
from uwlts.report.campaign_page import conclude, report_page
from uwlts.report.campaign_tables import Row, print_table, summary_table
from uwlts.report.gather import gather_campaign, load_reference
from uwlts.report.pictures import MOST_POINTS, StripeView, cloud_points, draw_pictures, stripe_picture, write_pictures
from uwlts.report.summary_file import summary, write_summary
from uwlts.storage.capture import CaptureHeader, Frame
from uwlts.storage.capture_writer import CaptureWriter
from uwlts.storage.cloud import PointCloud
from uwlts.storage.cloud_files import write_cloud
from uwlts.storage.truth import Truth, TruthHeader, write_truth
from uwlts.stripe import extract_stripe

WIDTH, HEIGHT, IMAGES = 160, 120, 5
SPHERES = {"kind": "spheres", "diameters_mm": [50.12, 50.14], "spacings_mm": [99.18], "spacing_uncertainty_mm": 0.01}
STEP = {"kind": "step", "height_mm": 23.17}
# Exact points leave the fits only the rounding of their iteration, far below this.
FIT_MM = 1e-6


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    """Close figures that pyplot would show: it warns of more than twenty."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")


def small_sensor(window_mm: float = 47.3) -> Sensor:
    """The thesis's sensor with a small image and another window distance."""
    sensor = load_sensor("thesis")
    window = sensor.camera.window.model_copy(update={"distance_mm": window_mm})
    camera = sensor.camera.model_copy(update={"width_px": WIDTH, "height_px": HEIGHT, "window": window})
    return sensor.model_copy(update={"camera": camera})


def stripe_image(row: np.ndarray) -> np.ndarray:
    """A Gaussian stripe, sigma 1.2 px, at a row for each of the columns."""
    away = np.arange(HEIGHT)[:, None] - row
    return np.round(200 * np.exp(-0.5 * (away / 1.2) ** 2)).astype(np.uint8)


def write_capture(path, *, name="capture", artefact=None) -> None:
    header = CaptureHeader(
        name=name,
        sensor=small_sensor(),
        medium_name="water",
        medium=small_sensor().media["water"],
        stage_direction=(1, 0, 0),
        saturation_dn=255,
        artefact=artefact,
        provenance={"source": "test", "seed": 7},
    )
    with CaptureWriter(path, header, dtype=np.uint8) as writer:
        for number in range(IMAGES):
            row = 50.3 + 0.05 * np.arange(WIDTH) + number
            image = stripe_image(row) if number else np.zeros((HEIGHT, WIDTH), np.uint8)
            time = float(number)
            writer.append(Frame(image, stage_mm=time, laser_on=number > 0, exposure_ms=1.0, time_s=time))


def two_spheres(spacing: float) -> np.ndarray:
    """Return exact points (N, 3) on two caps that face the sensor, with centres one spacing from each other along Y."""
    across, around = np.meshgrid(np.radians(np.linspace(2, 55, 24)), np.linspace(0, 2 * np.pi, 60, endpoint=False))
    away = np.stack([np.sin(across) * np.cos(around), np.sin(across) * np.sin(around), -np.cos(across)], axis=-1)
    caps = [d / 2 * away.reshape(-1, 3) + (0, y, 30) for d, y in ((50.12, -spacing / 2), (50.14, spacing / 2))]
    return np.vstack(caps)


def step(height: float) -> np.ndarray:
    """Exact points of two treads, rows of constant X one after the other."""
    x, y = np.meshgrid(np.arange(IMAGES, dtype=float), np.linspace(-40, 40, 80), indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), np.where(y.ravel() < 0, 0.0, -height)])


def cloud_of(points: np.ndarray, capture: str, artefact: dict, calibration: Calibration) -> PointCloud:
    count = len(points)
    lines = np.arange(count) % (count // IMAGES + (count % IMAGES > 0))
    return PointCloud(
        points,
        np.full(count, 100),
        np.arange(count) * IMAGES // count,
        lines,
        metadata={
            "capture": capture,
            "sensor": "thesis",
            "medium": "water",
            "medium_index": 1.3312,
            "artefact": artefact,
            "calibration": calibration_digest(calibration),
        },
    )


def write_measurement(folder, name, points, artefact, calibration, *, truth=None, cloud_name=None):
    cloud = cloud_of(points, f"{name}.h5", artefact, calibration)
    evaluation = evaluate(cloud, artefact, truth, source=f"{name}.ply")
    evaluation.save(folder / f"{name}.evaluation.json")
    write_cloud(folder / f"{cloud_name or name}.ply", evaluation.cloud)
    return cloud


def calibration_at(distance: float, *, refractions: int = 2, **residuals) -> Calibration:
    nominal = nominal_calibration(small_sensor())
    window = nominal.window.model_copy(update={"distance_mm": distance, "refractions": refractions})
    return nominal.model_copy(update={"window": window, "residuals": residuals})


RESIDUALS = {
    "camera": {
        "rms_px": 0.0173,
        "image_rms_px": [0.02, 0.015, 0.01, 0.03],
        "std": {"f": 0.0041},
        "covariance": [[1.0]],
    },
    "sheet": {"rms_mm": 0.0065},
    "window": {
        "images": ["a", "b", "c", "<b>d</b>"],
        "std_mm": 0.0337,
        "errors_mm": [0.003, -0.004, 0.0, 0.0],
        "image_distances_mm": [47.2, None, 47.4, 47.5],
        "curve_mm": [[40.0, 0.1], [47.0, 0.02], [60.0, None]],
    },
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A campaign with two sphere measurements, one more with another calibration, and a step with truth."""
    folder = tmp_path_factory.mktemp("campaign")
    main = calibration_at(47.35, **RESIDUALS)
    other = calibration_at(45.0, refractions=1)
    main.save(folder / "calibration.json")
    other.save(folder / "calibration-one-refraction.json")
    for name, spacing, calibration in (
        ("spheres-near", 99.21, main),
        ("spheres-far", 99.17, main),
        ("spheres-one", 99.68, other),
    ):
        write_capture(folder / f"{name}.h5", artefact=SPHERES)
        write_measurement(folder, name, two_spheres(spacing), SPHERES, calibration)
    points = step(23.18)
    # The true lower tread, half of the points, is 0.02 mm deeper; the upper one is exact.
    lower = points[:, 1] < 0
    true = (points + np.where(lower, 0.02, 0.0)[:, None] * (0, 0, 1)).reshape(IMAGES, 80, 3)
    nothing = np.zeros((IMAGES, 80))
    truth = Truth(
        centre_px=nothing,
        point_mm=true,
        normal=np.tile((0.0, 0.0, -1.0), (IMAGES, 80, 1)),
        status=nothing.astype(np.uint8),
        crossings=nothing.astype(int) + 1,
        depth_mm=np.zeros((HEIGHT, WIDTH)),
    )
    write_measurement(folder, "step", points, STEP, main, truth=truth)
    write_truth(
        folder / "step.truth.h5",
        TruthHeader(sensor=small_sensor(), medium=small_sensor().media["water"], scene={}),
        truth,
    )
    (folder / "seconds.json").write_text('{"render": 12.5, "reconstruct": 1}')
    return folder


@pytest.fixture(scope="module")
def campaign(folder):
    return gather_campaign(folder)


@pytest.fixture(scope="module")
def page(campaign):
    return report_page(campaign, load_reference("thesis"))


# Gathering


def test_related_files_are_found_by_their_names(campaign):
    found = {m.name: m for m in campaign.measurements}
    assert sorted(found) == ["spheres-far", "spheres-near", "spheres-one", "step"]
    near = found["spheres-near"]
    assert near.capture.name == "spheres-near" and near.calibration.name == "calibration"
    assert near.capture.laser_images == (1, 2, 3, 4)
    assert found["spheres-one"].calibration.name == "calibration-one-refraction"
    assert found["step"].capture is None and found["step"].judged.truth.matched == 400
    assert [c.name for c in campaign.calibrations] == ["calibration", "calibration-one-refraction"]
    assert campaign.main_calibration.name == "calibration"
    assert campaign.seconds == {"render": 12.5, "reconstruct": 1.0}


def test_a_coloured_copy_takes_the_place_of_its_cloud(tmp_path):
    calibration = calibration_at(47.35)
    plain = write_measurement(tmp_path, "scan", two_spheres(99.2), SPHERES, calibration, cloud_name="scan-coloured")
    write_cloud(tmp_path / "scan.ply", plain)
    write_cloud(tmp_path / "else.ply", replace(plain, points_mm=plain.points_mm + 1))
    found = {m.name: m for m in gather_campaign(tmp_path).measurements}
    assert sorted(found) == ["else", "scan"]
    assert found["scan"].cloud.deviation_mm is not None and found["else"].judged is None


def test_an_evaluation_of_another_name_finds_its_cloud(tmp_path):
    write_measurement(tmp_path, "scan", two_spheres(99.2), SPHERES, calibration_at(47.35))
    (tmp_path / "scan.evaluation.json").rename(tmp_path / "first.evaluation.json")
    (only,) = gather_campaign(tmp_path).measurements
    assert only.name == "first" and only.cloud is not None


def test_truths_that_disagree_give_no_true_sensor(campaign):
    same, other = small_sensor(), small_sensor(48.0)
    assert replace(campaign, true_sensors=(same, same)).true_sensor == same
    assert replace(campaign, true_sensors=(same, other)).true_sensor is None
    bare = same.camera.model_copy(update={"window": same.camera.window.model_copy(update={"mounted": False})})
    without = same.model_copy(update={"camera": bare})
    assert replace(campaign, true_sensors=(same, without)).true_sensor == same


@pytest.mark.parametrize(
    "name",
    [
        "spheres-near.h5",
        "spheres-near.ply",
        "spheres-near.evaluation.json",
        "calibration.json",
        "step.truth.h5",
        "seconds.json",
    ],
)
def test_a_truncated_file_is_named(folder, tmp_path, name):
    content = (folder / name).read_bytes()
    (tmp_path / "calibration-a.json").write_bytes((folder / "calibration-one-refraction.json").read_bytes())
    assert gather_campaign(tmp_path).calibrations
    (tmp_path / name).write_bytes(content[: 2 * len(content) // 3])
    with pytest.raises(CaptureError, match=re.escape(name)):
        gather_campaign(tmp_path)


@pytest.mark.parametrize(
    "change",
    [{"evaluation": {"kind": "spheres"}}, {"truth": {"matched": "?"}}, {"artefact": {"kind": "cube"}}, {"cloud": None}],
)
def test_an_evaluation_with_the_wrong_content_is_named(folder, tmp_path, change):
    content = json.loads((folder / "spheres-near.evaluation.json").read_text()) | change
    del content["sha256"]
    (tmp_path / "odd.evaluation.json").write_text(json.dumps(content))
    with pytest.raises(CaptureError, match=r"odd\.evaluation\.json.*evaluate the cloud again"):
        gather_campaign(tmp_path)


@pytest.mark.parametrize("text", ["[1]", '{"render": "long"}', '{"render": -1}', '{"render": NaN}'])
def test_seconds_must_be_numbers(folder, tmp_path, text):
    (tmp_path / "calibration.json").write_bytes((folder / "calibration.json").read_bytes())
    (tmp_path / "seconds.json").write_text(text)
    with pytest.raises(CaptureError, match="seconds of each stage"):
        gather_campaign(tmp_path)


def test_a_folder_without_results_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="there is no folder"):
        gather_campaign(tmp_path / "missing")
    with pytest.raises(CaptureError, match="holds 0 captures, but no cloud"):
        gather_campaign(tmp_path)
    write_capture(tmp_path / "scan.h5")
    with pytest.raises(CaptureError, match="holds 1 captures, but no cloud"):
        gather_campaign(tmp_path)


# Figures


def test_key_figures_are_those_worked_out_by_hand(campaign):
    content = summary(campaign, load_reference("thesis")).model_dump()
    spacing = content["sphere_spacing_error_mm"]
    # 99.21 and 99.17 against 99.18; the third measurement belongs to the other calibration.
    assert spacing["by_measurement"] == pytest.approx({"spheres-near": 0.03, "spheres-far": -0.01}, abs=FIT_MM)
    assert spacing["mean_abs"] == pytest.approx(0.02, abs=FIT_MM)
    other = content["other_calibrations"]["calibration-one-refraction"]
    assert other["sphere_spacing_error_mm"]["mean_abs"] == pytest.approx(0.5, abs=FIT_MM)
    assert content["step_height_error_mm"]["by_measurement"] == pytest.approx({"step": 0.01}, abs=FIT_MM)
    assert content["probing_error_mm"]["mean_abs"] == pytest.approx(0, abs=FIT_MM)
    assert set(content["std_mm"]["by_measurement"]) == {"spheres-near", "spheres-far", "step"}
    assert content["pipe_diameter_error_mm"] == {"mean_abs": None, "by_measurement": {}}
    assert content["window_distance_mm"] == {"estimated": 47.35, "true": 47.3}
    assert content["points"]["step"]["total"] == 400
    assert content["seconds"] == {"render": 12.5, "reconstruct": 1.0}
    # The published means: (0.08 + 0.06 + 0.23 + 0.18) / 4.
    published = content["published"]["sphere_spacing_error_mm"]
    assert published["by_measurement"] == {"spheres-near": (0.08, 0.06), "spheres-far": (0.23, 0.18)}
    assert published["mean_abs"] == pytest.approx(0.1375)


def test_the_truth_is_pooled_over_points(campaign):
    truth = summary(campaign).model_dump()["truth"]
    # Half of the points are 0.02 mm off, the others exact: rms 0.02 / sqrt(2).
    assert truth["share_within_tolerance"] == pytest.approx(0.5)
    assert truth["rms_mm"] == pytest.approx(0.02 / math.sqrt(2), rel=1e-6)
    # A small turn a about X moves the points by a (-z, y); least squares for the wanted (0, w), all about the middle.
    points = step(23.18)
    wanted = np.where(points[:, 1] < 0, 0.02, 0.0) - 0.01
    y, z = (points[:, 1:] - points[:, 1:].mean(axis=0)).T
    left = wanted - y * (y @ wanted) / (y @ y + z @ z)
    # The rotation of 0.0004 rad is small: relative errors are of this order.
    assert truth["after_best_fit"]["rms_mm"] == pytest.approx(np.sqrt(np.mean(left**2)), rel=1e-3)
    step_only = next(m for m in campaign.measurements if m.name == "step")
    better = {"matched": 1200, "share_within_tolerance": 1.0, "rms_mm": 0.0, "after_best_fit": None}
    figures = step_only.judged.truth.model_copy(update=better)
    exact = replace(step_only, name="more", judged=step_only.judged.model_copy(update={"truth": figures}))
    pooled = summary(replace(campaign, measurements=(step_only, exact))).model_dump()["truth"]
    # 200 of 400 and 1200 of 1200 points; the squares of 400 points over 1600.
    assert pooled["share_within_tolerance"] == pytest.approx(1400 / 1600)
    assert pooled["rms_mm"] == pytest.approx(0.01 / math.sqrt(2), rel=1e-6)
    # A best fit is given for one of the two only.
    assert pooled["after_best_fit"]["rms_mm"] is None


def test_the_summary_is_json_and_written_once(campaign, tmp_path):
    path = tmp_path / "summary.json"
    write_summary(path, campaign)
    assert json.loads(path.read_text())["published"] is None
    with pytest.raises(OutputError, match="exists already"):
        write_summary(path, campaign)


def test_rows_hold_true_measured_error_and_published(campaign):
    table = summary_table(campaign, load_reference("thesis"))
    rows = {(row.measurement, row.quantity): row.texts()[2:] for row in table}
    assert rows["spheres-near", "sphere spacing"] == ("99.180", "99.210", "+0.030", "-", "0.08, 0.06")
    assert rows["spheres-far", "sphere spacing"] == ("99.180", "99.170", "-0.010", "-", "0.23, 0.18")
    assert rows["spheres-near", "diameter, sphere 2"] == ("50.140", "50.140", "0.000", "-", "-")
    assert rows["spheres-near", "deviations STD"] == ("-", "0.000", "-", "-", "0.12, 0.14")
    assert rows["step", "step height"] == ("23.170", "23.180", "+0.010", "-", "-")
    # The fraction is that after the best-fit motion, if any; the motion removes a part of the distances.
    assert ("step", "within 0.010 of truth") not in rows
    assert float(rows["step", "within 0.010 after best fit"][1].removesuffix(" %")) > 50
    assert float(rows["step", "rms distance after best fit"][1]) < 0.014
    assert rows["step", "rms distance to truth"] == ("-", "0.014", "-", "-", "-")
    assert rows["calibration", "window distance"] == ("47.300", "47.350", "+0.050", "-", "40.7")
    # No true distance of a single interface exists, and the published one is for two refractions.
    assert rows["calibration-one-refraction", "interface distance (1 refraction)"] == ("-", "45.000", "-", "-", "-")


def test_stated_uncertainties_are_shown_beside_measured_errors(campaign):
    one = next(m for m in campaign.measurements if m.name == "spheres-near")
    known = {"SSE": StoredUncertainty(random_mm=0.01, systematic_mm=0.02, expanded_mm=0.0447)}
    judged = one.judged.model_copy(update={"uncertainty": known})
    stating = replace(campaign, measurements=(replace(one, judged=judged),))
    rows = {row.quantity: row.texts()[2:6] for row in summary_table(stating)}
    assert rows["sphere spacing"] == ("99.180", "99.210", "+0.030", "0.045")
    assert rows["diameter, sphere 2"] == ("50.140", "50.140", "0.000", "-")
    page = report_page(stating)
    assert page.count("U (k = 2)") == 2
    assert "<td>+30.0 µm</td><td>44.7 µm</td>" in page


def test_the_conclusion_counts_errors_within_their_uncertainty():
    rows = [
        Row("a", "step height", error=-0.01, stated=0.02),
        Row("b", "step height", error=0.03, stated=0.02),
        Row("c", "step height", error=0.3),
    ]
    said = conclude(rows)
    assert "1 of 2 errors" in said and "1.50 (step height of b)" in said
    assert "none can be judged" in conclude(rows[2:])
    certified = [Row("b", "step height", error=0.03, stated=0.03, uncertainty=0.04)]
    assert "1 of 1 errors" in conclude(certified) and "0.60 (step height of b)" in conclude(certified)


def test_published_values_are_found_by_the_captures_name(campaign):
    one = next(m for m in campaign.measurements if m.name == "spheres-near")
    renamed = replace(campaign, measurements=(replace(one, name="again"),))
    rows = summary_table(renamed, load_reference("thesis"))
    assert next(row for row in rows if row.quantity == "sphere spacing").published == (0.08, 0.06)


def test_the_table_prints_on_a_dumb_terminal(campaign, capsys, monkeypatch):
    monkeypatch.setenv("TERM", "dumb")
    print_table(summary_table(campaign, load_reference("thesis")))
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert max(map(len, text.splitlines())) <= 110
    row = next(line.split() for line in text.splitlines() if "spheres-near" in line)
    assert row == ["spheres-near", "sphere", "spacing", "99.180", "99.210", "+0.030", "-", "0.08,", "0.06"]
    assert len([line for line in text.splitlines() if "sphere spacing" in line]) == 3


def test_markup_in_a_name_is_printed_as_it_is(campaign):
    named = replace(campaign.measurements[0], name="[red]scan[/red]")
    out = io.StringIO()
    console = Console(file=out, width=110)
    print_table(summary_table(replace(campaign, measurements=(named,))), console=console)
    assert "[red]scan[/red]" in out.getvalue()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("title = 3", "title: .*valid string"),
        ("spheres = 0.1", "spheres: .*valid dictionary"),
        ('[s]\nSSE = ["a"]', "SSE.*valid number"),
        ("[s]\nSSE = [nan]", "SSE.*finite number"),
        ("[s]\nSSE = [true]", "SSE.*valid number"),
    ],
)
def test_a_reference_of_the_wrong_form_is_refused(tmp_path, text, says):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(DescriptionError, match=says):
        load_reference(path)
    with pytest.raises(DescriptionError, match="nothing is called"):
        load_reference("nobody")


# Page


class Tags(HTMLParser):
    """Collect every start tag with its attributes, the text of styles and scripts, and all other text."""

    def __init__(self, page: str):
        super().__init__()
        self.tags, self.styles, self.json, self.text = [], [], [], []
        self.within = None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.within = (tag, dict(attrs)) if tag in ("style", "script") else None

    def handle_endtag(self, tag):
        self.within = None

    def handle_data(self, data):
        if self.within is None:
            self.text.append(data)
        elif self.within[0] == "style":
            self.styles.append(data)
        elif self.within[1].get("type") == "application/json":
            self.json.append(data)


FETCHING = ("src", "href", "srcset", "data", "poster", "action", "background", "xlink:href", "formaction")


def test_the_page_loads_nothing_from_the_network(page):
    found = Tags(page)
    addresses = [value for _, attrs in found.tags for name, value in attrs.items() if name in FETCHING]
    assert len(addresses) > 10
    assert all(value.startswith(("data:image/webp;base64,", "#")) for value in addresses)
    styles = " ".join([*found.styles, *(attrs.get("style", "") for _, attrs in found.tags)])
    assert len(styles) > 1000 and "url(" not in styles and "@import" not in styles
    policy = next(attrs["content"] for tag, attrs in found.tags if attrs.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'") and "http" not in policy
    assert not {"link", "iframe", "object", "embed", "base"} & {tag for tag, _ in found.tags}


def unpacked(text: str) -> bytes:
    return gzip.decompress(base64.b64decode(text))


def test_every_place_has_its_cloud_and_its_picture(page):
    found = Tags(page)
    clouds = [json.loads(text) for text in found.json]
    places = [int(attrs["data-cloud"]) for _, attrs in found.tags if "data-cloud" in attrs]
    # Only clouds are interactive: one of each measurement.
    assert places == list(range(len(clouds))) and len(clouds) == 4
    assert sum(attrs.get("class") == "still" for _, attrs in found.tags) == 4
    assert all(cloud["unit"] in ("mm", "µm") and cloud["limits"][0] == -cloud["limits"][1] for cloud in clouds)
    # Histogram and profile of four measurements, the window's curve, three lists of residuals, and the time.
    assert sum(tag == "svg" for tag, _ in found.tags) == 2 * 4 + 1 + 3 + 1


def test_the_page_is_small(page, campaign):
    """A page of eleven measurements with 25,000 points each has at most 3 MB with these limits of its parts."""
    scripts = dict(re.findall(r'id="script-(\w+)">([^<]*)<', page))
    assert list(scripts) == ["three", "vue", "view"] and b"WebGLRenderer" in unpacked(scripts["three"])
    libraries, pictures = sum(map(len, scripts.values())), re.findall(r'"data:image/webp;base64,[^"]*"', page)
    assert libraries < 400e3
    # Three captures hold the same images, and show them once.
    assert len(pictures) == 4 + 1 and page.count("both are from the same images") == 2
    svg = [len(each) for each in re.findall(r"<svg.*?</svg>", page, re.S)]
    assert max(svg) < 25e3
    clouds = {m.name: len(m.cloud) for m in campaign.measurements}
    data = [len(json.loads(text)["data"]) for text in Tags(page).json]
    # Less than six characters a point: four columns of 16 bit take eleven as they are.
    assert sum(data) < 6 * sum(clouds.values()) and len(data) == len(clouds)
    rest = len(page) - libraries - sum(map(len, pictures)) - sum(svg) - sum(data)
    assert 0 < rest < 60e3


def test_the_conclusion_comes_first_and_repeated_units_last(page):
    order = [
        "<h1>",
        "<strong>20",
        "no error has a stated uncertainty",
        'class="tiles"',
        'id="measurement-1"',
        "data-cloud",
        'id="calibration"',
        'id="results"',
        'class="main"',
        'id="appendix"',
        "figures of the artefact",
        ">unit<",
        "digest ",
    ]
    body = page[page.index("<main>") :]
    places = [body.index(each) for each in order]
    assert places == sorted(places)
    # Units of single values, units of rows, and digests are in the appendix alone.
    assert not re.search(r">unit<|[0-9a-f]{64}", body[: body.index('id="appendix"')])
    # Measurements with the calibration of the campaign come before others.
    names = re.findall(r'<h2 id="measurement-\d">([^<]*)', body)
    assert names == ["spheres-far", "spheres-near", "step", "spheres-one"]
    assert re.findall(r'scope="rowgroup"[^>]*>([^<]*)', body)[:4] == names


def test_the_interactive_clouds_work_offline(page, campaign, tmp_path, chromium):
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    context = chromium.new_context(viewport={"width": 1000, "height": 800}, offline=True)
    shown, said = context.new_page(), []
    shown.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    shown.on("pageerror", lambda error: said.append(str(error)))
    shown.goto((tmp_path / "report.html").as_uri())
    view = shown.locator(".cloud-figure").nth(0)
    shown.locator("figure:has(.cloud-figure)").nth(0).scroll_into_view_if_needed()
    count = len(next(m.cloud for m in campaign.measurements if m.name == "spheres-far"))
    view.locator(f'.cloud-view[data-points="{count}"]').wait_for()
    # The picture makes room for the view; without its script it would be seen.
    assert shown.locator(".still").nth(0).is_hidden()
    before = view.screenshot()
    view.locator(".cloud-view").press("ArrowLeft")
    after = view.screenshot()
    # The colours of the points, not the background, cover part of the view, and move when it is turned.
    one, two = (cv2.imdecode(np.frombuffer(each, np.uint8), cv2.IMREAD_COLOR).astype(int) for each in (before, after))
    assert (one.max(axis=2) > 100).sum() > 500 and (np.abs(one - two).max(axis=2) > 50).sum() > 500
    assert not said and shown.evaluate("document.documentElement.scrollWidth <= innerWidth")
    shown.emulate_media(media="print")
    assert shown.locator(".still").nth(0).is_visible() and view.is_hidden()
    context.close()


def test_plots_have_units_on_their_axes(campaign):
    cloud = next(m.cloud for m in campaign.measurements if m.name == "step")
    calibration = campaign.main_calibration.calibration
    lists = plot.residual_lists(calibration)
    assert [(each.group, each.name) for each in lists] == [
        ("camera", "image_rms_px"),
        ("window", "errors_mm"),
        ("window", "image_distances_mm"),
    ]
    flat = [
        plot.deviation_histogram(cloud),
        plot.along_stripe(cloud),
        plot.window_curves({"main": calibration}),
        plot.seconds({"render": 1.0}),
        *(plot.residuals(calibration, which=each) for each in lists),
    ]
    counts = {"points per bin", "image", ""}
    titles = [title for ax in flat for title in (ax.get_xlabel(), ax.get_ylabel())]
    assert all(title in counts or title.split(" / ")[-1] in ("mm", "µm", "px", "s") for title in titles)
    solid = plot.cloud(cloud)
    assert [solid.get_xlabel(), solid.get_ylabel(), solid.get_zlabel()] == ["X / mm", "Y / mm", "Z / mm"]


def test_the_page_shows_the_figures_of_the_summary(page):
    text = re.sub(r"\s+", " ", " ".join(Tags(page).text))
    for expected in (
        "99.210",
        "+0.030",
        "\N{MINUS SIGN}0.010",
        "0.08, 0.06",
        "Matos 2017",
        "47.350",
        "20.0 µm",
        "50.00 %",
        "n = 1.33120",
        "25 °C",
        "2358.4906 ± 0.0041",
        "seed 7",
        "0.0173",
        "not in the folder",
        "true 47.300 mm",
    ):
        assert expected in text, expected


def test_the_curve_shows_estimate_and_truth(campaign):
    ax = plot.window_curves({c.name: c.calibration for c in campaign.calibrations}, true_mm=47.3)
    curve, estimate, truth = ax.lines
    # The root mean square of 3, -4, 0 and 0 um is 2.5 um.
    assert estimate.get_xydata().tolist() == [pytest.approx([47.35, 0.0025])]
    assert list(curve.get_xdata()) == [40.0, 47.0, 47.35, 60.0] and math.isnan(curve.get_ydata()[-1])
    assert list(truth.get_xdata()) == [47.3, 47.3]


def test_text_from_files_is_escaped(page, tmp_path):
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>"
    campaign_folder = tmp_path / "<b>folder"
    campaign_folder.mkdir()
    calibration = calibration_at(47.35, **RESIDUALS).model_copy(
        update={"sensor_name": evil, "provenance": {"source": evil, "warnings": [evil]}}
    )
    calibration.save(campaign_folder / "calibration<b>.json")
    name = "<img src=x onerror=alert(3)>"
    write_capture(campaign_folder / f"{name}.h5", name=evil)
    write_measurement(campaign_folder, name, two_spheres(99.2), SPHERES, calibration)
    (campaign_folder / "seconds.json").write_text(json.dumps({evil: 1}))
    found = Tags(report_page(gather_campaign(campaign_folder)))
    plain = Tags(page)
    assert {tag for tag, _ in found.tags} <= {tag for tag, _ in plain.tags} | {"ul", "li"}
    assert not any(name.startswith("on") for _, attrs in found.tags for name in attrs)
    assert not any(attrs.get("src") == "x" for _, attrs in found.tags)
    assert evil in " ".join(found.text) and name in " ".join(found.text)
    # Nothing in a script may end it.
    assert all("<" not in figure for figure in found.json)


def test_formulas_in_names_are_drawn_as_they_are():
    ax = plot.seconds({"a $x^2$": 1.0, "b $": 2.0})
    assert "a $x^2$" in figure_svg(ax.figure) and "b $" in figure_svg(ax.figure)


def test_the_page_is_written_once(campaign, tmp_path):
    path, little = tmp_path / "report.html", report_page(replace(campaign, measurements=()))
    write_page(path, little)
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    with pytest.raises(OutputError, match="exists already"):
        write_page(path, little)
    write_page(path, little, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]


def test_a_campaign_may_hold_a_calibration_alone(folder, tmp_path):
    (tmp_path / "calibration.json").write_bytes((folder / "calibration.json").read_bytes())
    campaign = gather_campaign(tmp_path)
    assert summary(campaign).sphere_spacing_error_mm.mean_abs is None
    assert "window distance" in report_page(campaign)


# Pictures


def test_pictures_are_written_for_existing_results(campaign, tmp_path):
    pictures = draw_pictures(campaign)
    written = write_pictures(tmp_path, pictures)
    spheres = ("spheres-near", "spheres-far", "spheres-one")
    names = {f"{kind}-{name}.png" for name in spheres for kind in ("stripe", "cloud")}
    assert {path.name for path in written} == names | {"cloud-step.png"}
    for path in written:
        picture = cv2.imread(str(path))
        assert picture.shape[1] == 1120 and picture.std() > 5
    # Two processes draw what one draws.
    again = draw_pictures(campaign, workers=2)
    assert again == pictures
    with pytest.raises(OutputError, match="exists already"):
        write_pictures(tmp_path, again)


def test_centres_are_drawn_where_the_light_is():
    row = 60.37 + 0.02 * np.arange(WIDTH)
    image = stripe_image(row)
    found = extract_stripe(image, stripe_along="width")
    for enlarged in (False, True):
        ax = plot.stripe(image, found, enlarged=enlarged)
        columns, centres = ax.lines[0].get_xydata().T
        assert len(columns) > 40
        # Image coordinates, whole numbers at pixel centres; the stripe is found to far better than 0.05 px.
        assert np.abs(centres - row[columns.astype(int)]).max() < 0.05
        assert tuple(ax.images[0].get_extent()) == (-0.5, WIDTH - 0.5, HEIGHT - 0.5, -0.5)
        (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
        assert left < columns.min() < columns.max() < right and top < centres.min() < centres.max() < bottom


def test_the_enlarged_part_is_marked_and_shows_lines_of_the_image():
    image = stripe_image(60.37 + 0.02 * np.arange(WIDTH))
    upper, lower = stripe_picture(StripeView(3, image, extract_stripe(image, stripe_along="width"))).axes
    (mark,) = upper.patches
    assert mark.get_bbox().intervalx.tolist() == list(lower.get_xlim())
    assert mark.get_bbox().intervaly.tolist() == sorted(lower.get_ylim())
    assert "image 3" in upper.get_title()
    assert np.array_equal(lower.images[0].get_array(), image)
    assert np.array_equal(upper.images[0].get_array(), np.sqrt(image.astype(np.float32)))


def test_a_standing_stripe_is_shown_lying():
    image = stripe_image(60.37 + 0.02 * np.arange(WIDTH))
    lying = plot.stripe(image, extract_stripe(image, stripe_along="width"))
    turned = np.ascontiguousarray(image.T)
    standing = plot.stripe(turned, extract_stripe(turned, stripe_along="height"))
    assert np.array_equal(lying.images[0].get_array(), standing.images[0].get_array())
    assert np.array_equal(lying.lines[0].get_xydata(), standing.lines[0].get_xydata())
    # Only the names of the axes are exchanged.
    assert (lying.get_xlabel(), lying.get_ylabel()) == (standing.get_ylabel(), standing.get_xlabel())


def test_the_cloud_picture_shows_both_signs_on_their_sides():
    x, y = map(np.ravel, np.meshgrid(np.linspace(-10, 10, 60), np.linspace(-40, 40, 200)))
    nothing = np.zeros(len(x), int)
    cloud = PointCloud(np.column_stack([x, y, 0 * x]), nothing, nothing, nothing, deviation_mm=0.01 * np.sign(y))
    encoded = np.frombuffer(figure_png(plot.cloud(cloud).figure), np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_COLOR)[:, :950].astype(int)
    red = np.argwhere(picture[:, :, 2] - picture[:, :, 0] > 80)
    blue = np.argwhere(picture[:, :, 0] - picture[:, :, 2] > 80)
    assert min(len(red), len(blue)) > 5000
    # Y runs to the right.
    assert red[:, 1].mean() > blue[:, 1].mean() + 200


@pytest.mark.parametrize("colour", ["deviation", "depth", "intensity", "uncertainty"])
def test_clouds_are_coloured_by_any_known_attribute(colour):
    nothing = np.zeros(3, int)
    cloud = PointCloud(np.eye(3), np.array([10.0, 20.0, 30.0]), nothing, nothing)
    ax = plot.cloud(cloud, colour=colour)
    (drawn,) = ax.collections
    # Without deviations or uncertainties all points have one colour.
    assert (drawn.get_array() is None) == (colour in ("deviation", "uncertainty"))
    if colour == "intensity":
        assert sorted(drawn.get_array()) == [10, 20, 30]


@pytest.mark.parametrize("count", [0, 1, 2])
def test_clouds_of_hardly_any_points_can_be_drawn(count):
    nothing = np.zeros(count, int)
    cloud = PointCloud(np.ones((count, 3)), nothing, nothing, nothing)
    assert figure_png(plot.cloud(cloud).figure).startswith(b"\x89PNG")
    assert json.loads(cloud_points(cloud)[0].to_json())["count"] == count


def test_pyplot_shows_plots_and_no_figures_of_pages():
    from matplotlib import pyplot

    rng = np.random.default_rng(0)
    cloud = PointCloud(rng.normal(size=(30, 3)), np.ones(30), np.zeros(30, int), np.arange(30))
    cloud = replace(cloud, deviation_mm=rng.normal(size=30))
    for draw in (plot.cloud, plot.deviation_histogram):
        ax = draw(cloud)
        assert pyplot.get_fignums() == [ax.figure.number]
        figure_svg(ax)
        assert pyplot.get_fignums() == []


def test_the_cloud_is_decimated_and_decoded_to_a_small_step():
    rng = np.random.default_rng(1)
    count = 2 * MOST_POINTS
    points = rng.uniform((-5, -60, 300), (25, 60, 340), (count, 3))
    deviation = rng.normal(0, 0.003, count)
    deviation[::10] = np.nan
    cloud = PointCloud(points, deviation, np.zeros(count), np.zeros(count), deviation_mm=deviation)
    shown, caption = cloud_points(cloud)
    assert len(shown.points_mm) == MOST_POINTS
    assert f"{MOST_POINTS:,} of {count:,} points" in caption and "not evaluated" in caption
    # Two standard deviations of single-precision values, in micrometres.
    assert shown.limit == pytest.approx(2e3 * np.nanstd(deviation), rel=1e-5) and shown.unit == "µm"
    found = json.loads(shown.to_json())
    stored = np.frombuffer(unpacked(found["data"]), np.uint8).reshape(4, 2, MOST_POINTS).astype(np.uint16)
    numbers = np.cumsum((stored[:, 0] | stored[:, 1] << 8).astype(np.int64), axis=1).astype(np.int16)
    values = np.where(numbers == -(2**15), np.nan, numbers * np.c_[found["step"]] + np.c_[found["offset"]])
    # Each range has 16382 steps; rounding is at most half a step.
    assert found["step"] == pytest.approx(
        np.nanmax(np.diff(np.nanquantile(values, [0, 1], axis=1), axis=0), axis=0) / 16382
    )
    for column, exact in zip(values, [*shown.points_mm.T, shown.values], strict=True):
        assert np.nanmax(np.abs(column - exact)) <= 0.5001 * np.ptp(exact[np.isfinite(exact)]) / 16382
        assert np.array_equal(np.isnan(column), np.isnan(exact))


def test_the_histogram_counts_every_point_once():
    deviation = np.r_[np.random.default_rng(2).normal(0.01, 0.002, 5000), 0.1, np.nan]
    nothing = np.zeros(len(deviation), int)
    cloud = PointCloud(np.zeros((len(deviation), 3)), nothing, nothing, nothing, deviation_mm=deviation)
    ax = plot.deviation_histogram(cloud)
    (bars,) = ax.patches
    beyond = int(re.search(r"(\d+) of 5,001 outside", bars.get_label()).group(1))
    assert beyond >= 1 and bars.get_data().values.sum() == 5001 - beyond
    with pytest.raises(ValueError, match="evaluate it first"):
        plot.deviation_histogram(replace(cloud, deviation_mm=None))


def test_colours_are_symmetric_and_end_at_the_limit():
    shown = plot.DEVIATIONS(np.array([-2.0, 0.0, 0.5, 1.0, 4.0]))
    assert shown[0].tolist() == shown[1].tolist() and shown[3].tolist() == shown[4].tolist()
    assert shown[0][2] > shown[0][0] and shown[3][0] > shown[3][2] and np.ptp(shown[2, :3]) < 0.03
    assert plot.colour_limit_mm(np.array([-0.01, 0.01, np.nan])) == pytest.approx(0.02)
    points, nothing = np.arange(9.0).reshape(3, 3), np.zeros(3, int)
    cloud = PointCloud(points, nothing, nothing, nothing, deviation_mm=np.array([-0.01, 0.01, np.nan]))
    unknown, known = plot.cloud(cloud).collections
    assert known.get_clim() == pytest.approx((-20, 20)) and sorted(known.get_array()) == pytest.approx([-10, 10])
    assert to_hex(unknown.get_facecolor()) == plot.UNKNOWN
    assert to_hex(plot.cloud(replace(cloud, deviation_mm=None)).collections[0].get_facecolor()) == plot.PLAIN


# Numbers


@settings(deadline=None)
@given(st.floats(min_value=-1e6, max_value=1e6), st.integers(0, 6), st.booleans())
def test_fixed_numbers_are_near_and_have_no_negative_zero(value, decimals, signed):
    text = format_fixed(value, decimals, signed=signed)
    # Half of the last decimal, and the rounding of a double near a million.
    assert abs(float(text) - value) <= 0.5 * 10**-decimals + 1e-9
    assert (text[0] in "+-") == (float(text) < 0 or (signed and float(text) > 0))


def test_lengths_choose_their_unit():
    assert format_length(0.0123456) == "12.3 µm" and format_length(-0.00002, signed=True) == "-0.02 µm"
    assert (
        format_length(1.5, signed=True) == "+1.500 mm" and format_length(None) == "-" and format_fixed(math.nan) == "-"
    )
    assert format_to_scale(0.123456, 1.58) == "0.12" and format_to_scale(7.0, 0.0) == "7.000"
