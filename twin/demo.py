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
SCANS = (*(f"spheres-{place}" for place in PLACEMENTS), "step-scan-standoff", "pipe-standoff")


def commands(folder: Path) -> list[tuple[str, str]]:
    """Stage and command line of everything the demo does, in order."""
    as_built = "--sensor thesis --as-built thesis-as-built --overwrite"
    everywhere = f"--placement {' '.join(PLACEMENTS)}"
    rows = [
        ("render", f"twin simulate target {as_built} --out {folder}/target.h5"),
        ("render", f"twin simulate step {everywhere} {as_built} --out {folder}/step-{{placement}}.h5"),
        ("render", f"twin simulate spheres {everywhere} {as_built} --out {folder}/spheres-{{placement}}.h5"),
        ("render", f"twin simulate step-scan {as_built} --out {folder}/step-scan-standoff.h5"),
        ("render", f"twin simulate pipe {as_built} --out {folder}/pipe-standoff.h5"),
    ]
    steps = " ".join(f"{folder}/step-{place}.h5" for place in PLACEMENTS)
    calibration = f"{folder}/calibration.json"
    rows.append(("calibrate", f"uwlts calibrate --air {folder}/target.h5 --step {steps} --out {calibration} --overwrite"))
    for scan in SCANS:
        path = f"{folder}/{scan}"
        rows.append(("reconstruct", f"uwlts reconstruct {path}.h5 --calibration {calibration} --out {path}.ply --overwrite"))
        rows.append(
            (
                "evaluate",
                f"uwlts evaluate {path}.ply --truth {path}.truth.h5 --out {path}.evaluation.json "
                f"--coloured {path}.ply --overwrite",
            )
        )
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
