"""Every command line and Python block of the documentation runs, in the order of its page, or is listed with a reason.

Pages that take recordings for granted share one small campaign, made by the same commands: fewer pixels, places of the
stage and samples. `test_documented_hardware.py` runs the pages that need a camera and a stage, with the twin as both.
"""

import csv
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import uwlts
from tests.documented import PAGES, ROOT, blocks, name_of
from tests.system.documented_runs import Campaign, Page, Runner, run_page, write_small_descriptions
from tests.system.in_process import shared_workers
from tests.system.test_camera_command import TARGET as BOARD
from tests.system.test_documented_hardware import PAGES_RUN as HARDWARE_PAGES
from tests.system.test_imported_calibration import CHESSBOARD, photographs, poses
from tests.uwlts.mount_views import RADIUS_MM, SPHERE_MM, STANDOFF_MM, profile_of, sphere_campaign
from tests.uwlts.storage.test_template import answered

pytestmark = pytest.mark.slow

CAMPAIGN = """
twin simulate target --as-built thesis-as-built --out target-air.h5
twin simulate target-through-window --medium water --as-built thesis-as-built --out target-water.h5
twin simulate step --placement near far --as-built thesis-as-built --out 'step-{placement}.h5'
twin simulate step --placement near --seed 1 --as-built thesis-as-built --out step-today.h5
twin simulate spheres --placement near --as-built thesis-as-built --out spheres.h5
twin simulate spheres --placement standoff --seed 1 --as-built thesis-as-built --out today.h5
twin simulate pipe --as-built thesis-as-built --out pipe.h5
twin simulate plane --as-built thesis-as-built --out plane.h5
twin simulate weld --as-built thesis-as-built --out weld.h5
twin simulate robot-sphere --sensor thesis-small --out robot.h5
twin simulate vehicle-pass --sensor thesis-small --out pass.h5
uwlts calibrate --air target-air.h5 --water target-water.h5 --step step-near.h5 step-far.h5 --out joint.json
uwlts certificate joint.json --out certificate.html
uwlts reconstruct spheres.h5 --calibration joint.json --out spheres.cloud.h5
uwlts reconstruct pipe.h5 --calibration joint.json --out pipe.cloud.h5
uwlts reconstruct weld.h5 --calibration joint.json --out weld.cloud.h5
twin sweep baseline-angle
twin dataset small-set.toml --scenes 1 --out runs/turbid
"""
SMALL_SET = """
licence = "CC0-1.0"
sensor = "thesis-small"
scene = "shapes"
spp = 2
splits = { train = 0.8, test = 0.2, validation = 0 }
motion = { start_mm = -12.0, step_mm = 8.0, count = 4 }
vary = { "scene.objects.2.diameter_mm" = { kind = "uniform", least = 25.0, most = 60.0 } }
"""
"""In place of a preset, whose scene takes half a minute of processor time."""
A_SET = {"stripe-turbid --scenes 200": "small-set.toml --scenes 1"}

MAKE = {"make ": "`make test-full` runs this test, and demo, bench, docs and check take minutes each"}
INSTALL = {"pip install": "make does it", "twin demo": "takes a minute; tests/system/test_campaign.py runs it"}
HARDWARE = "needs hardware: docs/how-to/scan.md and desk.md run it with the twin"
ALIGNED_ELSEWHERE = "a pass that can be aligned takes minutes to render: tests/uwlts/alignment/test_align.py runs it"
PASSES_ELSEWHERE = "passes take minutes to render: tests/uwlts/recalibration recalibrates drawn ones by the command"
NEEDS_ROS = "needs ROS 2: tests/ros_node.py runs it"

THREE_VIEWS = {"top.cloud.h5": "pipe.cloud.h5"} | {f"{side}.cloud.h5": f"{side}.cloud.h5" for side in ("left", "right")}
NO_MOVEMENT = "1,0,0,0,0,1,0,0,0,0,1,0\n" * 3
ROBOT = """
twin simulate robot-sphere --sensor thesis-small --out robot.h5
uwlts nominal thesis-small --medium water --out calibration.json
uwlts mount robot.h5 --calibration calibration.json --radius-mm 19.05 --out robot-mount.json
twin simulate robot-target --sensor thesis-small --out board.h5
cp robot.h5 scan.h5
"""


