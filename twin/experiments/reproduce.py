"""Reproduction of the thesis's evaluation: experiments with its campaign, compared with its tables; the demonstration.

All scans are measured with all calibrations, with the thesis's stripe detection ("low pass") and the default one. In
air, the calibration with one refraction is used without its window. "window forgotten" is one without the window.

The comparison of calibrations is an experiment on scans that no calibration has used. The thesis's two methods use the
target in air, without or with the camera's window, and the steps. The joint calibration uses these, then also the
target in water, then also half of the scans of spheres in water, which were recorded in other water; their sizes are
not used. The errors are those of the other half, and of all scans in air.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from twin.experiments.experiment import run_experiment
from twin.experiments.result import PAGE
from twin.experiments.runner import Method
from twin.recording.campaigns import RecordingOptions, require_at_least
from twin.rendering_options import CPU, Variant
from twin.scene.campaign import load_campaign
from uwlts.runtime.progress import ProgressListener, ignore_progress

_PLACES = "near", "standoff", "far"
_STEPS = tuple(f"step-{place}-water" for place in _PLACES)
_IN_AIR = tuple(f"spheres-{place}{again}-air" for place in _PLACES for again in ("", "-2"))
_HELD_OUT = (*(f"spheres-{place}-2-water" for place in _PLACES), *_IN_AIR)
_BOTH = ("target-bare", "target-air")
_IN_WATER = {"air": _BOTH, "water": ("target-water",), "step": _STEPS}
_ONE = Method("one refraction", {"air": ("target-air",), "step": _STEPS}, (), "--refractions 1", "-one-refraction")
_TWO = Method("two refractions", {"air": ("target-bare",), "step": _STEPS}, (), "--refractions 2", "-two-refractions")
"""The thesis's two methods, without scans."""
METHODS = (
    replace(_ONE, scans=_HELD_OUT),
    replace(_TWO, scans=[scan for scan in _HELD_OUT if scan not in _IN_AIR]),
    Method("joint, same evidence", {"air": _BOTH, "step": _STEPS}, _HELD_OUT, "--joint", "-joint-same-evidence"),
    Method("joint, with the target in water", _IN_WATER, _HELD_OUT, "--joint", "-joint-with-target-in-water"),
    Method(
        "joint, with scans too",
        _IN_WATER | {"scan": [f"spheres-{place}-water" for place in _PLACES]},
        (*_HELD_OUT, "plane-standoff-water", "plane-standoff-air"),
        "--joint --new-water --unknown-sizes",
        "-joint-with-scans",
    ),
)
"""Calibrations of the comparison: the thesis's two methods, and the joint one by its evidence."""


_MEDIA = "air", "water"
_SPHERES, _PLANES, _FORMS = (
    {medium: [f"{thing}-{place}-{medium}" for thing in things for place in places] for medium in _MEDIA}
    for things, places in (
        (["spheres"], [f"{place}{again}" for place in _PLACES for again in ("", "-2")]),
        (["plane"], [f"{place}{turned}" for place in _PLACES for turned in ("", "-turned")]),
        (["pipe", "head", "weld"], ["standoff"]),
    )
)
_ALL = {medium: [*_SPHERES[medium], *_PLANES[medium], *_FORMS[medium]] for medium in _MEDIA}
_STUDY = {"step": _STEPS, "spheres": _SPHERES["water"], "line": ("line-width", "line-height")}
_CALIBRATIONS = (
    replace(_ONE, scans=[*_ALL["air"], *_ALL["water"]]),
    replace(_TWO, scans=_ALL["water"]),
    *(
        Method("polynomials", {"captures": (f"target-{each}",)}, _ALL[each], "", f"-polynomials-{each}", "polynomials")
        for each in _MEDIA
    ),
    Method("single viewpoint", {"air": ("target-water",)}, _ALL["water"], "--refractions 1", "-single-viewpoint"),
    Method("window forgotten", {"air": ("target-bare",)}, _SPHERES["air"], "", "-window-forgotten"),
)
_LOW_PASS = {
    "low pass": "low_pass=0.4",
    "mean of 5x5": "low_pass=0",
    "fit over 3 px": "low_pass=0.4 low_pass_fit_px=3",
    "fit over 7 px": "low_pass=0.4 low_pass_fit_px=7",
}
"""The thesis's stripe detection, and other interpretations of its text, which are tried on the spheres."""


