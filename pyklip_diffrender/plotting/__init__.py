"""Figures. The only package that imports matplotlib, and only when a figure is drawn."""

from pyklip_diffrender.plotting.figures import draw_demo, draw_detection
from pyklip_diffrender.plotting.pages import (
    draw_disk,
    draw_injections,
    draw_search,
    draw_star,
    draw_wavefronts,
)
from pyklip_diffrender.plotting.panels import draw_image, save, to_png
from pyklip_diffrender.plotting.results import (
    plot_detection,
    plot_disk,
    plot_observation,
    plot_refinement,
    plot_system,
)
from pyklip_diffrender.plotting.surveys import draw_limits

__all__ = [
    "draw_demo",
    "draw_detection",
    "draw_disk",
    "draw_image",
    "draw_injections",
    "draw_limits",
    "draw_search",
    "draw_star",
    "draw_wavefronts",
    "plot_detection",
    "plot_disk",
    "plot_observation",
    "plot_refinement",
    "plot_system",
    "save",
    "to_png",
]
