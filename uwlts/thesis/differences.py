"""Where ours differ from the thesis's values, by how much, and what experiments in the twin say of the cause."""

from collections.abc import Sequence

from uwlts.thesis.tables import LARGEST_RATIO, MEAN, TableRow


def differences(rows: Sequence[TableRow]) -> list[str]:
    """Sentences with the measured numbers; those whose rows were not measured are left out."""
    found = {(row.table, row.row, row.quantity): row for row in rows}

    def value(table: str, row: str, quantity: str) -> float | None:
        known = found.get((table, row, quantity))
        return None if known is None else known.mean

    def mean(table: str, medium: str, quantity: str, thing: str = "spheres") -> float | None:
        return value(table, f"{thing}, {MEAN}, {medium}", quantity)

    sentences = [
        _said(
            "Standard deviation and range come from speckle and from how the peak is found. With LabVIEW's low-pass "
            "filter, which leaves pixels within 40 % of their neighbours as they are, and a quadratic over 5 pixels, "
            "the spheres in water spread by {} mm (published 0.115); with a plain 5x5 mean it would be {} mm, with a "
            "quadratic over three pixels {} mm, over seven {} mm. Our own profile fit leaves {} mm.",
            mean("Table 6", "water", "STD"),
            mean("Experiment: thesis, mean of 5x5", "water", "STD"),
            mean("Experiment: thesis, fit over 3 px", "water", "STD"),
            mean("Experiment: thesis, fit over 7 px", "water", "STD"),
            mean("Our stripe centre, proposed", "water", "STD"),
        ),
        _said(
            "The published ranges are 4 to 6 standard deviations, which thousands of points with nearly normal errors "
            "cannot have; PE and RE here leave out the 0.3 % that VDI/VDE 2634 allows. Over all points PE in water is "
            "{} mm instead of {} mm, RE {} mm instead of {} mm.",
            mean("Experiment: no point left out", "water", "PE of all points"),
            mean("Table 6", "water", "PE"),
            mean("Experiment: no point left out", "water", "RE of all points", "plane"),
            mean("Table 7", "water", "RE", "plane"),
        ),
        _said(
            "In air the thesis's spheres stand 0.28 and 0.37 mm too far apart or too close, by either method, and ours "
            "{} and {} mm. No imperfection of the list does that. A window that one of the two, calibration or scan, "
            "did not look through does: scans through the window by a calibration made without it err by {} mm. The "
            "thesis suspects its step calibration, which its results in air do not use.",
            mean("Table 2", "air", "SSE"),
            mean("Table 6", "air", "SSE"),
            mean("Experiment: window forgotten in air", "air", "SSE"),
        ),
        _said(
            "In water the sphere spacing of the proposed method errs by {} mm with one refraction and {} mm with two "
            "(published 0.09 and 0.14). It follows the step standard's height, at 48 mm of window distance per mm, and "
            "differs from campaign to campaign more than from position to position: the published standard deviation "
            "over six positions of one campaign does not show it.",
            value("Table 5", f"one refraction, {MEAN}", "SSE"),
            value("Table 5", f"two refractions, {MEAN}", "SSE"),
        ),
        _said(
            "The polynomials in water err by {} mm (published 0.115). All profile lines are fitted together here: each "
            "has its own polynomials, but their coefficients change smoothly from line to line, which takes out the "
            "noise of single lines.",
            mean("Table 2", "water", "SSE"),
        ),
        _said(
            "A single viewpoint in water, refraction taken for distortion, errs by {} mm in the sphere spacing with "
            "our stripe centre; two refractions err by {} mm.",
            mean("Our stripe centre, single viewpoint", "water", "SSE"),
            mean("Our stripe centre, two refractions", "water", "SSE"),
        ),
        _said(
            "The stripe on the pipe is {} mm long along the image's longer side and {} mm along the shorter one; the "
            "thesis says 185.27 mm. A 12.5 mm lens on 1280 pixels of 5.3 um sees that much in water only farther away "
            "than the described stand-off, or 204 mm in air.",
            value("Figure 67", "300 mm pipe at the stand-off, stripe along the width", "line length"),
            value("Figure 67", "300 mm pipe at the stand-off, stripe along the height", "line length"),
        ),
    ]
    return [sentence for sentence in sentences if sentence]


def far_off(rows: Sequence[TableRow]) -> list[TableRow]:
    """Rows whose mean lies outside the factor that a reproduction should keep to."""
    return [row for row in rows if row.ratio is not None and not 1 / LARGEST_RATIO <= row.ratio <= LARGEST_RATIO]


def _said(text: str, *values: float | None) -> str:
    """The text with its numbers, nothing if one is missing."""
    return "" if None in values else text.format(*(f"{value:.3f}" for value in values))
