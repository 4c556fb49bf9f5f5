"""One least-squares estimate of camera, window, media and sheet from all evidence together."""
