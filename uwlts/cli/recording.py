"""Commands that record with camera, stage and laser, and show what is recorded."""

import sys
import threading
from pathlib import Path

from uwlts.cli.options import Flag, app, warn
from uwlts.model.errors import DescriptionError
from uwlts.runtime.console import progress_bar
from uwlts.storage.files import refuse_unsuitable


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
    resume: Flag = False,
    overwrite: Flag = False,
) -> None:
    """Record a scan with a camera and a stage into a capture.

    Moves, lets the stage settle, switches the laser, takes an image and stores it with the position read back. The plan
    is checked against travel and volume before anything moves; the laser goes off however the scan ends.

    Example: uwlts scan plan.toml --camera gige:192.168.1.10 --stage /dev/ttyACM0 --home --out scan.h5

    Parameters
    ----------
    plan
        TOML file with sensor, medium, positions, lights and exposures (docs/how-to/scan.md).
    out
        Capture to write.
    camera
        Address of the camera, in place of the plan's: gige:NAME, genicam:PRODUCER.cti, replay:PATH.
    stage
        Serial port of the stage, in place of the plan's.
    home
        Find the limit switch first.
    unlock
        Take the stage's position as it is, without homing.
    watch
        Show the recording in a browser meanwhile, as uwlts watch does.
    calibration
        Watched: calibration of the sensor, or one by polynomials, for the cloud.
    resume
        Go on with an interrupted scan.
    overwrite
        Replace an existing capture.
    """
    from contextlib import ExitStack

    from uwlts.hardware.camera_addresses import open_camera
    from uwlts.hardware.grbl import GrblStage
    from uwlts.hardware.page_beside import PageBeside
    from uwlts.hardware.scan_plan import load_plan
    from uwlts.hardware.scanning import Seen, plan_text, record_scan
    from uwlts.storage.calibration_file import read_any_calibration

    described = load_plan(plan)
    address, port = camera or described.camera, stage or described.stage.port
    if address is None or port is None:
        what = "camera" if address is None else "stage"
        raise DescriptionError(f"neither the plan nor the command line gives the {what}: give --{what}")
    if not resume:
        refuse_unsuitable(out, overwrite=overwrite)
    if calibration:
        if not watch:
            raise DescriptionError("--calibration is for the cloud on the page: give --watch too")
        read_any_calibration(calibration)
    print(plan_text(described), flush=True)
    with ExitStack() as stack:
        page = None
        if watch:
            page = stack.enter_context(
                PageBeside(out, calibration=calibration, say=lambda line: print(line, flush=True))
            )
        progress = stack.enter_context(progress_bar(described.title))
        moved, opened = stack.enter_context(GrblStage(port)), stack.enter_context(open_camera(address))
        if home:
            moved.home()
        elif unlock:
            moved.unlock()

        def report(done: int, total: int, seen: Seen) -> None:
            progress(done, total)
            if page:
                page.start()

        seen = record_scan(
            described, out, camera=opened, stage=moved, overwrite=overwrite, resume=resume, progress=report, warn=warn
        )
    for warning in seen.warnings():
        warn(warning)
    exposures = ", ".join(f"{light} {value:.3g} ms" for light, value in seen.exposure_ms.items())
    print(f"wrote {out}, {seen.found} of {seen.lines} profile lines with a stripe; exposure {exposures or 'as before'}")


@app.command
def watch(capture: Path, *, calibration: Path | None = None, host: str = "127.0.0.1", port: int = 8080) -> None:
    """Show a recording while it grows, in a browser: the latest image with its stripe, and the cloud so far.

    Example: uwlts watch scan.h5 --calibration calibration.json

    Parameters
    ----------
    capture
        Capture that is being recorded, or is to be.
    calibration
        Calibration of the sensor, or one by polynomials, for the cloud.
    host
        Address at which the page is served; the usual one can be reached from this machine only.
    port
        Port of the page; the next free one is taken where it is in use.
    """
    from uwlts.hardware.live_view import LiveView
    from uwlts.hardware.live_view import watch as show
    from uwlts.storage.calibration_file import read_any_calibration

    known = read_any_calibration(calibration) if calibration else None
    view = LiveView(capture.name, host=host, port=port)
    try:
        print(f"open {view.address}; Ctrl-C ends it", flush=True)
        images = show(capture, view, known)
        print(f"{capture} is finished with {images} images; the page stays until Ctrl-C", flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        print("closed")
    finally:
        view.close()


@app.command
def doctor(*, folder: Path = Path(), camera: str | None = None, stage: str | None = None) -> None:
    """Examine libraries, libLLVM, cameras, serial ports, permissions and speed of this machine, and say what to do.

    Ends with exit code 1 if something required, or something named here, is missing or does not work.

    Example: uwlts doctor --camera gige: --stage /dev/ttyACM0

    Parameters
    ----------
    folder
        Where captures are to be written; 64 MB are, and removed.
    camera
        Address of a camera to take ten frames with: gige:NAME, genicam:PRODUCER.cti or replay:PATH.
    stage
        Serial port of a stage to ask for its version, settings and state. It is not moved and the laser stays off, but
        an Arduino Uno restarts: home before the next scan.
    """
    from uwlts.doctor import examine, print_findings

    with progress_bar("examining") as progress:
        findings = examine(folder, camera=camera, stage=stage, progress=progress)
    print_findings(findings)
    if any(each.status == "missing" for each in findings):
        sys.exit(1)
