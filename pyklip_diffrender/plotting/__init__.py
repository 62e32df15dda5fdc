"""Figures. The only package that imports matplotlib, and only when a figure is drawn."""

from pyklip_diffrender.plotting.figures import draw_demo, draw_detection, draw_subtraction
from pyklip_diffrender.plotting.panels import draw_image, save
from pyklip_diffrender.plotting.results import (
    plot_detection,
    plot_observation,
    plot_refinement,
    plot_system,
)

__all__ = [
    "draw_demo",
    "draw_detection",
    "draw_image",
    "draw_subtraction",
    "plot_detection",
    "plot_observation",
    "plot_refinement",
    "plot_system",
    "save",
]
