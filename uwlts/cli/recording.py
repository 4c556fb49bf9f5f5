"""Commands at the sensor: scan, watch, the operator's desk, the node of ROS 2, and the examination of the machine."""

import sys

import uwlts
from uwlts.cli.command_options import app
from uwlts.runtime.command_line import Call, command_from, say, warn


@command_from(app, uwlts, "scan", job="Scan")
def scan(call: Call) -> None:
    """Example: uwlts scan plan.toml --camera gige:192.168.1.10 --stage /dev/ttyACM0 --home --out scan.h5"""
    seen = call()
    warn(*seen.warnings())
    exposures = ", ".join(f"{light} {value:.3g} ms" for light, value in seen.exposure_ms.items())
    lines = f"{seen.found} of {seen.lines} profile lines with a stripe"
    say(f"wrote {call.given['out']}, {lines}; exposure {exposures or 'as before'}")


@command_from(app, uwlts.desk, "watch", job="Scan")
def watch(call: Call) -> None:
    """Example: uwlts watch scan.h5 --calibration calibration.json"""
    call()


@command_from(app, uwlts.desk, "serve_desk", job="Scan")
def desk(call: Call) -> None:
    """Example: uwlts desk tank --plan plan.toml"""
    call()


@command_from(app, uwlts.desk, "serve_ros", job="Scan")
def ros(call: Call) -> None:
    """Example: uwlts ros plan.toml --calibration calibration.json --home"""
    call()


@command_from(app, uwlts, "examine", job="Scan")
def doctor(call: Call) -> None:
    """End with exit code 1 if something required, or something named here, is missing or does not work.

    Example: uwlts doctor --camera gige: --stage /dev/ttyACM0
    """
    from uwlts.doctor import print_findings

    findings = call()
    print_findings(findings)
    if any(each.status == "missing" for each in findings):
        sys.exit(1)
