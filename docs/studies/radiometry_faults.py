"""Radiometry where an assumption does not hold: what is said, and which values are wrong in silence.

python -m docs.studies.radiometry_faults [SEEDS] [--first 500] [--folder FOLDER] [--write]
"""

import math
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from cyclopts import App

import twin
import uwlts
from docs.studies.radiometry import DARK_E_PER_MS, DESCRIBED, SCENE, SENSOR, draw
from docs.studies.result_tables import publish, table
from uwlts.radiometry.stripe_images import TAIL_PX

JUDGED = ("power_reflectance_mw", "attenuation_per_m", "scattering_per_m", "sheet_radius_mm", "background_dn")
"""Values that the scan alone gives; gain and noise need repeated images."""
REACH_MM = 65.0  # of the scan, on both sides of its middle
WALL_MM = 440.0  # width of the wall


@dataclass(frozen=True)
class Fault:
    """Lines that a fault adds to the descriptions of water, light and surface; mean of the surface's grey values."""

    phase: str = "'petzold'"
    light: str = ""
    surface: str = ""
    mean_grey: float = 1.0
    reflectance: float = 1.0  # relative to the drawn one; products with the mottle must not exceed 1


def draw_fault(name: str, seed: int, folder: Path, *, turn_deg: float) -> Fault:
    """Return a fault of drawn strength."""
    rng = np.random.default_rng([2027, seed])
    match name:
        case "none":
            return Fault()
        case "phase function":
            if seed % 2:
                return Fault(phase=f"{{kind = 'henyey-greenstein', asymmetry = {rng.uniform(0.85, 0.95)}}}")
            slope = rng.uniform(3.3, 3.9)
            # Coupled as by Mobley, Sundman and Boss (2002): FournierForand.of_backscatter.
            return Fault(phase=f"{{kind = 'fournier-forand', index = {1.01 + 0.1542 * (slope - 3)}, slope = {slope}}}")
        case "reflectance":
            half = REACH_MM / math.cos(math.radians(turn_deg))
            place = np.linspace(-WALL_MM / 2, WALL_MM / 2, 881)
            grey = np.interp(place / half, (-1, 1), rng.permutation((0.5, 1.0)))
            cv2.imwrite(str(folder / f"doubles-{seed}.png"), np.tile(np.round(65535 * grey).astype(np.uint16), (8, 1)))
            return Fault(surface=f"texture = '{folder.resolve()}/doubles-{seed}.png'", mean_grey=0.75)
        case "daylight" | "weak daylight":
            low, high = (-2.0, 0.0) if name.startswith("weak") else (0.0, 2.0)
            return Fault(light=f"[lamp]\nambient_w_per_m2 = {10 ** rng.uniform(low, high)}")
        case "translucent" | "weakly translucent":
            low, high = (-1.3, -0.7) if name.startswith("weak") else (-0.7, 0.3)
            return Fault(surface=f"mean_free_path_mm = {10 ** rng.uniform(low, high)}")
        case "mottle" | "weak mottle":
            lengths = 10 ** rng.uniform(-0.3, 1.0)
            low, high = (0.02, 0.1) if name.startswith("weak") else (0.1, 0.4)
            return Fault(surface=f"mottle = {rng.uniform(low, high)}\nmottle_mm = {lengths}", reflectance=0.5)
    raise ValueError(name)


FAULTS = {
    "none": "as assumed",
    "phase function": "another phase function (Henyey and Greenstein, Fournier and Forand)",
    "reflectance": "reflectance that doubles over the scan",
    "daylight": "daylight of 1 to 100 W/m²",
    "weak daylight": "daylight of 0.01 to 1 W/m²",
    "translucent": "translucent surface, mean free path 0.2 to 2 mm",
    "weakly translucent": "translucent surface, mean free path 0.05 to 0.2 mm",
    "mottle": "mottle of 10 to 40 %, 0.5 to 10 mm long",
    "weak mottle": "mottle of 2 to 10 %, 0.5 to 10 mm long",
}


@dataclass(frozen=True)
class Outcome:
    """Verdicts on one capture: the parts that do not fit, and for each value its state."""

    parts: tuple[str, ...]
    states: dict[str, str]


