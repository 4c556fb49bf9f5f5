"""The twin as hardware: a camera and a motion controller that speak the protocols of real ones."""
