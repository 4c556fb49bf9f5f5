"""What a cloud is worth: fitted shapes, artefacts with calibrated sizes, comparison with ground truth."""
