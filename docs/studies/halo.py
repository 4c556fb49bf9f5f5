"""Halo of a stripe on an inclined wall: closed form of `uwlts radiometry` against the twin's random walks, unsmoothed.

python -m docs.studies.halo [WALKS] [--write]
"""

from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from cyclopts import App
from scipy.spatial.transform import Rotation

import uwlts
from docs.studies.radiometry import DESCRIBED, SCENE, SENSOR
from docs.studies.result_tables import publish, table
from twin.rendering_options import NONE, use_variant
from twin.scene.description import load_scene
from uwlts.model.library import load_sensor
from uwlts.model.phase_functions import PetzoldAverage
from uwlts.radiometry.stripe_light import HaloKernel, light_at

WATER = "absorption_per_m = 0.4\nscattering_per_m = {scattering}\nphase = 'petzold'"
TURN_DEG = 40.0
ACROSS, ALONG = np.arange(-94, 95, 2), np.arange(-40, 40, 2)
"""First pixels of cells of 2 x 2 px, from the stripe's centre and from the middle of the image."""
EDGES = (8, 12, 18, 24, 30, 42, 54, 66, 78, 92)
"""Distances from the stripe, px, between which light is averaged."""


def measure(scattering: float, walks: int, folder: Path) -> list[list[str]]:
    """Return rows of the table for a scattering coefficient in 1/m."""
    use_variant()
    import drjit as dr
    import mitsuba as mi

    from twin.backend.arrays import begin_kernels, to_jit
    from twin.light.illumination import make_lights
    from twin.light.pose import SensorPose
    from twin.light.renderer import Renderer
    from twin.light.walk import Walker

    (folder / "sensor.toml").write_text(SENSOR.format(**DESCRIBED | {"water": WATER.format(scattering=scattering)}))
    wall = SCENE.format(start=0.0, step=0.0, count=1, reflectance=0.8, turn=TURN_DEG)
    (folder / "scene.toml").write_text(wall)
    sensor, scene = load_sensor(folder / "sensor.toml"), load_scene(folder / "scene.toml")
    water, rest = sensor.media["water"], np.eye(4)
    stripe = Renderer(sensor, water, scene, effects=NONE).laser_frame(rest, spp=64).direct()
    middle = stripe.shape[1] // 2
    seen = stripe[:, middle + ALONG]
    centre = float(np.mean(np.arange(len(stripe)) @ seen / seen.sum(axis=0)))

    effects = type(NONE)(**dict.fromkeys(vars(NONE), False) | {"multiple_scattering": True})
    renderer = Renderer(sensor, water, scene, effects=effects)
    begin_kernels()
    direct, _ = make_lights(renderer._sheets, SensorPose(rest, None), ())
    walker = Walker(renderer.objects, renderer.scattering, effects, SensorPose(rest, None), direct, renderer._reach_mm)
    row, column = (each.ravel() for each in np.meshgrid(round(centre) + ACROSS, middle + ALONG, indexing="ij"))
    cell, rng = np.repeat(np.arange(len(row)), walks), np.random.default_rng(0)
    x, y = (to_jit((first[cell] - 0.5 + 2 * rng.random(len(cell))).astype(np.float32)) for first in (column, row))
    found = np.zeros(len(ACROSS))
    numbers = dr.arange(mi.UInt32, len(cell)) // dr.opaque(mi.UInt32, walks)
    for number, light, _ in walker.trace(renderer.view.trace_bundle(x, y), numbers, seed=1):
        found += np.bincount(number // len(ALONG), light, len(ACROSS))
    found /= walks * len(ALONG) * seen.sum(axis=0).mean()

    calibration = uwlts.nominal(sensor, medium="water")
    turn = Rotation.from_euler("y", TURN_DEG, degrees=True).as_matrix()
    normal = calibration.object_transform()[:3, :3] @ turn @ [0.0, 0.0, -1.0]
    index = calibration.medium_index(water)
    lit = light_at(sensor, calibration, np.array([[middle, centre]]), normal[None], medium_index=index)
    paths = [(float(lit.laser_path_mm[0]), float(lit.sheet_per_px[0]))]
    paths.append((float(lit.camera_path_mm[0]), float(lit.ray_per_px[0])))
    kernel = HaloKernel(PetzoldAverage().per_sr, tuple(paths))
    away = round(centre) + ACROSS + 0.5 - centre
    expected = np.interp(away, kernel.place_px, kernel.profile(1e-3 * scattering, sigma_px=1.5))
    rows = []
    for low, high in pairwise(EDGES):
        there = (np.abs(away) >= low) & (np.abs(away) < high)
        ratio = expected[there].mean() / found[there].mean()
        rows.append([f"{scattering:g}", f"{low} to {high}", f"{1e6 * found[there].mean():.0f}", f"{ratio:.3f}"])
    return rows


def main(walks: int = 270, *, write: bool = False) -> None:
    """Print the ratios, for ``walks`` in each cell of 2 x 2 px; with `--write`, put them into their page."""
    with TemporaryDirectory() as temporary:
        rows = [row for scattering in (0.2, 0.9) for row in measure(scattering, walks, Path(temporary))]
    head = ["scattering b, 1/m", "distance, px", "walks: light per px, 10⁻⁶ of the stripe's", "closed form / walks"]
    publish({"halo": table(head, rows)}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
