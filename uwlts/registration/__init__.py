"""Registration of several scans into one coordinate system."""
