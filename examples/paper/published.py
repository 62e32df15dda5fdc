"""Numbers that Feng et al. 2025 publish, to be drawn beside this package's."""

from __future__ import annotations

BOUNDARY_SOURCE = "Feng et al. 2025, figure 6, read off, +-10 %"
SEPARATIONS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.2, 2.4)
"""arcsec, of the curves below."""
BOUNDARY = {
    "noise limit": (
        1.5e-5, 1.4e-6, 4.2e-7, 2.6e-7, 1.75e-7, 1.6e-7, 1.9e-7, 2.0e-7, 1.45e-7, 1.05e-7, 7.3e-8,
        6.2e-8,
    ),
    "theirs": (
        4e-5, 2.5e-6, 6.3e-7, 6.3e-7, 2.5e-7, 2.5e-7, 4e-7, 4e-7, 2.5e-7, 1e-7, 1e-7, 1e-7,
    ),
    "KLIP": (
        1.6e-4, 1.25e-5, 4e-6, 2e-6, 1.6e-6, 1e-6, 1e-6, 1e-6, 5e-7, 1e-6, 1e-6, 8e-7,
    ),
}  # fmt: skip
"""5-sigma contrast against separation."""

TABLE_SOURCE = "Feng et al. 2025, figure 9"
TABLE = {
    (0.6, 1e-6): (2.07, 7.49, 7.57),
    (0.6, 5e-6): (4.53, 19.76, 18.78),
    (0.6, 1e-5): (8.57, 20.40, 20.38),
    (0.5, 5e-6): (3.77, 17.99, 15.54),
    (1.0, 5e-6): (16.05, 26.60, 21.96),
    (1.5, 5e-6): (16.85, 39.62, 28.58),
}
"""Annulus SNR by KLIP, by the paper's recipe, and with the true star, by separation (arcsec) and
contrast; 40 h of drift."""
