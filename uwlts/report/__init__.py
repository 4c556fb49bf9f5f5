"""A campaign's files as one page, a summary and a table.

`gather` reads the folder, `published` the values to compare with, `table` and `summary_file` turn both into numbers,
`page` into HTML; the pictures are made by `stripe_picture`, `cloud_picture`, `figures` and `calibration_figures`.
"""

from uwlts.report.gather import Campaign, gather_campaign
from uwlts.report.page import write_report
from uwlts.report.pictures import write_pictures
from uwlts.report.published import Reference, load_reference
from uwlts.report.summary_file import summary, write_summary
from uwlts.report.table import print_table, summary_table

__all__ = [
    "Campaign",
    "Reference",
    "gather_campaign",
    "load_reference",
    "print_table",
    "summary",
    "summary_table",
    "write_pictures",
    "write_report",
    "write_summary",
]
