"""Data sets of rendered, labelled images for training and testing: description, generation, files and reading.

`load` is a short name of `twin.load_dataset`.
"""

from twin.datasets.loading import load_dataset as load

__all__ = ["load"]
