"""Camera, window, laser sheet and brightness on arrays; the design formulas; whether a calibration fits a capture."""
