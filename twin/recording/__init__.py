"""Recording of captures with ground truth, campaigns, and the demonstration."""
