"""Analyses of the folder's files in a worker process: reconstruct, inspect, compare, register, recalibrate and export.

An analysis writes into a hidden folder. Its files are moved to their places when all of them are complete.
"""

import inspect
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType, ModuleType
from typing import Any, get_type_hints

import uwlts
from uwlts.argument_types import protect_inputs
from uwlts.comparison.change_reference import KINDS
from uwlts.desk.desk_files import find_file, new_path
from uwlts.desk.shown_state import Board
from uwlts.errors import DescriptionError, Error, OutputError
from uwlts.files.writing import refuse_unsuitable
from uwlts.inspection.features import BLEMISHES, Inspection
from uwlts.inspection.findings_order import judge_feature, load_order, sort_by_severity
from uwlts.runtime.command_line import descriptions, option_type
from uwlts.runtime.progress import ProgressListener
from uwlts.runtime.workers import run_jobs
from uwlts.storage.cloud_files import CLOUD_FORMATS, load_cloud, name_cloud, write_cloud

_POLITE = 10  # reduction of the worker's priority in favour of a recording, as by ``nice``
_FILES: Mapping[str, str] = MappingProxyType(
    {
        "capture": "capture",
        "calibration": "calibration",
        "cloud": "cloud",
        "clouds": "cloud",
        "passes": "capture",
        "poses": "table",
        "file": "cloud",
        "reference": "cloud",
        "order": "description",
        "measured": "measured values",
    }
)
"""Kinds of the files that parameters name."""
_LABELS = {
    "file": "cloud",
    "at_most": "at most, points",
    "order": "order with limits",
    "measured": "measured values",
    "pdf": "also as PDF",
    "pose_std_deg": "pose std, deg",
}
"""Labels of fields whose parameters have no telling names."""
_FORMAT = "format"  # field for the format of an export: the ending of its file


@dataclass(frozen=True)
class AnalysisField:
    """A field of an analysis's form: name of the parameter, label, help, and what can be given.

    ``file_kind`` is the kind of the files to choose from, or empty. ``choices`` are offered besides them.
    """

    name: str
    label: str
    help: str
    required: bool
    file_kind: str = ""
    several: bool = False
    switch: bool = False
    choices: tuple[str, ...] = ()


@dataclass(frozen=True)
class AnalysisFinding:
    """A finding: name, verdict if a limit is stated, place (mm, in the cloud's frame) and values with intervals."""

    name: str
    verdict: str
    place_mm: tuple[float, float, float]
    values: tuple[str, ...]


@dataclass(frozen=True)
class AnalysisOutcome:
    """Result of an analysis besides its files."""

    lines: tuple[str, ...]
    findings: tuple[AnalysisFinding, ...] = ()
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class AnalysisJob:
    """A job of the worker process: kind of analysis, parameters, and the path of its results without ending."""

    kind: str
    values: dict[str, Any]
    out: Path

    def path(self, ending: str) -> Path:
        """Return the path of a result."""
        return self.out.with_name(f"{self.out.name}{ending}")


@dataclass(frozen=True)
class Analysis:
    """A kind of analysis."""

    run: Callable[[AnalysisJob, ProgressListener], AnalysisOutcome]
    """Function of the job and a progress listener, which writes the files."""
    taken: tuple[tuple[ModuleType, str, tuple[str, ...]], ...]
    """Package and name of public functions, and the parameters that the form offers."""
    suffix: str  # addition to the name of the first file, for the results
    endings: tuple[str, ...] = ()  # endings of the results; empty if the form states them


