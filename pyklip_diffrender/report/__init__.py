"""What a reduction shows, as a page for people and a summary for programs."""

from pyklip_diffrender.report.summary import summarise
from pyklip_diffrender.report.write import write_report

__all__ = ["summarise", "write_report"]
