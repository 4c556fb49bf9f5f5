"""Types of descriptions (sensor, media, artefacts) and of results (calibration, mount, stripes); no algorithms."""
