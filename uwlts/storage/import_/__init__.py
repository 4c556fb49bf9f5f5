"""Import of images of any camera and program as a capture."""
