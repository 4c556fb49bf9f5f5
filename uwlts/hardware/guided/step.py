"""The step standard's part of a guided calibration: at depths apart from each other in the measuring volume."""

import time
from collections.abc import Sequence

import numpy as np

from uwlts.calibration.guidance.step import StepQuality, is_new, judge_step, least_apart_mm, next_depth_mm
from uwlts.calibration.model import Calibration, WindowModel
from uwlts.capture import Capture, CaptureWriter, Frame
from uwlts.hardware.guided.images import GuidedImages
from uwlts.hardware.guided.operator import Operator
from uwlts.hardware.guided.page import GuidedPage
from uwlts.hardware.guided.plan import GuidedPlan
from uwlts.metrology.artefact_descriptions import StepStandard
from uwlts.sensor import Sensor


class StepJudge:
    """Judges laser images of the standard by the calibration in air and the nominal window."""

    def __init__(self, plan: GuidedPlan, sensor: Sensor, calibration: Calibration, window: WindowModel):
        self.sensor = sensor
        self._calibration, self._window = calibration, window
        self._standard = StepStandard.model_validate(plan.step.artefact())
        self._index = sensor.medium(plan.step.medium).refractive_index(sensor.laser.wavelength_nm)

    def judge(self, image: np.ndarray) -> StepQuality:
        """What an image (H, W) shows."""
        return judge_step(
            image, self._calibration, self._window, self._standard, medium_index=self._index,
            full_dn=self.sensor.detector.full_scale_dn(),
        )  # fmt: skip

    def depths_mm(self, capture: Capture) -> list[float]:
        """Depths outside the window at which a recording shows the standard."""
        qualities = [self.judge(image) for _, image in capture.frames(laser_on=True)]
        return [quality.depth_mm for quality in qualities if not quality.reasons]


class StepPhase:
    """Records images of the standard until it was seen near, in the middle and far."""

    def __init__(
        self,
        plan: GuidedPlan,
        judge: StepJudge,
        *,
        images: GuidedImages,
        operator: Operator,
        page: GuidedPage,
        writer: CaptureWriter,
        before_s: float,
    ):
        self._plan, self._judge, self._images = plan, judge, images
        self._operator, self._page, self._writer = operator, page, writer
        self._start_s = time.monotonic() - before_s

    def run(self, seen_mm: Sequence[float]) -> list[float]:
        """Go on after the depths that are recorded; all depths then. Errors as `TargetPhase.run`."""
        seen = list(seen_mm)
        while (wanted := next_depth_mm(seen, self._judge.sensor)) is not None:
            answer = self._ask(
                f"put the step standard about {wanted:.0f} mm outside the window, with the laser line across its step"
            )
            if answer == "done":
                break
            before = tuple(seen)
            for position in self._plan.step.positions_mm or (None,):
                taken = self._take(position, before)
                seen += [] if taken is None else [taken]
        return seen

    def _ask(self, request: str) -> str:
        self._page.request(request)
        return self._operator.wait(request, self._glance)

    def _glance(self) -> None:
        full = self._writer.header.saturation_dn
        self._page.live(self._images.unlit(), full_dn=full, points=None, stripe=None, remark="the laser is off")

    def _take(self, position: float | None, before_mm: Sequence[float]) -> float | None:
        """Take the standard as it stands; at which depth it was recorded, None if it was refused."""
        stage_mm = 0.0 if position is None else self._images.move_to(position)
        image, exposure_ms = self._images.take("laser")
        quality = self._judge.judge(image)
        if any(reason.startswith("stripe saturated") for reason in quality.reasons) and self._images.resettle("laser"):
            image, exposure_ms = self._images.take("laser")
            quality = self._judge.judge(image)
        # Whoever moves the standard must not have the laser before him.
        self._images.unlit()
        reasons = quality.reasons or self._why_not_here(quality.depth_mm, before_mm)
        self._tell(image, quality, reasons)
        if reasons:
            return None
        self._writer.append(Frame(image, stage_mm, True, exposure_ms, time.monotonic() - self._start_s))
        return quality.depth_mm

    def _why_not_here(self, depth_mm: float, before_mm: Sequence[float]) -> tuple[str, ...]:
        if is_new(depth_mm, before_mm, self._judge.sensor):
            return ()
        nearest = min(before_mm, key=lambda other: abs(other - depth_mm))
        return (
            f"too similar: it stands {depth_mm:.0f} mm outside the window and was seen at {nearest:.0f} mm; move it by "
            f"{least_apart_mm(self._judge.sensor):.0f} mm or more",
        )

    def _tell(self, image: np.ndarray, quality: StepQuality, reasons: tuple[str, ...]) -> None:
        if reasons:
            line = f"refused: {'; '.join(reasons)}"
        else:
            line = f"stripe on {len(quality.pixels)} lines, {quality.depth_mm:.0f} mm outside the window"
        self._operator.say(f"step: {line}")
        self._page.add(f"step: {line}")
        full = self._writer.header.saturation_dn
        self._page.live(image, full_dn=full, points=None, stripe=quality.pixels, remark=line)
