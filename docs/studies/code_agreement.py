"""Compare two versions of the code: process the same captures with both, and compare all numbers that they write.

    git worktree add /tmp/old v0.1
    python docs/studies/code_agreement.py /tmp/old --folder runs/agreement
    python docs/studies/code_agreement.py /tmp/old --folder runs/agreement --only joint reconstruct

Inputs are made once by the older checkout (`code_agreement_inputs.py`). Its results are reused until its commit or the
command lines change. Each version runs all jobs in one process, as ``python -m uwlts`` does. Numbers must agree to 1e-9
(relative), and both versions must write the same files and keys. Texts may differ and are listed. The exit code is 1 if
anything else differs.
"""

import argparse
import contextlib
import hashlib
import importlib
import importlib.util
import json
import os
import runpy
import shlex
import shutil
import subprocess
import sys
import time
import traceback
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve()
NEW = HERE.parents[2]
AIR, WATER = "--air inputs/scans/target-bare.h5 inputs/scans/target-air.h5", "--water inputs/scans/target-water.h5"
STEPS = "--step inputs/scans/step-near.h5 inputs/scans/step-standoff.h5 inputs/scans/step-far.h5"
TAKEN = "--calibration joint/calibration.json"
PROFILED = "--pose-format quaternion-xyzw"

