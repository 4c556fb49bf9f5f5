"""Tab of the operator's page for analyses: form, progress, findings and files of the latest one."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from nicegui import ui

from uwlts.desk.analyses import (
    ANALYSES,
    Analyses,
    AnalysisField,
    AnalysisFinding,
    AnalysisOutcome,
    AnalysisState,
    list_fields,
    name_results,
)
from uwlts.desk.board_page import NumberField
from uwlts.desk.desk_files import list_files
from uwlts.errors import Error
from uwlts.inspection.findings_order import load_order

AddButton = Callable[[str, Callable[[], object]], ui.button]


class AnalysisPanel:
    """Tab in one browser; ``button`` adds a button whose errors are shown, ``mark`` marks places in the cloud."""

    def __init__(
        self, folder: Path, analyses: Analyses, *, button: AddButton, mark: Callable[[Sequence[np.ndarray]], None]
    ):
        self._folder, self._analyses, self._button, self._mark = folder, analyses, button, mark
        self._fields: dict[str, tuple[AnalysisField, Any]] = {}
        self._shown: tuple[AnalysisOutcome | None, str] = (None, "")

    def build(self) -> None:
        """Build the tab."""
        self._kind = ui.select(list(ANALYSES), label="analysis", value="inspect pipe").classes("w-full")
        self._kind.on_value_change(self._build_form)
        self._form = ui.element("div").classes("form")
        with ui.element("div").classes("fields"):
            self._name = ui.input("name of the results")
            self._replace = ui.checkbox("replace existing")
        with ui.row().classes("items-center"):
            self._start = self._button("analyse", self._begin)
            self._cancel = self._button("cancel", self._analyses.cancel).props("outline")
        self._progress = ui.label().classes("text-sm").props('role="status" aria-live="polite"')
        self._bar = ui.linear_progress(0, show_value=False, size="6px").props("instant-feedback")
        self._results = ui.column().classes("w-full gap-1 text-sm")
        self._build_form()
        self.refresh()

    def _build_form(self) -> None:
        """Build the fields of the chosen analysis."""
        self._form.clear()
        self._fields.clear()
        files = _list_files_by_kind(self._folder)
        with self._form:
            for each in list_fields(str(self._kind.value)):
                made = _make_field(each, files)
                if not each.required and each.help:
                    made.tooltip(each.help)
                if each.file_kind:
                    made.on_value_change(self._suggest_name)
                self._fields[each.name] = each, made
        self._suggest_name()

    def _suggest_name(self) -> None:
        """Show the name that is used if none is given."""
        self._name.props["placeholder"] = name_results(str(self._kind.value), self._read())
        self._name.update()

    def _read(self) -> dict[str, Any]:
        return {name: made.value for name, (_, made) in self._fields.items()}

    def set_files(self) -> None:
        """Offer the folder's present files."""
        files = _list_files_by_kind(self._folder)
        for each, made in self._fields.values():
            if each.file_kind:
                options = _offer(each, files)
                # Choices that have disappeared are dropped.
                kept = [one for one in made.value if one in options] if isinstance(made.value, list) else made.value
                made.set_options(options, value=kept if kept in options or isinstance(kept, list) else None)

    def _begin(self) -> None:
        overwrite = bool(self._replace.value)
        self._analyses.start(str(self._kind.value), self._read(), name=self._name.value or "", overwrite=overwrite)

    def refresh(self) -> None:
        """Show the state of the latest analysis."""
        state = self._analyses.state
        self._start.set_enabled(not state.running)
        self._cancel.set_enabled(state.running)
        self._progress.set_text(state.text())
        self._bar.set_visibility(state.running)
        waiting = state.running and not state.total
        self._bar.props(add="indeterminate" if waiting else None, remove=None if waiting else "indeterminate")
        self._bar.set_value(state.done / state.total if state.total else 0.0)
        if (state.outcome, state.error) != self._shown:
            self._shown = state.outcome, state.error
            self._results.clear()
            with self._results:
                self._show_results(state)

    def _show_results(self, state: AnalysisState) -> None:
        if state.error:
            ui.label(state.error).classes("text-red-700 font-bold").props('role="alert"')
        outcome = state.outcome or AnalysisOutcome(())
        for finding in outcome.findings:
            self._show_finding(finding)
        for name in state.files:
            with ui.row().classes("items-center gap-3"):
                address = f"files/{quote(name)}"
                ui.link(name, address).props("download").classes("font-mono break-all")
                if name.endswith(".html"):
                    ui.link("open the report", address, new_tab=True)
        for line in outcome.lines:
            ui.label(line).classes("text-xs font-mono whitespace-pre-wrap")

    def _show_finding(self, finding: AnalysisFinding) -> None:
        with ui.element("div").classes("finding w-full").props(f'data-verdict="{finding.verdict}"'):
            with ui.row().classes("items-center gap-2"):
                ui.label(f"{finding.name}{f': {finding.verdict}' if finding.verdict else ''}").classes("font-bold")
                x, y, z = finding.place_mm
                ui.label(f"X {x:.1f}  Y {y:.1f}  Z {z:.1f} mm").classes("text-xs")
                self._button("mark", partial(self._mark, [np.array(finding.place_mm)])).props("flat dense")
            ui.label("\n".join(finding.values)).classes("text-xs font-mono whitespace-pre-wrap")


def _make_field(each: AnalysisField, files: dict[str, list[str]]) -> Any:
    """Return a new element for a field: a choice, a switch or a number."""
    if each.file_kind or each.choices:
        made = ui.select(_offer(each, files), label=each.label, clearable=not each.required, multiple=each.several)
        return made.props("dense use-chips" if each.several else "dense")
    return ui.checkbox(each.label) if each.switch else NumberField(each.label).props("dense")


def _list_files_by_kind(folder: Path) -> dict[str, list[str]]:
    """Return the names of the folder's files by kind, the latest first; only orders among the descriptions."""
    found: dict[str, list[str]] = {}
    for file in list_files(folder):
        found.setdefault(file.kind, []).append(file.name)
    orders = []
    for name in found.pop("description", []):
        with suppress(Error):
            load_order(folder / name)
            orders.append(name)
    return found | {"description": orders}


def _offer(each: AnalysisField, files: dict[str, list[str]]) -> list[str]:
    return [*files.get(each.file_kind, []), *each.choices]