def _inspect(job: AnalysisJob, progress: ProgressListener) -> AnalysisOutcome:
    # Matplotlib is imported in the worker process only.
    from uwlts.report.findings_page import format_interval
    from uwlts.report.plot import deviation_colours, surface_limit_mm

    kind: Any = job.kind.partition(" ")[2]
    found: Inspection = uwlts.report.write_findings(kind=kind, out=job.path(".html"), **job.values)
    cloud = replace(load_cloud(job.values["cloud"]), deviation_mm=found.deviation_mm)
    colours = deviation_colours(found.deviation_mm, surface_limit_mm(found.deviation_mm))
    write_cloud(job.path("-coloured.ply"), cloud, colours=colours)
    order = load_order(job.values.get("order"))
    findings = []
    # As in the report: flaws, the most severe first, then the object.
    parts = sort_by_severity(list(found.select(*BLEMISHES)), order.limits)
    for each in (*parts, *(one for one in found.features if one.kind not in BLEMISHES)):
        verdict = judge_feature(each, order.limits)[0]
        place = (float(each.place_mm[0]), float(each.place_mm[1]), float(each.place_mm[2]))
        values = tuple(f"{value.name} {format_interval(value)} {value.unit}" for value in each.values)
        values += (each.reason,) if each.reason else ()
        findings.append(AnalysisFinding(each.title, "" if verdict == "no limit" else verdict, place, values))
    return AnalysisOutcome(tuple(f"note: {note}" for note in found.notes), tuple(findings))


def _compare(job: AnalysisJob, progress: ProgressListener) -> AnalysisOutcome:
    values = dict(job.values)
    how = {"coloured": job.path("-coloured.ply"), "pdf": values.pop("pdf", False)}
    change = uwlts.compare_clouds(**values)
    title = f"{Path(values['cloud']).name} against {Path(values['reference']).name}"
    uwlts.report.write_change(job.path(".html"), change, title=title, **how)
    findings = tuple(
        AnalysisFinding(
            f"region {number}",
            "",
            each.centre_mm,
            (
                f"largest {each.largest_mm:+.3f} mm (level of detection {each.level_mm:.3f} mm)",
                f"mean {each.mean_mm:+.3f} mm",
                f"area {each.area_mm2:.1f} mm2",
                f"volume {each.volume_mm3:+.1f} mm3",
            ),
        )
        for number, each in enumerate(change.regions(), start=1)
    )
    return AnalysisOutcome(tuple(change.lines()), findings, change.warnings)


def _register(job: AnalysisJob, progress: ProgressListener) -> AnalysisOutcome:
    found = uwlts.register(**job.values, progress=progress)
    found.cloud.save(job.path(f"-merged{_CLOUD}"))
    uwlts.report.write_registration(job.path(".html"), found)
    return AnalysisOutcome(tuple(found.lines()))


def _recalibrate(job: AnalysisJob, progress: ProgressListener) -> AnalysisOutcome:
    found = uwlts.recalibrate(**job.values, progress=progress)
    uwlts.report.write_recalibration(job.path(".html"), found)
    if not found.doubts:
        found.calibration.save(job.path(".json"))
    return AnalysisOutcome(tuple(found.lines()), warnings=(*found.warnings, *found.doubts))


def _export(job: AnalysisJob, progress: ProgressListener) -> AnalysisOutcome:
    values = dict(job.values)
    ending = values.pop(_FORMAT)
    if (at_most := values.get("at_most")) is not None:
        values["at_most"] = int(at_most)
    points = uwlts.export(out=job.path(ending), **values, progress=progress)
    return AnalysisOutcome((f"{points:,} points",))


def _reconstruct(job: AnalysisJob, progress: ProgressListener) -> AnalysisOutcome:
    cloud = uwlts.reconstruct(**job.values, progress=progress)
    write_cloud(job.path(_CLOUD), cloud)
    return AnalysisOutcome((f"{len(cloud):,} points",), warnings=tuple(cloud.warnings))


_REPORT = (uwlts.report, "write_findings", ("order", "measured", "calibration", "pdf"))
_COMPARED = ("cloud", "reference", "register", "same_water", "cloud_std_mm", "reference_std_mm")
_CLOUD = ".cloud.h5"
"""Ending of clouds to measure, with the whole uncertainty."""
_INSPECTED = (".html", ".findings.json", "-coloured.ply")
_FIELDS = {"pipe": ("cloud", "wall_mm"), "weld": ("cloud",)}
ANALYSES: Mapping[str, Analysis] = MappingProxyType(
    {
        "reconstruct": Analysis(_reconstruct, ((uwlts, "reconstruct", ("capture", "calibration")),), "", (_CLOUD,)),
        **{
            f"inspect {kind}": Analysis(_inspect, ((uwlts, f"inspect_{kind}", given), _REPORT), f"-{kind}", _INSPECTED)
            for kind, given in _FIELDS.items()
        },
        "compare": Analysis(
            _compare,
            ((uwlts, "compare_clouds", _COMPARED), (uwlts.report, "write_change", ("pdf",))),
            "-change",
            (".html", ".json", "-coloured.ply"),
        ),
        "register": Analysis(
            _register,
            ((uwlts, "register", ("clouds", "reach_mm", "sphere_mm")),),
            "-registered",
            (".html", ".registration.json", f"-merged{_CLOUD}"),
        ),
        "recalibrate": Analysis(
            _recalibrate,
            ((uwlts, "recalibrate", ("passes", "calibration", "pose_std_mm", "pose_std_deg", "poses")),),
            "-recalibrated",
            (".html", ".recalibration.json", ".json"),
        ),
        "export": Analysis(_export, ((uwlts, "export", ("file", "at_most")),), "-export"),
    }
)


