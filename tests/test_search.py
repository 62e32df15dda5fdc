"""The loop that accepts and dismisses candidates, with a map and fits of candidates made up."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch

from pyklip_diffrender.detection import Candidates, search

PEAKS = {(10, 20): 8.0, (30, 12): 6.0, (25, 33): 5.5}
"""S/N of the map at three pixels."""

FITTED = {(10, 20): 8.0, (30, 12): 4.0, (25, 33): 6.0}
"""The same once the positions are fitted: the second is no candidate."""


class MadeUpMaps:
    """A map with unit information; a candidate takes its own peak away."""

    def __init__(self):
        y, x = np.indices((41, 41)) - 20.0
        self.grid = 0.06 * np.stack([x, y], axis=-1)
        self.groups = ()
        self.information = np.ones((41, 41))
        self.starlight = np.ones((41, 41))
        self.correlation = np.pad([[1.0]], 2)

    def without(self, candidates):
        snr = np.zeros((41, 41))
        for pixel, height in PEAKS.items():
            away = candidates.offsets.numpy() - self.grid[pixel]
            if not (np.hypot(*away.T) < 0.1).any():
                snr[pixel] = height
        return snr

    def snr(self, numerator):
        return numerator


def test_a_dismissed_peak_is_not_taken_again(monkeypatch):
    maps, fitted = MadeUpMaps(), []

    def refine(groups, candidates, reach, *_):
        fitted.append(len(candidates))
        away = [
            np.hypot(*(candidates.offsets.numpy() - maps.grid[pixel]).T).reshape(-1)
            for pixel in FITTED
        ]
        nearest = [list(FITTED)[k] for k in np.argmin(away, axis=0)]
        # The fit moves a source by half a pixel.
        places = [maps.grid[pixel] + 0.03 for pixel in nearest]
        made = Candidates.at(np.reshape(places, (-1, 2)), [FITTED[pixel] for pixel in nearest])
        return replace(made, detection_errors=torch.ones(len(places), dtype=torch.float64))

    monkeypatch.setattr(search, "refine_candidates", refine)
    observation = SimpleNamespace(is_nircam=False)
    fit = SimpleNamespace(
        status=SimpleNamespace(calibrated=False),
        frames=(SimpleNamespace(observation=observation),),
        model=SimpleNamespace(resolution=0.14),
    )
    peaks = search._PeakSearch(maps, [fit], 5.0, 0.2, 1.0)
    candidates, factor, _ = peaks.run(Candidates.at(np.zeros((0, 2)), []))
    assert factor.typical == 1.0
    assert sorted(candidates.contrasts.tolist()) == [6.0, 8.0]
    # Three peaks are fitted and one is dismissed; each needs one fit.
    assert len(fitted) <= 6
