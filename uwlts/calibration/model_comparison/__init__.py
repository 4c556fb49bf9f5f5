"""Comparison of models of the sensor, judged by images that the calibration does not use."""
