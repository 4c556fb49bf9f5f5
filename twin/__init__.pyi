from . import datasets as datasets
from .datasets import DataSet as DataSet, load_dataset as load_dataset
from .datasets.generation import dataset as dataset
from .design.sweep import SweepResult as SweepResult, sweep as sweep
from .devices.serve import ServedTwin as ServedTwin, serve as serve
from .experiments.experiment import experiment as experiment, predict as predict
from .experiments.reproduce import demo as demo, reproduce as reproduce
from .experiments.result import ExperimentResult as ExperimentResult
from .recording.campaigns import record as record
from .recording.render import Recording as Recording, render as render, simulate as simulate
