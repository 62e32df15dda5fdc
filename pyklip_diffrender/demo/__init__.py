"""The demo: a simulated planet near a star, with KLIP and wavefront refinement side by side."""

from pyklip_diffrender.demo.comparison import (
    DITHERS,
    draw_demo,
    run_demo,
    simulate_references,
    write_demo,
)

__all__ = ["DITHERS", "draw_demo", "run_demo", "simulate_references", "write_demo"]
