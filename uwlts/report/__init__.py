"""A campaign's files as one page, a summary and a table.

`gather` reads the folder, `published` the values to compare with, `table` and `summary_file` turn both into numbers,
`page` into HTML; the pictures are made by `stripe_picture`, `cloud_picture`, `figures` and `calibration_figures`.
"""
