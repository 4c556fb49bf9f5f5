"""What a joint calibration's evidence leaves open, and what to take next, in a few lines for the terminal."""

from uwlts.calibration.joint.next_shot import next_shots
from uwlts.calibration.joint.volume import estimate_in, lengths_over, regions
from uwlts.calibration.joint.weakness import format_weaknesses, weaknesses
from uwlts.calibration.model import Calibration


def advice_lines(calibration: Calibration) -> list[str]:
    """Weak directions and the shot that would help most; CalibrationError where the estimate is missing or damaged."""
    region = next(iter(regions(calibration)), None)
    if region is None or not region.has_area():
        return ["the stripes of the evidence cover no area: what lengths measured by it are worth is not known"]
    known = estimate_in(calibration, region)
    lengths = lengths_over(calibration, known, region)
    lines = format_weaknesses(weaknesses(lengths, known.parameters.keys, known.covariance))
    return [*lines, *(f"next: {outlook.advice()}" for outlook in next_shots(calibration)[:1])]
