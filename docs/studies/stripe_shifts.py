"""Shares of the stripe shifts by blur and by uneven brightness that rendered objects show, none of them a sphere.

    python docs/studies/stripe_shifts.py

renders heads, weld beads and pipes at several distances in water, with all effects, and prints for each which share of
the largest shift by blur (`uwlts.optics.brightness.moved_by_blur_px`) its stripes show, which share of the shift to
where the light comes from (`beside_sheet`), and the slope error that remains. From the root mean squares follow the
constants of `uwlts.measurement.point_uncertainty` and `uwlts.calibration.joint.noise`. Two minutes a scan on one core.
"""

import tempfile
from pathlib import Path

import numpy as np

from twin.options import Options, use_variant
from twin.scene.description import Scene, load_scene
from uwlts.model.library import load_sensor
from uwlts.optics.brightness import beside_sheet, moved_by_blur_px, slopes_of_brightness
from uwlts.optics.nominal import nominal_calibration
from uwlts.optics.reconstruction import reconstruct_profile
from uwlts.storage.capture import Capture
from uwlts.storage.truth import TruthStatus, read_truth, truth_path
from uwlts.stripe import find_stripes

OBJECTS = {"head": (-80.0, 20.0, 100.0), "weld": (-60.0, 0.0, 90.0), "pipe": (-60.0, 0.0, 90.0)}
"""Scenes, and the Z in mm at which each stands."""
IMAGES, STEP_MM = 24, 1.0
MOST_PX = 0.1
"""Lines whose shift by blur may be larger are left out, as by the reconstruction."""
FAR_OFF_PX = 1.0
STEEP = 0.5
"""Slopes of the surface against the sheet's normal above this show the slope error."""


def scene(thing: str, z_mm: float) -> Scene:
    """A shipped scene at Z, with images a step apart in its middle."""
    motion = load_scene(thing).motion.model_dump() | {
        "start_mm": -0.5 * (IMAGES - 1) * STEP_MM,
        "step_mm": STEP_MM,
        "count": IMAGES,
    }
    changes = {
        "motion": motion,
        "medium": "water",
        "placement": "here",
        "placements": {"here": {"position_mm": [0.0, 0.0, z_mm], "rotation_deg": [10.0, 20.0, 0.0]}},
    }
    return Scene.model_validate(load_scene(thing).model_dump() | changes)


def shares(path: Path) -> dict[str, float]:
    """Shares of the shifts, their standard errors, and the slope error in px, of one capture with its truth."""
    header, truth = read_truth(truth_path(path))
    calibration = nominal_calibration(header.sensor, header.medium)
    with Capture(path) as capture:
        found = find_stripes(capture)
        index = header.medium.refractive_index(header.sensor.laser.wavelength_nm)
        stage, direction = capture.stage_mm[found.frame], np.array(capture.header.stage_direction)
        slopes = slopes_of_brightness(found.frame, found.line, found.amplitude, capture.stage_mm, capture.exposure_ms)
        beside = beside_sheet(
            calibration,
            header.sensor,
            found.line,
            found.centre_px,
            found.width_px,
            slopes,
            medium_index=index,
            stage_direction=tuple(direction.tolist()),
        )

    def points(further_px: float = 0.0) -> np.ndarray:
        return reconstruct_profile(
            calibration,
            found.line,
            found.centre_px + further_px,
            medium_index=index,
            stage_mm=stage,
            stage_direction=direction,
        ).points_mm

    at = found.frame, found.line
    normal, true = truth.normal[at], truth.point_mm[at]
    per_px = np.sum((points(0.5) - points(-0.5)) * normal, axis=1)
    error_px = np.sum((points() - true) * normal, axis=1) / per_px
    blur_px = moved_by_blur_px(found.frame, found.line, found.centre_px, found.amplitude, found.width_px)
    beside_px = -np.sum(beside * normal, axis=1) / per_px
    used = (truth.status[at] == TruthStatus.VISIBLE) & (truth.crossings[at] == 1) & (np.abs(error_px) < FAR_OFF_PX)
    used &= (np.abs(blur_px) < MOST_PX) & (np.abs(per_px) > 0.02)
    shift = np.stack([blur_px[used], beside_px[used], np.ones(used.sum())], axis=1)
    solution, *_ = np.linalg.lstsq(shift, error_px[used], rcond=None)
    left = error_px[used] - shift[:, :2] @ [solution[0], 1.0]
    spread = np.std(left)
    # Neighbouring lines share their speckle: about two lines a grain, and blur's slopes are means of many lines.
    errors = 2.0 * spread * np.sqrt(np.diag(np.linalg.inv(shift.T @ shift)))
    lean = normal[used][:, 0]
    steep = np.abs(lean) > STEEP
    slope = np.mean(left[steep] * np.sign(lean[steep])) if steep.sum() > 500 else np.nan
    return {
        "blur": solution[0],
        "blur_error": errors[0],
        "beside": solution[1],
        "beside_error": errors[1],
        "slope_px": slope,
        "rms_blur_px": float(np.sqrt(np.mean(shift[:, 0] ** 2))),
        "rms_beside_px": float(np.sqrt(np.mean(shift[:, 1] ** 2))),
        "lines": float(used.sum()),
    }


def main() -> None:
    """Render, print a table, and the root mean squares."""
    use_variant()
    from twin.recording.studio import record_scene

    sensor = load_sensor("thesis-as-built")
    print("| object | Z, mm | lines | blur, rms px | share | beside the sheet, rms px | share | slope error, px |")
    print("| --- " * 8 + "|")
    for thing, places in OBJECTS.items():
        for z_mm in places:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "scan.h5"
                record_scene(scene(thing, z_mm), sensor, path, options=Options(seed=7))
                s = shares(path)
            blur, beside = (f"{s[name]:.2f} ± {s[f'{name}_error']:.2f}" for name in ("blur", "beside"))
            print(
                f"| {thing} | {z_mm:.0f} | {s['lines']:.0f} | {s['rms_blur_px']:.3f} | {blur} | "
                f"{s['rms_beside_px']:.3f} | {beside} | {s['slope_px']:+.4f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
