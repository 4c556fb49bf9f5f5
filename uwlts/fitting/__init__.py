"""Fits to points: robust least squares, basic shapes, local surfaces and the spacing of points."""
