"""The report on a reduction, as an HTML page and as a JSON summary."""

from pyklip_diffrender.report.summary import summarise
from pyklip_diffrender.report.write import write_report

__all__ = ["summarise", "write_report"]
