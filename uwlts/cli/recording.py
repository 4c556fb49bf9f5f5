"""Commands at the sensor: scan, watch, the operator's desk, and the examination of the machine."""

import sys
from pathlib import Path

import uwlts
from uwlts.cli.options import Flag, app, say, warn
from uwlts.runtime.console import progress_bar


@app.command
def scan(
    plan: Path,
    *,
    out: Path,
    camera: str | None = None,
    stage: str | None = None,
    home: Flag = False,
    unlock: Flag = False,
    watch: Flag = False,
    calibration: Path | None = None,
    port: int = 8080,
    resume: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Record a scan with a camera and a stage into a capture.

    Moves, lets the stage settle, switches the laser, takes an image and stores it with the position read back. The plan
    is checked against travel and volume before anything moves; the laser goes off however the scan ends.

    Example: uwlts scan plan.toml --camera gige:192.168.1.10 --stage /dev/ttyACM0 --home --out scan.h5

    Args:
        plan: TOML file with sensor, medium, positions, lights and exposures (docs/how-to/scan.md).
        out: Capture to write.
        camera: Address of the camera, in place of the plan's: gige:NAME, genicam:PRODUCER.cti, replay:PATH.
        stage: Serial port of the stage, in place of the plan's.
        home: Find the limit switch first.
        unlock: Take the stage's position as it is, without homing.
        watch: Show the recording in a browser meanwhile, as uwlts watch does.
        calibration: Watched: calibration of the sensor, or one by polynomials, for the cloud.
        port: Watched: port of the page; the next free one is taken if it is in use.
        resume: Continue an interrupted scan; refused where the plan is another than the one it began with.
        overwrite: Replace an existing capture.
    """
    with progress_bar(f"scanning {plan.stem}") as progress:
        seen = uwlts.scan(
            plan,
            out,
            camera=camera,
            stage=stage,
            home=home,
            unlock=unlock,
            watch=watch,
            calibration=calibration,
            port=port,
            resume=resume,
            overwrite=overwrite,
            progress=progress,
            report=say,
            warn=warn,
        )
    warn(*seen.warnings())
    exposures = ", ".join(f"{light} {value:.3g} ms" for light, value in seen.exposure_ms.items())
    print(f"wrote {out}, {seen.found} of {seen.lines} profile lines with a stripe; exposure {exposures or 'as before'}")


@app.command
def watch(capture: Path, *, calibration: Path | None = None, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a recording while it grows, in a browser: the latest image with its stripe, and the cloud so far.

    Example: uwlts watch scan.h5 --calibration calibration.json

    Args:
        capture: Capture that is being recorded, or is to be.
        calibration: Calibration of the sensor, or one by polynomials, for the cloud.
        host: Address at which the page is served; the default can be reached from this machine only.
        port: Port of the page; the next free one is taken if it is in use.
    """
    uwlts.watch(capture, calibration=calibration, host=host, port=port, report=say)


@app.command
def desk(folder: Path = Path(), *, plan: Path | None = None, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Serve the operator's page: connect, look, move, calibrate, scan, reconstruct and measure in a browser.

    The address with the token is the operator's; at the other one everybody who reaches it may look. Results are
    written to the folder. The page works without internet.

    Example: uwlts desk tank --plan plan.toml

    Args:
        folder: Folder with plans, calibrations, captures and clouds; the present one unless given.
        plan: Plan of a scan (docs/how-to/scan.md) to begin with; others can be chosen on the page.
        host: Address at which the page is served; the default can be reached from this machine only.
        port: Port of the page; the next free one is taken if it is in use.
    """
    uwlts.serve_desk(folder, plan=plan, host=host, port=port, report=say)


@app.command
def doctor(*, folder: Path = Path(), camera: str | None = None, stage: str | None = None) -> None:
    """Examine libraries, libLLVM, cameras, serial ports, permissions and speed of this machine, with advice.

    Ends with exit code 1 if something required, or something named here, is missing or does not work.

    Example: uwlts doctor --camera gige: --stage /dev/ttyACM0

    Args:
        folder: Where captures are to be written; 64 MB are, and removed.
        camera: Address of a camera to take ten frames with: gige:NAME, genicam:PRODUCER.cti or replay:PATH.
        stage: Serial port of a stage to ask for its version, settings and state. It is not moved and the laser stays
            off, but an Arduino Uno restarts: home before the next scan.
    """
    from uwlts.doctor import print_findings

    with progress_bar("examining") as progress:
        findings = uwlts.examine(folder, camera=camera, stage=stage, progress=progress)
    print_findings(findings)
    if any(each.status == "missing" for each in findings):
        sys.exit(1)
