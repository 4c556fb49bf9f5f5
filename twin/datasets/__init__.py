"""Data sets of rendered images with labels, for training and testing: description, generation, files and reading."""
