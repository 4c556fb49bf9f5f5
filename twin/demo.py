"""The main job in a row of commands: record a virtual campaign, calibrate, reconstruct, judge, report.

Runs exactly the commands that it prints; each could be typed by hand. Results lie in ``runs/demo``.
"""

import json
import shlex
import subprocess
import sys
import time
from pathlib import Path

FOLDER = Path("runs/demo")
PLACEMENTS = ("near", "standoff", "far")
SPHERES = tuple(f"spheres-{place}" for place in PLACEMENTS)


def commands(folder: Path) -> list[tuple[str, str]]:
    """Stage and command line of everything the demo does, in order."""
    as_built = "--sensor thesis --as-built thesis-as-built --overwrite"
    everywhere = f"--placement {' '.join(PLACEMENTS)}"
    recordings = {
        "target": "target.h5",
        "target-through-window": "target-through-window.h5",
        f"step {everywhere}": "step-{placement}.h5",
        f"spheres {everywhere}": "spheres-{placement}.h5",
        "step-scan": "step-scan-standoff.h5",
        "pipe": "pipe-standoff.h5",
    }
    rows = [("render", f"twin simulate {scene} {as_built} --out {folder}/{name}") for scene, name in recordings.items()]
    steps = " ".join(f"{folder}/step-{place}.h5" for place in PLACEMENTS)
    for target, refractions, name, suffix, scans in (
        ("target", 2, "calibration", "", (*SPHERES, "step-scan-standoff", "pipe-standoff")),
        ("target-through-window", 1, "calibration-one-refraction", "-one-refraction", SPHERES),
    ):
        calibration = f"{folder}/{name}.json"
        air = f"--air {folder}/{target}.h5 --step {steps} --refractions {refractions}"
        rows.append(("calibrate", f"uwlts calibrate {air} --out {calibration} --overwrite"))
        for scan in scans:
            capture, cloud = f"{folder}/{scan}", f"{folder}/{scan}{suffix}"
            made = f"{capture}.h5 --calibration {calibration} --out {cloud}.ply --overwrite"
            rows.append(("reconstruct", f"uwlts reconstruct {made}"))
            judged = f"--out {cloud}.evaluation.json --coloured {cloud}.ply --overwrite"
            rows.append(("evaluate", f"uwlts evaluate {cloud}.ply --truth {capture}.truth.h5 {judged}"))
    rows.append(("report", f"uwlts report {folder} --reference thesis --overwrite"))
    return rows


def main() -> int:
    """Run the demo; the exit code of the first command that fails, else 0."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    seconds: dict[str, float] = {}
    for stage, line in commands(FOLDER):
        print(f"$ {line}", flush=True)
        program, *arguments = shlex.split(line)
        if stage == "report":
            (FOLDER / "seconds.json").write_text(json.dumps(seconds, indent=2) + "\n", encoding="utf-8")
        start = time.perf_counter()
        code = subprocess.run([sys.executable, "-m", f"{program}.cli", *arguments], check=False).returncode
        if code:
            return code
        seconds[stage] = round(seconds.get(stage, 0.0) + time.perf_counter() - start, 2)
    total = ", ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items())
    print(f"done in {sum(seconds.values()):.1f} s ({total}); open {FOLDER / 'report.html'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
