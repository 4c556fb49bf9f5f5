"""Data sets of rendered, labelled images for training and testing: description, generation, files and reading.

`load` is a short name of `twin.load_dataset`.
"""

from uwlts.storage.data_set import DataSet as DataSet, load_dataset as load_dataset

load = load_dataset

__all__ = ["DataSet", "load", "load_dataset"]
