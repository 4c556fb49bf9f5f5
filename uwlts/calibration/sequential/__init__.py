"""Sequential calibration of the thesis: camera, sheet, window distance, one after the other."""