def list_fields(kind: str) -> list[AnalysisField]:
    """Return the fields of an analysis's form, from the signatures and docstrings of its functions."""
    fields = []
    for package, function, names in ANALYSES[kind].taken:
        taken, described = getattr(package, function), descriptions(package, function)
        hints, parameters = get_type_hints(taken), inspect.signature(taken).parameters
        for name in names:
            text = _LABELS.get(name, name.removesuffix("_mm").replace("_", " "))
            fields.append(
                AnalysisField(
                    name,
                    f"{text}, mm" if name.endswith("_mm") else text,
                    described[name].replace("`", ""),
                    parameters[name].default is inspect.Parameter.empty,
                    file_kind=_FILES.get(name, ""),
                    several=name in ("clouds", "passes"),
                    switch=option_type(hints[name]) is bool,
                    choices=tuple(KINDS) if name == "reference" else (),
                )
            )
    if kind == "export":
        about = "Ending of the file; the documentation of cloud formats says what each contains."
        fields.append(AnalysisField(_FORMAT, "format", about, True, choices=CLOUD_FORMATS))
    return fields


def name_results(kind: str, values: Mapping[str, Any]) -> str:
    """Return the default name of an analysis's results, from that of its first file; empty without a file."""
    first = next((values[each.name] for each in list_fields(kind) if each.file_kind), None)
    if isinstance(first, list):
        first = next(iter(first), None)
    return f"{name_cloud(first)}{ANALYSES[kind].suffix}" if first else ""


class _Cancelled(Exception):
    """The operator has cancelled the analysis."""


def _carry_out(job: AnalysisJob, send: Callable[[Any], None]) -> AnalysisOutcome:
    """Run an analysis in the worker process."""
    os.nice(_POLITE)
    return ANALYSES[job.kind].run(job, lambda done, total, stage="": send((done, total, stage)))


@dataclass(frozen=True)
class AnalysisState:
    """State of the latest analysis, for the page; ``files`` are the names of its results."""

    title: str = ""
    running: bool = False
    done: int = 0
    total: int = 0
    stage: str = ""
    begun_s: float = field(default_factory=time.monotonic)
    outcome: AnalysisOutcome | None = None
    files: tuple[str, ...] = ()
    error: str = ""

    def text(self) -> str:
        """Return the progress as text; empty before the first analysis."""
        if not self.running:
            return self.title and f"{self.title}: ended"
        counted = f", {self.stage} {self.done} of {self.total}".replace("  ", " ") if self.total else ""
        return f"{self.title}{counted}, {time.monotonic() - self.begun_s:.0f} s"


