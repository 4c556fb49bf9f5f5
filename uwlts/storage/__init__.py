"""Files: captures, clouds, ground truth and calibrations; import and export of foreign formats."""

# Whoever imports the type of clouds can write them.
from uwlts.storage import cloud_files

__all__ = ["cloud_files"]
