"""Recording of captures with ground truth, and of campaigns."""