class Analyses:
    """Runs one analysis at a time, with results in a folder; ``show`` is called with the path of a cloud to show."""

    def __init__(self, folder: Path, board: Board, show: Callable[[Path], None]):
        self._folder, self._board, self._show = folder, board, show
        self._cancel = threading.Event()
        self._thread: threading.Thread | None = None
        self.state = AnalysisState()

    def start(self, kind: str, given: Mapping[str, Any], *, name: str, overwrite: bool) -> None:
        """Start an analysis with parameters by name, files by their names in the folder.

        Raises DescriptionError, OutputError or CaptureError if it cannot be started.
        """
        if self.state.running:
            raise DescriptionError(f"{self.state.title} is running: wait until it ends, or cancel it")
        values, inputs = self._complete_values(kind, given)
        name = name.strip() or name_results(kind, given)
        endings = ANALYSES[kind].endings or (values[_FORMAT],)
        endings += (".pdf",) if values.get("pdf") else ()
        targets = [new_path(self._folder, f"{name}{ending}", suffix=ending) for ending in endings]
        for each in targets:
            if each.exists() and not overwrite:
                raise OutputError(f"{each.name} exists: give another name, or tick 'replace existing'")
            if each in inputs:
                raise OutputError(f"{each.name} is one of the files to read: give the results another name")
        self._cancel.clear()
        self.state = AnalysisState(f"{kind}: {', '.join(each.name for each in inputs)}", running=True)
        self._board.say(f"begun: {self.state.title}")
        work = (AnalysisJob(kind, values, Path(name)), inputs, targets, overwrite)
        self._thread = threading.Thread(target=self._run, args=work, name="analysis", daemon=True)
        self._thread.start()

    def _complete_values(self, kind: str, given: Mapping[str, Any]) -> tuple[dict[str, Any], list[Path]]:
        """Return the parameters with paths, without empty ones, and the input files."""
        values, inputs = {}, []
        for each in list_fields(kind):
            value = given.get(each.name)
            if value in (None, "", [], False):
                if each.required:
                    raise DescriptionError(f"{kind}: choose the {each.label} first")
                continue
            if each.file_kind and value not in each.choices:
                paths = [find_file(self._folder, file) for file in (value if each.several else [value])]
                inputs += paths
                value = paths if each.several else paths[0]
            values[each.name] = value
        return values, inputs

    def cancel(self) -> None:
        """Cancel the analysis; its files do not appear."""
        self._cancel.set()

    def close(self) -> None:
        """Cancel the analysis, and wait until it has ended."""
        self.cancel()
        if self._thread is not None:
            self._thread.join()

    def _run(self, job: AnalysisJob, inputs: Sequence[Path], targets: Sequence[Path], overwrite: bool) -> None:
        board, title = self._board, self.state.title
        try:
            outcome, names = self._analyse(job, inputs, targets, overwrite)
        except _Cancelled:
            self.state = replace(self.state, running=False, error="cancelled; nothing was written")
            board.say(f"cancelled: {title}", "warning")
        except (Error, OSError) as error:
            self.state = replace(self.state, running=False, error=str(error))
            board.say(f"{title}: {error}", "error")
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            self.state = replace(self.state, running=False, error=f"a bug in the program: {error}")
            board.say(f"a bug in the program: {type(error).__name__}: {error}", "error")
        else:
            for warning in outcome.warnings:
                board.say(warning, "warning")
            self.state = replace(self.state, running=False, outcome=outcome, files=names)
            board.say(f"wrote {', '.join(names)}")
            for name in names:
                if name.endswith((".ply", _CLOUD)):
                    self._show(self._folder / name)

    def _analyse(
        self, job: AnalysisJob, inputs: Sequence[Path], targets: Sequence[Path], overwrite: bool
    ) -> tuple[AnalysisOutcome, tuple[str, ...]]:
        """Run the worker process, and move its files to their places; return their names too."""

        def hear(message: tuple[int, int, str]) -> None:
            done, total, stage = message
            self.state = replace(self.state, done=done, total=total, stage=stage)

        def look() -> None:
            if self._cancel.is_set():
                raise _Cancelled

        with protect_inputs({"inputs": inputs}):
            for each in targets:
                refuse_unsuitable(each, overwrite=overwrite)
            with TemporaryDirectory(prefix=".", dir=self._folder) as aside:
                moved = replace(job, out=Path(aside) / job.out)
                # With more than one worker, also a single job runs in a process of its own.
                (outcome,) = run_jobs(_carry_out, [moved], workers=2, on_message=hear, on_wait=look)
                for each in targets:
                    if each.exists() and not overwrite:
                        raise OutputError(f"{each.name} has appeared meanwhile: give another name")
                # A calibration that is doubted is not written.
                made = [each for each in targets if (Path(aside) / each.name).exists()]
                for each in made:
                    os.replace(Path(aside) / each.name, each)
        return outcome, tuple(each.name for each in made)
