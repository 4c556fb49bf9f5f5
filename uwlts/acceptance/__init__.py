"""Acceptance test of a sensor: plan, measured characteristics, decisions, and the shares of stage and sensor."""
