"""Software of an underwater laser triangulation sensor: calibrate, reconstruct, evaluate."""

__version__ = "0.1.0"
