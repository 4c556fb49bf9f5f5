"""Independent references in float64, NumPy only: they import neither the twin nor the sensor's software."""
