"""`reduce`: from a sequence of frames to planets, with a report."""

from pyklip_diffrender.options import ReduceOptions
from pyklip_diffrender.reduction.reduction import Reduction, reduce

__all__ = ["ReduceOptions", "Reduction", "reduce"]
