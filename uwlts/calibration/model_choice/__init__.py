"""Which model of the sensor its images ask for, judged by images that the calibration has not seen."""

from uwlts.calibration.model_choice.comparison import Comparison, compare_models
from uwlts.calibration.model_choice.content import content_of, lines_of
from uwlts.calibration.model_choice.page import refuse_unsuitable_outputs, write_models

__all__ = ["Comparison", "compare_models", "content_of", "lines_of", "refuse_unsuitable_outputs", "write_models"]
