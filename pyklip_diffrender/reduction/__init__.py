"""`reduce`: from a sequence of frames to planets, with a report."""

from pyklip_diffrender.options import SPECTRA, ReduceOptions
from pyklip_diffrender.reduction.pipeline import Preparation, ReductionResult, prepare
from pyklip_diffrender.reduction.products import (
    PRODUCTS,
    ProductFolder,
    write_products,
)
from pyklip_diffrender.reduction.reduction import Reduction, reduce
from pyklip_diffrender.reduction.several import (
    COMPARISON,
    by_star,
    combined_rows,
    in_words,
    search_together,
    write_comparison,
)
from pyklip_diffrender.reduction.summary import summarise
from pyklip_diffrender.reduction.visit import Visit

__all__ = [
    "COMPARISON",
    "PRODUCTS",
    "SPECTRA",
    "Preparation",
    "ProductFolder",
    "ReduceOptions",
    "Reduction",
    "ReductionResult",
    "Visit",
    "by_star",
    "combined_rows",
    "in_words",
    "prepare",
    "reduce",
    "search_together",
    "summarise",
    "write_comparison",
    "write_products",
]