JOBS: dict[str, str] = {
    "simulate": """
        twin simulate step --sensor thesis-small --as-built thesis-small-as-built --placement near --spp 4 --seed 5 \
            --out simulate/step.h5
        twin simulate target --sensor thesis-small --spp 4 --seed 6 --effects glare vignetting bubbles \
            --without multiple-scattering --out simulate/target.h5""",
    "nominal": "uwlts nominal thesis --medium water --out nominal/calibration.json",
    "design": "uwlts design thesis --medium water",
    "sweep": "twin sweep baseline-angle --out sweep/study --verify 0 --workers 1",
    "joint": f"uwlts calibrate {AIR} {WATER} {STEPS} --scan inputs/scans/plane.h5 --out joint/calibration.json",
    "sequential": f"""
        uwlts calibrate --air inputs/scans/target-bare.h5 {STEPS} --out sequential/two.json
        uwlts calibrate --air inputs/scans/target-air.h5 {STEPS} --refractions 1 --target-poses free \
            --out sequential/one.json
        uwlts calibrate --air inputs/scans/target-bare.h5 --target-poses stage --out sequential/air.json""",
    "polynomials": "uwlts polynomials --captures inputs/scans/target-water.h5 --out polynomials/calibration.json",
    "earlier": """
        uwlts calibrate --calibration joint/calibration.json --step inputs/scans/step-today.h5 --new-water \
            --out earlier/calibration.json""",
    "camera": "uwlts camera inputs/photographs --out camera/camera.yaml",
    "import": """
        uwlts import inputs/photographs --out import/photographs.h5
        uwlts calibrate --air import/photographs.h5 --target-poses free --out import/calibration.json""",
    "export": """
        uwlts export inputs/scans/step-near.h5 --out export/step
        uwlts import export/step --out export/step.h5""",
    "certificate": """
        uwlts certificate joint/calibration.json --out certificate/certificate.html
        uwlts certificate joint/calibration.json --check certificate/certificate.json""",
    "reconstruct": f"""
        uwlts reconstruct inputs/scans/spheres.h5 {TAKEN} --out reconstruct/spheres.full.ply
        uwlts reconstruct inputs/scans/spheres.h5 {TAKEN} --out reconstruct/spheres.h5
        uwlts reconstruct inputs/scans/step-scan.h5 {TAKEN} --out reconstruct/step.full.ply
        uwlts reconstruct inputs/scans/plane.h5 {TAKEN} --no-with-uncertainty --out reconstruct/plane.full.ply
        uwlts reconstruct inputs/scans/spheres.h5 --calibration sequential/two.json \
            --out reconstruct/sequential.full.ply
        uwlts reconstruct inputs/scans/spheres.h5 --calibration sequential/one.json --index 1.33 \
            --out reconstruct/one-refraction.full.ply
        uwlts reconstruct inputs/scans/spheres.h5 --calibration polynomials/calibration.json \
            --out reconstruct/polynomials.full.ply""",
    "methods": "\n".join(
        f"uwlts reconstruct inputs/scans/shapes.h5 {TAKEN} --no-with-uncertainty --stripe-method {method} "
        f"{options} --out methods/{method}.full.ply"
        for method, options in (
            ("centre-of-mass", "--stripe half_window_px=24"),
            ("profile-fit", "--stripe-peak direct"),
            ("quadratic", "--stripe-peak strongest"),
            ("zero-crossing", "--stripe-peak first"),
        )
    ),
    "moving": f"""
        uwlts reconstruct inputs/scans/robot-sphere.h5 {TAKEN} --out moving/robot.full.ply
        uwlts mount inputs/scans/robot-sphere.h5 {TAKEN} --radius-mm 19.05 --out moving/mount.json
        uwlts reconstruct inputs/scans/robot-sphere.h5 {TAKEN} --mount moving/mount.json --out moving/mounted.full.ply
        uwlts reconstruct inputs/scans/vehicle.h5 {TAKEN} --mount moving/mount.json --clock-offset-s 0.012 \
            --trajectory inputs/scans/vehicle.trajectory.csv {PROFILED} --out moving/vehicle.full.ply
        uwlts mount inputs/scans/robot-target.h5 {TAKEN} --out moving/board.json
        uwlts mount inputs/scans/rotary-sphere.h5 {TAKEN} --axis=-y --radius-mm 19.05 --out moving/table.json""",
    "mount": "\n".join(
        f"uwlts mount inputs/{name}-profiles.csv inputs/{name}-poses.csv {PROFILED} {options} --out mount/{name}.json"
        for name, options in (("sphere", "--radius-mm 20"), ("plane", "--artefact-kind plane"))
    ),
    "evaluate": """
        uwlts evaluate reconstruct/spheres.full.ply --truth inputs/scans/spheres.truth.h5 --out evaluate/spheres.json \
            --coloured evaluate/spheres.full.ply
        uwlts evaluate reconstruct/step.full.ply --truth inputs/scans/step-scan.truth.h5 --out evaluate/step.json
        uwlts evaluate reconstruct/plane.full.ply --out evaluate/plane.json
        uwlts evaluate reconstruct/sequential.full.ply --truth inputs/scans/spheres.truth.h5 \
            --out evaluate/sequential.json
        uwlts evaluate reconstruct/polynomials.full.ply --out evaluate/polynomials.json""",
    "verify": f"""
        uwlts verify inputs/scans/spheres.h5 {TAKEN} --limit 0.5
        uwlts verify inputs/scans/step-scan.h5 {TAKEN}""",
    "clouds": "\n".join(
        f"uwlts reconstruct inputs/scans/{name}.h5 {TAKEN} --out clouds/{name}.full.ply"
        for name in ("pipe", "pipe-later", "weld", "shapes", "shapes-again")
    ),
    "inspect": """
        uwlts inspect clouds/pipe.full.ply --wall-mm 9.5 --out inspect/pipe.json --coloured inspect/pipe.full.ply
        uwlts inspect clouds/weld.full.ply weld --out inspect/weld.json
        uwlts findings-report clouds/pipe.full.ply --captures inputs/scans/pipe.h5 \
            --calibration joint/calibration.json --certificate certificate/certificate.json \
            --verification evaluate/spheres.json --out inspect/report.html""",
    "compare": """
        uwlts compare clouds/pipe-later.full.ply clouds/pipe.full.ply --same-water --out compare/change.html \
            --coloured compare/change.full.ply
        uwlts compare clouds/pipe-later.full.ply clouds/pipe.full.ply --register --out compare/registered.html
        uwlts compare clouds/pipe.full.ply cylinder --out compare/cylinder.html
        uwlts compare reconstruct/plane.full.ply plane --out compare/plane.html""",
    "register": """
        uwlts register clouds/shapes.full.ply clouds/shapes-again.full.ply --out register/shapes.full.ply \
            --page register/shapes.html --poses-out register/poses.csv
        uwlts register clouds/shapes.full.ply clouds/shapes-again.full.ply --start-std-mm 0.05 --start-std-deg 0.02 \
            --out register/known.full.ply --page register/known.html""",
    "align": f"""
        uwlts align inputs/crossing.full.ply --trajectory inputs/crossing.csv {PROFILED} --drift-mm 60 --drift-deg 0.3 \
            --out align/corrected.csv --aligned align/aligned.full.ply""",
    "formats": "\n".join(
        f"uwlts export moving/vehicle.full.ply --out formats/vehicle{ending}"
        for ending in (".h5", ".xyz", ".laz", ".e57", ".mcap")
    ),
    "info": """
        uwlts info joint/calibration.json
        uwlts info reconstruct/spheres.full.ply
        uwlts info inputs/scans/spheres.h5
        uwlts info evaluate/spheres.json""",
}
"""Command lines of each job. A job may use files of the jobs above it."""

