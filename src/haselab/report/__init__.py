"""Figures, page and table of a run, from the files in its folder."""

from haselab.report.folder import RunFolder, read_folder
from haselab.report.page import Page, compose_page, save_page, write_report
from haselab.report.table import results_table

__all__ = [
    "Page",
    "RunFolder",
    "compose_page",
    "read_folder",
    "results_table",
    "save_page",
    "write_report",
]