def measure(name: str, seed: int, folder: Path) -> Outcome:
    """Render a scan with a fault, fit it, and judge each value."""
    drawn = draw(seed)
    fault = draw_fault(name, seed, folder, turn_deg=drawn["turn"])
    stem = f"{name.replace(' ', '-')}-{seed}"
    water = f"absorption_per_m = {drawn['absorption']}\nscattering_per_m = {drawn['scattering']}\nphase = {fault.phase}"
    built = {key: drawn[key] for key in DESCRIBED if key != "water"} | {"water": f"{water}\n{fault.light}"}
    described, as_built, scene = (folder / f"{stem}-{part}.toml" for part in ("described", "built", "scene"))
    described.write_text(SENSOR.format(**DESCRIBED))
    as_built.write_text(SENSOR.format(**built))
    motion = {"start": -REACH_MM, "step": 10.0, "count": 14}
    wall = SCENE.format(**motion, reflectance=fault.reflectance * drawn["reflectance"], turn=drawn["turn"])
    scene.write_text(f"{wall}{fault.surface}\n")
    capture = folder / f"{stem}.h5"
    if not capture.exists():
        twin.simulate(scene, sensor=described, as_built=as_built, seed=seed, out=capture)
    found = uwlts.fit_radiometry(capture, uwlts.nominal(described, medium="water"))
    with uwlts.Capture(capture) as scan:
        exposure_ms = float(np.median(scan.exposure_ms))
    gain = DESCRIBED["full_well"] / drawn["full_well"]
    truth = {
        "power_reflectance_mw": drawn["power"] * drawn["reflectance"] * fault.reflectance * fault.mean_grey * gain,
        "attenuation_per_m": drawn["absorption"] + drawn["scattering"],
        "scattering_per_m": drawn["scattering"],
        "sheet_radius_mm": drawn["waist"],
        "background_dn": drawn["black"] + 4095 / drawn["full_well"] * DARK_E_PER_MS * exposure_ms,
    }
    if fault.light:
        dark = capture.with_suffix(".dark.h5")
        exposed = f"\n[exposure]\nlaser_ms = {exposure_ms}\n"
        described.write_text(SENSOR.format(**DESCRIBED) + exposed)
        as_built.write_text(SENSOR.format(**(built | {"power": 1e-9})) + exposed)
        if not dark.exists():
            twin.simulate(scene, sensor=described, as_built=as_built, seed=seed, out=dark)
        truth["background_dn"] = measure_beside(capture, dark)
    states = {}
    for key in JUDGED:
        if not found[key].determined:
            states[key] = "said"
        else:
            states[key] = "right" if abs(found[key].value - truth[key]) <= 2 * found[key].std else "wrong"
    errors = {key: round(100 * (found[key].value / truth[key] - 1)) for key in JUDGED}
    misfits = {part.part: round(part.misfit, 2) for part in found.parts}
    print(name, seed, states, "errors in %", errors, misfits, flush=True)
    return Outcome(tuple(part.part for part in found.parts if part.misfit > 1), states)


def measure_beside(capture: Path, dark: Path) -> float:
    """Return the mean grey value, in images without the laser, beside the stripe of the other capture."""
    with uwlts.Capture(capture) as scan, uwlts.Capture(dark) as without:
        means = []
        for lit, other in zip(scan, without, strict=True):
            stripe = np.argmax(cv2.GaussianBlur(lit.image, (0, 0), 3.0), axis=0)
            distance = np.abs(np.arange(len(lit.image))[:, None] - stripe)
            means.append(other.image[distance < TAIL_PX].mean())
    return float(np.mean(means))


def main(seeds: int = 5, *, first: int = 500, folder: Path | None = None, write: bool = False) -> None:
    """Print how often each fault is said, and each value right or wrong in silence."""
    with TemporaryDirectory() as temporary:
        place = Path(temporary) if folder is None else folder
        place.mkdir(parents=True, exist_ok=True)
        rows = []
        for name, words in FAULTS.items():
            outcomes = [measure(name, seed, place) for seed in range(first, first + seeds)]
            said = sum(bool(each.parts) for each in outcomes)
            states = [state for each in outcomes for state in each.states.values()]
            counts = [str(states.count(state)) for state in ("right", "wrong")]
            rows.append([words, f"{said} of {seeds}", *counts])
    head = ["fault", "captures with a warning", "right", "wrong in silence"]
    publish({"radiometry-faults": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
