"""Data sets of rendered images with labels, for training and testing: description, generation, files and reading.

`load` is `twin.load_dataset` by its short name.
"""

from twin.datasets.loading import load_dataset as load

__all__ = ["load"]
