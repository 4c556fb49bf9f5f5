"""Recalibration by overlapping passes over an unknown scene, and the pass that would help most."""
