"""The methods that the thesis compares, and their calibrations from one campaign's recordings.

- ``proposed``: camera and sheet in air through the window, then the distance of one refracting interface from the step
  standard in water (section 3.2). In air the same camera and sheet, with the window's effect in the distortion.
- ``two refractions``: the same with the window off in air, and the window's two faces in water (section 4.8.2).
- ``polynomials``: per profile line Z(v) and Y(Z), wholly in the medium of use (section 4.7).
- ``window forgotten``: in air, camera and sheet of the calibration with the window off, though the scan was made
  through it; an experiment.
- ``single viewpoint``: camera and sheet in water as if it were air, so that focal length and distortion take up the
  refraction (named in section 2.3 and not tried).
"""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from uwlts.calibration.any_calibration import AnyCalibration, read_any_calibration
from uwlts.calibration.model import Calibration, write_calibration
from uwlts.calibration.polynomial import calibrate_polynomials
from uwlts.calibration.polynomial_model import PolynomialCalibration, write_polynomials
from uwlts.calibration.procedure import CalibrationOptions, calibrate_sequentially
from uwlts.capture import Capture
from uwlts.thesis.folder import CampaignFolder

PROPOSED, TWO, POLYNOMIALS, SINGLE = "proposed", "two refractions", "polynomials", "single viewpoint"
FORGOTTEN = "window forgotten"
METHODS = {"air": (PROPOSED, POLYNOMIALS, FORGOTTEN), "water": (PROPOSED, TWO, POLYNOMIALS, SINGLE)}


def calibrations(
    folder: CampaignFolder, *, progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[tuple[str, str], AnyCalibration]:
    """Calibrations by method and medium; those made since the recordings are read from the folder ``calibrations``.

    Raises
    ------
    CaptureError
        A recording is missing or damaged.
    CalibrationError
        The recordings do not determine a calibration.
    """
    made = {
        (PROPOSED, "water"): lambda: _rays(folder.target("air"), folder.steps(), refractions=1),
        (TWO, "water"): lambda: _rays(folder.target("bare"), folder.steps(), refractions=2),
        (SINGLE, "water"): lambda: _rays(folder.target("water"), [], refractions=1),
        (POLYNOMIALS, "air"): lambda: _polynomials(folder.target("air")),
        (POLYNOMIALS, "water"): lambda: _polynomials(folder.target("water")),
    }
    place = folder.path / "calibrations"
    place.mkdir(exist_ok=True)
    found: dict[tuple[str, str], AnyCalibration] = {}
    evidence = [*folder.steps(), *(folder.target(kind) for kind in ("air", "bare", "water"))]
    newest = max(path.stat().st_mtime_ns for path in evidence)
    for number, ((method, medium), make) in enumerate(made.items()):
        progress(number, len(made))
        path = place / f"{method.replace(' ', '-')}-{medium}.json"
        write = write_polynomials if method == POLYNOMIALS else write_calibration
        if not path.is_file() or path.stat().st_mtime_ns < newest:
            write(path, make(), overwrite=True)
        found[method, medium] = read_any_calibration(path)
    progress(len(made), len(made))
    # In air nothing but camera and sheet is used of a calibration.
    for method, source in ((PROPOSED, PROPOSED), (FORGOTTEN, TWO)):
        found[method, "air"] = found[source, "water"].model_copy(update={"window": None})
    return found


def _rays(target: Path, steps: list[Path], *, refractions: int) -> Calibration:
    with ExitStack() as stack:
        air = [stack.enter_context(Capture(target))]
        opened = [stack.enter_context(Capture(path)) for path in steps]
        return calibrate_sequentially(air, opened, options=CalibrationOptions(refractions=refractions)).calibration


def _polynomials(target: Path) -> PolynomialCalibration:
    with Capture(target) as capture:
        return calibrate_polynomials([capture]).calibration
