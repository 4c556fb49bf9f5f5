"""Independent reference implementations in float64 with NumPy; they do not import the twin or the sensor software."""
