"""Guided calibration with camera and stage: plan, requests to the operator, judgement, display and recording."""
