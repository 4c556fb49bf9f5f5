"""Dark surfaces beside shiny ones, at one exposure and in a bracket of three, compared with the true stripe.

``python docs/studies/stripe_brackets.py`` prints a table of docs/results/stripe-methods.md; ``--write`` puts it there.
"""

from collections.abc import Iterator

import numpy as np
from cyclopts import App
from result_tables import publish, table

from twin.rendering_options import Options, use_variant
from twin.scene.description import Scene
from uwlts.model.library import load_sensor
from uwlts.stripe import extract_stripe
from uwlts.stripe.exposures import fuse_exposures

BRACKET = (1.0, 5.0, 25.0)
FRAMES, CLEAR_MM, FULL_DN = 6, 2.0, 255.0
SHOWN = "exposure 1", "exposure 25", "bracket"


def scene(*things: dict[str, object]) -> Scene:
    motion = {"start_mm": -0.5 * FRAMES, "step_mm": 1.0, "count": FRAMES}
    return Scene.model_validate({"title": "", "medium": "water", "objects": things, "motion": motion})


def plate(y: float, **finish: object) -> dict[str, object]:
    return {"kind": "plate", "width_mm": 80.0, "height_mm": 60.0, "position_mm": (0.0, y, 0.0)} | finish


WELD = {
    "kind": "weld",
    "finish": "metal",
    "plate_mm": (80.0, 120.0),
    "along": "x",
    "beads": 3,
    "position_mm": (0, 0, 0),
}
RUBBER, STEEL = {"reflectance": 0.004}, {"finish": "metal", "reflectance": 0.6}
CASES = (scene(plate(-32.0, **RUBBER), plate(32.0, **STEEL)), ("rubber", "steel")), (scene(WELD), ("beads",))


def rows() -> Iterator[list[str]]:
    from twin.recording.frame_truth import find_true_stripe
    from twin.recording.sensor_simulator import SensorSimulator

    for of, surfaces in CASES:
        studio, sensor = SensorSimulator(load_sensor("thesis"), of, Options(spp=64)), load_sensor("thesis")
        exposure = studio.exposure_ms["laser"] * np.array(BRACKET)
        errors: dict[tuple[str, str], list[np.ndarray]] = {}
        for number, shot in enumerate(of.motion.shots()):
            truth = find_true_stripe(studio.renderer, studio.pose(shot))
            images = [studio.expose(shot, 10 * number + k, exposure=BRACKET[k]).image for k in range(len(BRACKET))]
            image, saturation = fuse_exposures(images, exposure, full_dn=FULL_DN)
            looked = dict(zip(SHOWN, ((images[0], FULL_DN), (images[-1], FULL_DN), (image, saturation)), strict=True))
            y = truth.point_mm[:, 1]
            for shown, (each, full) in looked.items():
                found = extract_stripe(each, stripe_along=sensor.camera.stripe_along, saturation=full)
                for surface in surfaces:
                    here = np.isfinite(truth.centre_px)
                    if len(surfaces) > 1:
                        here &= (y < -CLEAR_MM - 2.0) if surface == "rubber" else (y > CLEAR_MM + 2.0)
                    errors.setdefault((surface, shown), []).append((found.centre_px - truth.centre_px)[here])
        for surface in surfaces:
            cells = []
            for shown in SHOWN:
                error = np.concatenate(errors[surface, shown])
                near = error[np.abs(error) < 2.0]
                part = "" if len(near) == len(error) else f" on {100 * len(near) / len(error):.1f} %"
                cells.append(f"{np.std(near):.3f}{part}" if len(near) else "not found")
            yield [surface, *cells]


def main(*, write: bool = False) -> None:
    """Print the table; with `--write`, put it into its page."""
    use_variant()
    publish({"exposure brackets": table(["std px", *SHOWN], list(rows()))}, write=write)


if __name__ == "__main__":
    App(help=__doc__, help_format="plaintext", default_command=main)()
