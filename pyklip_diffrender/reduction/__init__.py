"""`reduce`: from a sequence of frames to planets, with a report."""

from pyklip_diffrender.reduction.epochs import EPOCHS, compare_epochs, write_epochs
from pyklip_diffrender.reduction.options import ReduceOptions
from pyklip_diffrender.reduction.pipeline import Preparation, prepare, reduce
from pyklip_diffrender.reduction.products import (
    PRODUCTS,
    existing_products,
    write_products,
    write_report,
)
from pyklip_diffrender.reduction.reduction_result import Reduction
from pyklip_diffrender.reduction.summary import summarise

__all__ = [
    "EPOCHS",
    "PRODUCTS",
    "Preparation",
    "ReduceOptions",
    "Reduction",
    "compare_epochs",
    "existing_products",
    "prepare",
    "reduce",
    "summarise",
    "write_epochs",
    "write_products",
    "write_report",
]
