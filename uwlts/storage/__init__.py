"""Files: captures, clouds, ground truth and calibrations; import and export of foreign formats."""

# Importing the type of clouds makes its writer available.
from uwlts.storage import cloud_files

__all__ = ["cloud_files"]