def write_profiles(folder: Path, profiles: list[np.ndarray]) -> None:
    """One CSV file for each profile, as a profiler of any make gives them."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for number, profile in enumerate(profiles):
        np.savetxt(folder / f"{number}.csv", profile, fmt="%.4f", delimiter=",", header="x,z", comments="")


def profiles_of_a_robot(runner: Runner) -> None:
    """Drawn profiles of a sphere of 19.05 mm radius, and the robot's poses."""
    views = sphere_campaign(np.random.default_rng(1), poses=15)
    write_profiles(runner.folder / "profiles", [profile * 19.05 / RADIUS_MM for profile in views.profiles])
    turns = Rotation.from_matrix(views.poses[:, :3, :3]).as_quat(scalar_first=True)
    places = views.poses[:, :3, 3] * 19.05 / RADIUS_MM
    np.savetxt(runner.folder / "poses.csv", np.hstack([places, turns]), fmt="%.9f", delimiter=",")


def profiles_of_a_table(runner: Runner) -> None:
    """Drawn profiles of the same sphere 9 mm off the axis of a table, along which the sensor looks down."""
    rng, angles = np.random.default_rng(2), np.arange(0.0, 360.0, 15.0)
    profiles = []
    for angle in angles:
        # Seen from the table the sensor turns the other way, about an axis beside the sphere.
        base_sensor = np.eye(4)
        base_sensor[:3, :3] = (
            Rotation.from_euler("z", -angle, degrees=True) * Rotation.from_euler("x", np.pi)
        ).as_matrix()
        base_sensor[:3, 3] = SPHERE_MM + [9.0, 0.0, STANDOFF_MM]
        profiles.append(profile_of(base_sensor, rng, noise_mm=0.03, background=False) * 19.05 / RADIUS_MM)
    write_profiles(runner.folder / "profiles", profiles)
    np.savetxt(runner.folder / "angles.csv", angles, fmt="%.1f", header="angle", comments="")


def poses_of_a_capture(runner: Runner) -> None:
    """The robot's poses at the images of board.h5, m, as its controller prints them."""
    with uwlts.read(runner.folder / "board.h5") as capture:
        write_poses(runner, np.array([frame.pose for frame in capture]))


def write_poses(runner: Runner, poses: np.ndarray) -> None:
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    np.savetxt(runner.folder / "poses.csv", np.hstack([poses[:, :3, 3] / 1e3, turns]), fmt="%.12f", delimiter=",")


def photographs_on_a_robot(runner: Runner) -> None:
    """Photographs of a chessboard by a camera whose mount is the identity, and the robot's poses."""
    folder, rng, at = runner.folder / "photographs", np.random.default_rng(2), []
    folder.mkdir()
    for number, (rotation, translation) in enumerate(poses(CHESSBOARD)):
        cv2.imwrite(str(folder / f"board{number}.png"), photographs(CHESSBOARD, rotation, translation, rng)[0])
        at.append(np.eye(4))
        at[-1][:3, :3], at[-1][:3, 3] = rotation.T, -rotation.T @ translation
    (folder / "target.toml").write_text(BOARD)
    write_poses(runner, np.array(at))


def photographs_of_a_target(runner: Runner) -> None:
    """The photographs of the page, and the robot's poses at them."""
    (runner.folder / "target").mkdir()
    for file in (ROOT / "tests" / "data" / "etna").glob("*.jpg"):
        shutil.copy(file, runner.folder / "target")
    header, *rows = (ROOT / "tests" / "data" / "etna" / "poses.csv").read_text().splitlines()[1:]
    (runner.folder / "poses.csv").write_text("\n".join([header, *rows]))
    timed = [f"{number},{row}" for number, row in enumerate(rows, start=1)]
    (runner.folder / "track.csv").write_text("\n".join([f"time_s,{header}", *timed]))


def answers(runner: Runner) -> None:
    answered(runner.folder / "target" / "import.toml")


