"""Many sequences, filters and injected planets as independent jobs."""

from pyklip_diffrender.surveys.driver import survey

__all__ = ["survey"]