NEW_JOBS: dict[str, str] = {"verify": JOBS["verify"].replace("--limit", "--limit-mm")}
"""Jobs with different command lines in the new code."""
SAID = ("design", "verify", "info")
"""Jobs with printed results."""
CRASHED = 70
"""Exit code of a command that ends with a traceback: internal software error in sysexits.h."""


def main() -> None:
    """Run both versions and print how they agree."""
    parser = argparse.ArgumentParser()
    parser.add_argument("old", type=Path, help="checkout of the older version")
    parser.add_argument("--new", type=Path, default=NEW, help="checkout of the newer version, else this one")
    parser.add_argument("--only", nargs="+", choices=JOBS, default=list(JOBS), help="jobs whose files are there before")
    parser.add_argument("--compare", action="store_true", help="only compare the results that are there")
    parser.add_argument("--folder", type=Path, default=NEW / "runs" / "agreement")
    given = parser.parse_args()
    from code_agreement_files import Agreement, compare, of_text, read_values

    old, new, folder = (path.resolve() for path in (given.old, given.new, given.folder))
    if not given.compare:
        inputs = make_inputs(old, folder / "inputs")
        seconds = [
            run_side(old, folder / "old", given.only, {}, keep=inputs),
            run_side(new, folder / "new", given.only, NEW_JOBS),
        ]
        print(f"jobs run now took {seconds[0]:.0f} s with the old code, {seconds[1]:.0f} s with the new code\n")
    print("| job | files | numbers | largest relative difference | differences | old, CPU s | new, CPU s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    differences, texts = [], []
    for job in given.only:
        sides = [folder / side / job for side in ("old", "new")]
        files = [{str(path.relative_to(side)) for path in side.rglob("[!.]*") if path.is_file()} for side in sides]
        found = Agreement()
        found.differences += [f"{job}: only the old code writes {name}" for name in sorted(files[0] - files[1])]
        found.differences += [f"{job}: only the new code writes {name}" for name in sorted(files[1] - files[0])]
        ends = [json.loads((side / "ended.json").read_text()) for side in sides]
        codes = [end["codes"] for end in ends]
        # Exit code 1 is a negative verdict; 2 or more is a failure without results.
        if codes[0] != codes[1] or max(codes[0]) > 1:
            found.differences.append(f"{job}: exit codes {codes[0]}, now {codes[1]}: see {job}/warned.txt")
        for name in sorted((files[0] & files[1]) - {"ended.json", "said.txt", "warned.txt"}):
            _add(found, compare(*(read_values(side / name) for side in sides), name=f"{job}/{name}"))
        for name in ("said.txt", "warned.txt"):
            said = compare(*(dict(of_text((side / name).read_text())) for side in sides), name=f"{job}/{name}")
            if job not in SAID:
                # Printed numbers are also in files: only the texts are compared here.
                said = Agreement(texts=said.differences + said.texts)
            _add(found, said)
        times = [sum(end["seconds"]) for end in ends]
        print(
            f"| {job} | {len(files[0] & files[1])} | {found.numbers} | {found.largest:.1e} | {len(found.differences)} "
            f"| {times[0]:.1f} | {times[1]:.1f} |"
        )
        differences += found.differences
        texts += found.texts
    for title, lines in (("texts that differ", texts), ("differences", differences)):
        print(f"\n{len(lines)} {title}", *lines, sep="\n  ")
    sys.exit(1 if differences else 0)


def _add(total: Any, part: Any) -> None:
    total.numbers += part.numbers
    total.largest = max(total.largest, part.largest)
    total.differences += part.differences
    total.texts += part.texts


def make_inputs(old: Path, folder: Path) -> str:
    """Make missing inputs with the older checkout; return the digest of their description."""
    script = HERE.with_name("code_agreement_inputs.py")
    described = hashlib.sha256(script.read_bytes()).hexdigest()
    begun, complete = folder / "begun", folder / "complete"
    if begun.exists() and begun.read_text() != described:
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    begun.write_text(described)
    if not complete.exists():
        _python(old, script, str(folder), cwd=folder.parent)
        complete.touch()
    return described


def run_side(root: Path, folder: Path, jobs: list[str], other: dict[str, str], *, keep: str = "") -> float:
    """Run the jobs of one version in one process; return the seconds that it took.

    With ``keep``, the state of the inputs, results of an earlier run of the same version and command lines are kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileExistsError):
        (folder / "inputs").symlink_to("../inputs")
    lines, before, wanted = JOBS | other, _state(root) + keep, {}
    for job, text in lines.items():
        # Jobs use the results of earlier jobs.
        before = hashlib.sha256((before + text).encode()).hexdigest()
        ended = folder / job / "ended.json"
        if job in jobs and not (keep and ended.exists() and json.loads(ended.read_text())["state"] == before):
            shutil.rmtree(folder / job, ignore_errors=True)
            wanted[job] = {"lines": text, "state": before}
    start = time.perf_counter()
    if wanted:
        (folder / "order.json").write_text(json.dumps({"root": str(root), "jobs": wanted}))
        _python(root, HERE, "--work", "order.json", cwd=folder)
    return time.perf_counter() - start


def _state(root: Path) -> str:
    """Return the commit of a checkout and its uncommitted changes."""

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True).stdout

    return git("rev-parse", "HEAD") + git("diff", "HEAD", "--", "uwlts", "twin", "scenes")


def _python(root: Path, *arguments: object, cwd: Path) -> None:
    cwd.mkdir(parents=True, exist_ok=True)
    # With several threads, the order of sums would vary.
    environment = os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *map(str, arguments)], cwd=cwd, env=environment, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, arguments))} failed with {root}")


def work(order: dict[str, Any]) -> None:
    """Run command lines in this process and folder, and write their output to files."""
    for package in ("uwlts", "twin"):
        found = Path(str(importlib.import_module(package).__file__)).parents[1]
        if found != Path(order["root"]):
            sys.exit(f"{package} comes from {found}, not from {order['root']}")
    for job, described in order["jobs"].items():
        folder = Path(job)
        folder.mkdir()
        codes, seconds = [], []
        with (folder / "said.txt").open("w") as said, (folder / "warned.txt").open("w") as warned:
            for line in described["lines"].strip().splitlines():
                start = sum(os.times()[:4])
                with contextlib.redirect_stdout(said), contextlib.redirect_stderr(warned):
                    codes.append(run_command(line))
                seconds.append(round(sum(os.times()[:4]) - start, 2))
        ended = {"state": described["state"], "codes": codes, "seconds": seconds}
        (folder / "ended.json").write_text(json.dumps(ended))
        print(f"{order['root']}: {job}: exit codes {codes}, {sum(seconds):.1f} s of CPU", file=sys.stderr, flush=True)


def run_command(line: str) -> int:
    """Run a command line as ``python -m PROGRAM.cli`` and return its exit code; ``copy`` copies a file."""
    program, *arguments = shlex.split(line)
    if program == "copy":
        shutil.copyfile(*arguments)
        return 0
    sys.argv = [program, *arguments]
    try:
        # ``python -m uwlts`` does not exist in version 0.1.
        module = program if importlib.util.find_spec(f"{program}.__main__") else f"{program}.cli"
        runpy.run_module(module, run_name="__main__")
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    except Exception:
        # A crash counts as a difference; the other jobs continue.
        traceback.print_exc()
        return CRASHED
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--work"]:
        work(json.loads(Path(sys.argv[2]).read_text()))
    else:
        main()
