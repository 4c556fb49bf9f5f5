"""The twin as hardware: camera and motion controller with the protocols of real devices."""
