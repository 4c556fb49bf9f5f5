"""Fit of light, water and noise to the images of a scan: what brightness, width, haze and noise of the stripe show."""
