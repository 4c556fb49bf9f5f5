from . import datasets as datasets
from .datasets import DataSet as DataSet, load_dataset as load_dataset
from .datasets.generation import dataset as dataset
from .design.sweep import SweepResult as SweepResult, sweep as sweep
from .devices.serve import ServedTwin as ServedTwin, serve as serve
from .recording.campaigns import record as record
from .recording.demonstration import demo as demo
from .recording.follow import follow as follow
from .recording.predict import (
    PredictedFigure as PredictedFigure,
    PredictedUncertainty as PredictedUncertainty,
    predict as predict,
)
from .recording.render import Recording as Recording, render as render, simulate as simulate
from .recording.reproduce import reproduce as reproduce
