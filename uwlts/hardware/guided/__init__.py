"""A guided calibration with camera and stage: what is planned, asked for, judged, shown and recorded."""