def _detect(method: Method, name: str, scans: Sequence[str]) -> Method:
    """Return a method with the thesis's stripe detection in one of its interpretations."""
    ending = f"{method.suffix}-{name.replace(' ', '-')}"
    how = {"suffix": ending, "made": method.suffix, "detection": f"--stripe {_LOW_PASS[name]}", "scans": scans}
    return replace(method, name=f"{method.name}, {name}", **how)


_REFRACTION = _CALIBRATIONS[0]
THESIS_METHODS = [
    replace(method, inspected=False)
    for method in (
        replace(_REFRACTION, thesis=_STUDY),
        *_CALIBRATIONS[1:],
        *(_detect(method, "low pass", method.scans) for method in _CALIBRATIONS),
        *(_detect(_REFRACTION, name, [*_SPHERES["air"], *_SPHERES["water"]]) for name in [*_LOW_PASS][1:]),
    )
]
"""All calibrations of the thesis with both stripe detections."""


def reproduce(
    campaign: str | Path | None = None,
    *,
    joint: bool = False,
    out: str | Path | None = None,
    campaigns: int = 2,
    first: int = 0,
    every: int = 1,
    spp: int = 16,
    workers: int | None = None,
    overwrite: bool = False,
    variant: Variant = CPU,
    progress: ProgressListener = ignore_progress,
) -> Path:
    """Reproduce the thesis as an experiment: all its calibrations and scans, compared with its tables.

    Every campaign has its own imperfections and noise. An interrupted run is resumed, and campaigns are added if
    the number is increased. The path of the page, OUT/experiment.html, is returned.

    Parameters
    ----------
    campaign
        Name or path of the campaign's description; default: "thesis", or "joint" with ``joint``.
    joint
        Compare the joint calibration with both methods of the thesis on the same images, instead.
    out
        Folder for campaigns and results (default: runs/CAMPAIGN). Complete recordings in it are kept.
    campaigns, first, every, workers, overwrite
        As for `predict`.
    spp, variant
        As for `simulate`.
    progress
        As for `predict`.

    Returns
    -------
    pathlib.Path
        The page, ``OUT/experiment.html``.

    Raises
    ------
    DescriptionError, DesignError, OutputError, SetupError, CommandFailed, CaptureError
        As for `experiment`.
    """
    options = RecordingOptions(every, spp, variant, workers, overwrite=overwrite)
    require_at_least(1, campaigns=campaigns)
    require_at_least(0, first=first)
    campaign = campaign or ("joint" if joint else "thesis")
    folder = Path(out or Path("runs") / Path(campaign).stem)
    how = {"name": str(campaign), "progress": progress}
    how |= {"methods": METHODS} if joint else {"methods": THESIS_METHODS, "published": "thesis-tables"}
    seeds = range(first, first + campaigns)
    result = run_experiment(load_campaign(campaign), folder, seeds, options, **how)
    print("\n".join(result.lines()))
    return folder / PAGE


# --- demonstration ----------------------------------------------------------------------------------------------------


_DEMO_SPHERES = tuple(f"spheres-{place}" for place in _PLACES)
DEMO_METHODS = (
    Method("joint", _IN_WATER, (*_DEMO_SPHERES, "step-scan", "pipe")),
    replace(_TWO, scans=_DEMO_SPHERES),
    replace(_ONE, scans=_DEMO_SPHERES),
)
"""The joint calibration, and both methods of the thesis."""


def demo(out: str | Path = "runs/demo", *, progress: ProgressListener = ignore_progress) -> Path:
    """Demonstrate the whole process as an experiment: render a campaign, calibrate, reconstruct, evaluate, compare.

    The campaign has realistic imperfections. It is calibrated jointly and by both methods of the thesis. The commands
    that calibrate and measure are in OUT/commands.sh; each can also be typed by hand. An interrupted demonstration is
    resumed. The path of the page, OUT/experiment.html, is returned.

    Parameters
    ----------
    out
        Folder for all results.
    progress
        As for `predict`.

    Returns
    -------
    pathlib.Path
        The page, ``OUT/experiment.html``.

    Raises
    ------
    CommandFailed
        A command failed; its output gives the reason.
    DescriptionError, OutputError, SetupError
        As for `experiment`.
    """
    how = {"name": "demo", "methods": DEMO_METHODS, "progress": progress}
    result = run_experiment(load_campaign("demo"), Path(out), [0], RecordingOptions(), **how)
    print("\n".join(result.lines()))
    return Path(out) / PAGE
