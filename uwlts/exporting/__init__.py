"""Captures and clouds in the formats of other programs."""

from uwlts.exporting.captures import export_capture
from uwlts.exporting.clouds import CLOUD_FORMATS, export_cloud

__all__ = ["CLOUD_FORMATS", "export_capture", "export_cloud"]
