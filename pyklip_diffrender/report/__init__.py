"""The report on a reduction, as an HTML page and as a JSON summary."""

from pyklip_diffrender.report.epochs import compare_epochs, write_epochs
from pyklip_diffrender.report.summary import summarise
from pyklip_diffrender.report.write import write_report

__all__ = ["compare_epochs", "summarise", "write_epochs", "write_report"]
