"""Files: captures, clouds, ground truth and calibrations; import and export of foreign formats."""
