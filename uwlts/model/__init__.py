"""Descriptions of sensors, media, targets' surroundings and artefacts, and the types of calibrations; no algorithms."""