def scan_of_a_robot(runner: Runner) -> None:
    """The photographs once more, as a scan with numbers for times."""
    folder = runner.folder / "scan"
    shutil.copytree(runner.folder / "target", folder)
    lines = (folder / "import.toml").read_text().partition("[target]")[0].splitlines()
    kept = [line for line in lines if not line.startswith(("laser =", "lamp ="))]
    (folder / "import.toml").write_text("\n".join(['table = "frames.csv"', *kept]))
    frames = [f"frame{number:04}.jpg,laser,{number}" for number in range(1, 17)]
    (folder / "frames.csv").write_text("\n".join(["file,light,time_s", *frames]))


def trajectory_for_tum(runner: Runner) -> None:
    """The vehicle's trajectory as the benchmark of TU Munich writes them: s, m, quaternion x y z w."""
    with (runner.folder / "pass.trajectory.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    names = list(rows[0])
    time = names.index("time_s")
    values = np.array(
        [
            [float(row[name]) for name in [*names[time : time + 1], *names[:time], *names[time + 1 :]][:8]]
            for row in rows
        ]
    )
    values[:, 1:4] /= 1e3
    np.savetxt(runner.folder / "path.tum", values, fmt="%.9f")
    shutil.copy(runner.folder / "pass.h5", runner.folder / "scan.h5")


def correct_nothing(runner: Runner) -> None:
    """The navigation's trajectory as the corrected one."""
    shutil.copy(runner.folder / "pass.trajectory.csv", runner.folder / "corrected.csv")


def study_of_the_page(runner: Runner) -> None:
    shutil.copy(runner.names["folder"] / "study.toml", runner.folder)


def photographs_of_the_page(runner: Runner) -> None:
    shutil.copytree(runner.names["folder"], runner.folder / "photographs")


def both_folders_of_the_page(runner: Runner) -> None:
    for name in ("target", "scan"):
        shutil.copytree(runner.names["folder"] / name, runner.folder / name)


def photographs_with_description(runner: Runner) -> None:
    shutil.copytree(ROOT / "tests" / "data" / "etna", runner.folder / "photographs")
    shutil.copy(runner.names["folder"] / "board.toml", runner.folder)
    shutil.copy(runner.names["folder"] / "whole.toml", runner.folder / "photographs" / "import.toml")


PAGES_RUN = {
    "README.md": Page(
        given=THREE_VIEWS
        | {"after.cloud.h5": "pipe.cloud.h5", "before.cloud.h5": "pipe.cloud.h5", "small-set.toml": "small-set.toml"},
        small_python=True,
        instead=A_SET,
        again=("twin simulate spheres",),
        not_run=MAKE | {"uwlts scan": HARDWARE, "uwlts desk": HARDWARE},
    ),
    "CONTRIBUTING.md": Page(not_run=MAKE),
    "docs/install.md": Page(
        not_run=MAKE
        | {"python3 -m venv": "make does it", ".venv/bin/": "make does it", "pip install": "there is no wheel here"}
    ),
    "docs/getting-started.md": Page(not_run=MAKE | INSTALL, small_python=True, again=("twin simulate spheres",)),
    "docs/explanation/design-studies.md": Page(),
    "docs/explanation/joint-calibration.md": Page(
        given={name: name for name in ("target-air.h5", "target-water.h5", "step-near.h5", "step-far.h5", "spheres.h5")}
        | {"pipe.h5": "pipe.h5", "plane.h5": "plane.h5", "target.h5": "target-water.h5", "today.h5": "today.h5"}
        | {"step-today.h5": "step-today.h5", "last-year.json": "joint.json"},
        instead={"--limit-mm 0.05": "--limit-mm 0.5"},
        again=("uwlts calibrate --air", "uwlts calibrate --joint", "uwlts calibrate --water target.h5")
        + ("uwlts certificate calibration.json --before",),
    ),
    "docs/explanation/light.md": Page(),
    "docs/explanation/tests.md": Page(
        instead={"pytest": f"pytest --collect-only -q {ROOT / 'tests/test_public_api.py'}"}
    ),
    "docs/how-to/add-a-target.md": Page(
        instead={'kind: Literal["plain circles"] = "plain circles"': 'kind: Literal["plain"] = "plain"'}
    ),
    "docs/how-to/calibrate-a-mount.md": Page(
        before=ROBOT,
        given={name: name for name in ("pass.h5", "pass.trajectory.csv")},
        prepare={
            "uwlts mount profiles poses.csv": profiles_of_a_robot,
            "uwlts mount board.h5": poses_of_a_capture,
            "uwlts mount photographs": photographs_on_a_robot,
            "uwlts mount profiles angles.csv": profiles_of_a_table,
            "uwlts reconstruct scan.h5 --calibration calibration.json --mount mount.json --traj": trajectory_for_tum,
        },
        again=("uwlts mount board.h5", "uwlts mount robot.h5")
        + ("uwlts reconstruct scan.h5 --calibration calibration.json --mount mount.json --traj",),
    ),
    "docs/how-to/compare-scans.md": Page(
        given=dict.fromkeys(("after.cloud.h5", "before.cloud.h5", "scan.cloud.h5", "pipe.cloud.h5"), "pipe.cloud.h5")
        | {"part.stl": "pipe.stl"},
        again=("uwlts compare scan.cloud.h5", "uwlts compare pipe.cloud.h5"),
    ),
    "docs/how-to/describe-your-sensor.md": Page(tables={"reef.toml": 0, "reef-close.toml": 1}),
    "docs/how-to/follow-a-sensor.md": Page(tables={"wall.toml": 0}, again=("uwlts radiometry wall.h5",)),
    "docs/how-to/predict-uncertainty.md": Page(
        texts={"small-pipe.toml": 'base = "pipe"\ntitle = "small pipe"\n'},
        tables={"small-pipe-campaign.toml": 0},
        instead={
            "thesis-small --water clear": "thesis-small --campaign small-pipe-campaign.toml --water clear",
            "count = 16": "count = 8",
            # The recordings of the first call.
            "--campaign detection --water coastal --campaigns 2 --every 2 --out runs/detection": "--campaign "
            "small-pipe-campaign.toml --water clear --campaigns 1 --every 4 --out runs/predicted",
            "my-sensor.toml": "thesis-small",
            "--campaigns 10 --out runs/small-pipe": "--water clear --campaigns 1 --every 4 --out runs/predicted",
        },
    ),
    "docs/how-to/inspect-a-pipe.md": Page(
        given={name: name for name in ("pipe.cloud.h5", "pipe.h5", "weld.cloud.h5")}
        | {"water.json": "joint.json", "water.certificate.json": "certificate.json"}
    ),
    "docs/how-to/large-clouds.md": Page(
        given={"scan.cloud.h5": "pipe.cloud.h5"}, instead={"1000 -50 300 1100 50 600": "-10 -50 0 10 50 30"}
    ),
    "docs/how-to/make-a-data-set.md": Page(
        given={"small-set.toml": "small-set.toml"},
        tables={"mine.toml": 0},
        instead=A_SET | {"scenes = 40": "scenes = 2"},
    ),
    "docs/how-to/recalibrate-by-passes.md": Page(not_run={"uwlts recalibrate": PASSES_ELSEWHERE}),
    "docs/how-to/register-scans.md": Page(given=THREE_VIEWS, texts={"start.csv": NO_MOVEMENT}),
    "docs/how-to/ros.md": Page(not_run={"pip install": NEEDS_ROS, "uwlts ros": NEEDS_ROS}),
    "docs/how-to/scan-from-a-vehicle.md": Page(
        prepare={"uwlts reconstruct pass.h5 --calibration calibration.json --mount mount.json --traj": correct_nothing},
        not_run={"uwlts align pass.cloud.h5": ALIGNED_ELSEWHERE},
    ),
    "docs/how-to/your-photographs.md": Page(
        prepare={
            "uwlts template target": photographs_of_a_target,
            "uwlts import target": answers,
            "uwlts import scan": scan_of_a_robot,
        },
        figures="assert len(cloud) > 15000",
    ),
    "docs/reference/api.md": Page(given={name: name for name in ("target-air.h5", "target-water.h5", "spheres.h5")}),
    "docs/tutorials/calibrate-a-sensor.md": Page(
        small_python=True,
        figures="""
assert abs(values(joint)[0] - truth[0]) < 1.0, "focal length within 1 px"
assert abs(values(joint)[2] - truth[2]) < 0.5, "window distance within 0.5 mm"
assert abs(spacing["joint"].error_mm) < 0.05
""",
    ),
    "docs/tutorials/choose-a-design.md": Page(
        not_run={"from live_drawing": "sliders need Jupyter; tests/twin/design/test_live_drawing.py draws the figures"},
        prepare={"twin sweep study.toml --out runs/study": study_of_the_page},
        again=("twin sweep study.toml --out runs/study --verify 2",),
        instead={"--verify 2": "--verify 1", "steps = 26": "steps = 6", "steps = 24": "steps = 5"}
        | {'sensor = "thesis"': 'sensor = "thesis-small"'},
        figures="""
assert float(table["sigma_z_rms_mm"]) <= sigma[keeps].min() * 1.001
assert table["near_mm"] >= 149.9 and table["line_mm"] >= 159.9
""",
    ),
    "docs/tutorials/import-foreign-images.md": Page(
        prepare={"uwlts import photographs": photographs_of_the_page},
        figures="assert len(view.pixels) > 100 and abs(calibration.camera.fx_px - true.focal_length_px()) < 2.0",
    ),
    "docs/tutorials/learn-from-a-data-set.md": Page(
        instead={"scenes=12": "scenes=4", 'base = "stripe-turbid"': SMALL_SET}
    ),
    "docs/tutorials/photographs-to-cloud.md": Page(
        prepare={"uwlts import target": both_folders_of_the_page},
        figures="""
for figure in (evaluation.sphere_spacing, *evaluation.diameters):
    assert abs(figure.error_mm) < figure.expanded_uncertainty_mm + 0.02  # 0.02 mm: U of the calibrated values
""",
    ),
    "docs/tutorials/photographs-to-sensor.md": Page(
        prepare={"uwlts camera photographs": photographs_with_description},
        instead={"Path.cwd().parents": "Path(uwlts.__file__).parents"},
        # Halves of the photographs agree.
        figures="assert len(camera.lens.used) == 16 and apart < 3 * stated and turn < 3 * normals",
    ),
    "docs/tutorials/run-an-experiment.md": Page(instead={"SEEDS = range(3)": "SEEDS = range(1)"}),
    "docs/tutorials/simulate-and-measure.md": Page(
        figures="""
assert abs(result.sphere_spacing.error_mm) < 0.05 and result.std.value_mm < 0.05
assert all(abs(figure.error_mm) < 0.10 for figure in result.diameters)
"""
    ),
}


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small")
    write_small_descriptions(folder)
    return folder


@pytest.fixture(scope="module", autouse=True)
def workers() -> Iterator[None]:
    with shared_workers():
        yield


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, small: Path) -> Campaign:
    folder = tmp_path_factory.mktemp("campaign")
    without = 'title = "Small"\nwithout = ["multiple-scattering", "secondary-light"]'
    (folder / "small-set.toml").write_text(without + SMALL_SET, encoding="utf-8")
    campaign = Campaign(folder)
    campaign.run(CAMPAIGN, small)
    drawn = trimesh.creation.cylinder(radius=150.0, height=200.0, sections=1000)
    drawn.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0], [0, 0, 0]))
    drawn.apply_translation([0.0, 0.0, 150.0])
    drawn.export(folder / "pipe.stl")
    # Other views of the pipe have noise of their own: copies of a scan are refused.
    cloud = uwlts.read(folder / "pipe.cloud.h5")
    for seed, side in enumerate(("left", "right")):
        noise = np.random.default_rng(seed).normal(0, 0.02, cloud.points_mm.shape)
        replace(cloud, points_mm=cloud.points_mm + noise).save(folder / f"{side}.cloud.h5")
    return campaign


def test_every_page_with_commands_is_run():
    with_blocks = {
        name_of(page) for page in PAGES if any(block.kind in ("commands", "python") for block in blocks(page))
    }
    assert with_blocks == set(PAGES_RUN) | set(HARDWARE_PAGES)


@pytest.mark.parametrize("name", PAGES_RUN)
def test_page_runs(name, shared, small, tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    run_page(ROOT / name, PAGES_RUN[name], shared=shared, folder=tmp_path, small=small)
