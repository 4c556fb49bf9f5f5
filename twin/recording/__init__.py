"""Captures with ground truth, campaigns, and the demonstration."""
