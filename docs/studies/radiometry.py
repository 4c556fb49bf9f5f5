"""Radiometry of drawn sensors and waters: errors of the fit, divided by its stated standard uncertainties.

python -m docs.studies.radiometry [CAPTURES] [--folder FOLDER] [--write]
"""

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from cyclopts import App

import twin
import uwlts
from docs.studies.result_tables import publish, table

SENSOR = """
base = "thesis-small"
name = "drawn"
[camera]
width_px = 480
height_px = 384
focal_length_mm = 4.6875
[laser]
waist_radius_mm = {waist}
power_mw = {power}
[detector]
bits = 12
full_well_e = {full_well}
read_noise_e = {read_noise}
black_level_dn = {black}
[media.water]
{water}
"""
SCENE = """
title = "Inclined wall"
medium = "water"
[motion]
start_mm = {start}
step_mm = {step}
count = {count}
[[objects]]
kind = "plate"
width_mm = 440.0
height_mm = 260.0
reflectance = {reflectance}
rotation_deg = [0.0, {turn}, 0.0]
"""
DESCRIBED = {"waist": 0.8, "power": 7.0, "full_well": 10000.0, "read_noise": 22.0, "black": 64.0, "water": ""}
DARK_E_PER_MS = 0.280 * 2 ** (10 / 8)
"""Dark current of the thesis's camera at 35 degC."""
NAMES = {
    "power_reflectance_mw": "laser power times reflectance",
    "attenuation_per_m": "attenuation c",
    "scattering_per_m": "scattering b",
    "sheet_radius_mm": "radius of the sheet",
    "background_dn": "background",
    "gain_dn_per_e": "gain",
    "dark_noise_dn": "noise in the dark",
}


def draw(seed: int) -> dict[str, float]:
    """Return a drawn sensor, water and surface."""
    rng = np.random.default_rng([2026, seed])
    return {
        "waist": rng.uniform(0.6, 1.1),
        "power": rng.uniform(3.0, 12.0),
        "full_well": rng.uniform(6000.0, 15000.0),
        "read_noise": rng.uniform(8.0, 30.0),
        "black": rng.uniform(70.0, 120.0),
        "absorption": rng.uniform(0.3, 1.0),
        "scattering": math.exp(rng.uniform(math.log(0.05), math.log(1.2))),
        "reflectance": rng.uniform(0.4, 0.9),
        "turn": rng.uniform(35.0, 50.0),
    }


def record(folder: Path, seed: int, drawn: dict[str, float]) -> tuple[Path, Path]:
    """Render a scan, and repeated images at one position; the captures state a sensor with other values.

    The repeated images are rendered without multiple scattering: its random walks differ from image to image, and would
    add to the camera's noise.
    """
    keys = {name: drawn[name] for name in DESCRIBED if name != "water"}
    water = f"absorption_per_m = {drawn['absorption']}\nscattering_per_m = {drawn['scattering']}\nphase = 'petzold'"
    (folder / "described.toml").write_text(SENSOR.format(**DESCRIBED))
    (folder / "built.toml").write_text(SENSOR.format(**keys, water=water))
    paths = []
    for name, motion in (("scan", (-65.0, 10.0, 14)), ("repeats", (0.0, 0.0, 6))):
        scene, out = folder / f"{name}.toml", folder / f"{name}-{seed}.h5"
        moved = dict(zip(("start", "step", "count"), motion, strict=True))
        scene.write_text(SCENE.format(**moved, reflectance=drawn["reflectance"], turn=drawn["turn"]))
        if not out.exists():
            without = ("multiple-scattering",) if name == "repeats" else ()
            twin.simulate(
                scene,
                sensor=folder / "described.toml",
                as_built=folder / "built.toml",
                seed=seed,
                without=without,
                out=out,
            )
        paths.append(out)
    return paths[0], paths[1]


def compare(seed: int, folder: Path) -> dict[str, tuple[float, float, float]]:
    """Return truth, estimate and standard uncertainty of every parameter of a drawn capture."""
    drawn = draw(seed)
    scan, repeats = record(folder, seed, drawn)
    calibration = uwlts.nominal(folder / "described.toml", medium="water")
    found = uwlts.fit_radiometry(scan, calibration, repeats=repeats)
    gain = 4095 / drawn["full_well"]
    dark_e = {}
    for name, path in (("scan", scan), ("repeats", repeats)):
        with uwlts.Capture(path) as capture:
            dark_e[name] = DARK_E_PER_MS * float(np.median(capture.exposure_ms))
    truth = {
        # Fewer electrons per grey value: the same light gives more grey values.
        "power_reflectance_mw": drawn["power"] * drawn["reflectance"] * DESCRIBED["full_well"] / drawn["full_well"],
        "attenuation_per_m": drawn["absorption"] + drawn["scattering"],
        "scattering_per_m": drawn["scattering"],
        # Within 65 mm of the focus, the sheet's radius is that of its waist to 1 %.
        "sheet_radius_mm": drawn["waist"],
        "background_dn": drawn["black"] + gain * dark_e["scan"],
        "gain_dn_per_e": gain,
        "dark_noise_dn": gain * math.sqrt(drawn["read_noise"] ** 2 + dark_e["repeats"]),
    }
    return {name: (truth[name], found[name].value, found[name].std) for name in NAMES}


def main(captures: int = 12, *, first_seed: int = 200, folder: Path | None = None, write: bool = False) -> None:
    """Print the ratios; with `--write`, put them into their page."""
    with TemporaryDirectory() as temporary:
        place = Path(temporary) if folder is None else folder
        place.mkdir(parents=True, exist_ok=True)
        found = []
        for seed in range(first_seed, first_seed + captures):
            found.append(compare(seed, place))
            print(seed, {k: tuple(round(x, 4) for x in v) for k, v in found[-1].items()}, flush=True)
    rows = []
    for name, words in NAMES.items():
        truth, value, std = np.array([each[name] for each in found]).T
        ratio = (value - truth) / std
        rows.append(
            [
                words,
                f"{100 * np.sqrt(np.mean((value / truth - 1) ** 2)):.1f}",
                f"{100 * np.median(std / truth):.1f}",
                f"{np.sqrt(np.mean(ratio**2)):.2f}",
            ]
        )
    head = ["estimate", "error, rms %", "stated, median %", "error / stated, rms"]
    publish({"radiometry": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
