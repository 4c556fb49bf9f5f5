"""Camera and controller that speak their real protocols; the camera sends drawn stripes, since rendering takes long."""

from pathlib import Path

import numpy as np

from tests.system.small_board import small_sensor
from twin.devices.gige_camera import GigeCamera
from twin.devices.grbl_controller import GrblController

WIDTH_PX, HEIGHT_PX = 96, 512
TRAVEL_MM, RESOLUTION_MM = 120.0, 0.001
STAGE = {100: 1 / RESOLUTION_MM, 130: TRAVEL_MM}
"""Settings of the controller."""
START_MM = 5.0
PX_PER_MM = 3.0
"""Motion of a stripe in the image per millimetre of the stage."""


class DrawnCamera(GigeCamera):
    """Draws a stripe across a noisy image, as bright as it was exposed, that moves as the stage does.

    ``controller`` may be replaced by another one; ``lit`` counts the images with laser.
    """

    def __init__(self, controller: GrblController | None = None):
        super().__init__(self._drawn, width_px=WIDTH_PX, height_px=HEIGHT_PX)
        self.controller, self.lit = controller, 0
        self._rng = np.random.default_rng(0)

    def _drawn(self, exposure_ms: float) -> np.ndarray:
        image = self._rng.normal(4.0, 1.0, (HEIGHT_PX, WIDTH_PX))
        state = self.controller.state() if self.controller else None
        if state and state.laser_on:
            self.lit += 1
            centre = 150.0 + PX_PER_MM * state.position_mm % 200.0 + 0.1 * np.arange(WIDTH_PX)
            image += 400.0 * exposure_ms * np.exp(-0.5 * ((np.arange(HEIGHT_PX)[:, None] - centre) / 2.0) ** 2)
        return np.clip(image, 0, 255).astype(np.uint8)


def write_plan(
    folder: Path, camera: GigeCamera, controller: GrblController, *, count: int, step_mm: float, laser_ms: str = "0.4"
) -> Path:
    """A plan for this hardware with its sensor beside it; ``laser_ms`` as in TOML."""
    stage = (f"travel_mm = {TRAVEL_MM}", f"resolution_mm = {RESOLUTION_MM}", "settling_s = 0.0")
    (folder / "sensor.toml").write_text(small_sensor(*stage), encoding="utf-8")
    path = folder / "plan.toml"
    path.write_text(
        f'title = "Drawn"\nsensor = "sensor.toml"\nmedium = "air"\ncamera = "{camera.address}"\nlaser_ms = {laser_ms}\n'
        f'[stage]\nport = "{controller.port}"\nstart_mm = {START_MM}\nstep_mm = {step_mm!r}\ncount = {count}\n'
        "feed_mm_per_min = 900.0\n",
        encoding="utf-8",
    )
    return path
