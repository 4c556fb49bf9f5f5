"""Camera, window, laser sheet and brightness: arrays in, arrays out."""
