"""Settings of the default method."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from pyklip_diffrender.linear.model import LinearModel
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.wavefront.bases import Basis
from pyklip_diffrender.wavefront.priors import WavefrontPrior

__all__ = ["GaussNewtonOptions"]


@dataclass(frozen=True)
class GaussNewtonOptions:
    """Settings of the Gauss-Newton refinement.

    Attributes
    ----------
    free : tuple of str
        Free parameters besides the wavefront.
    wavefront : bool
        Fit the wavefront; False fits the alignment only.
    basis : Basis, optional
        Default segment motions and Fourier modes.
    cycles : tuple of float
        Highest spatial frequency of the default basis, across the pupil: the first one, and, as
        long as those before do not explain the data, the next.
    prior : WavefrontPrior
    own : tuple of str
        Of the free parameters, those of which every frame has its own value when several are
        fitted together.
    drift : WavefrontPrior, optional
        How much the wavefronts of several frames may differ from the one they share; by default
        not at all.
    drift_cycles : float
        Highest spatial frequency of such differences.
    planets : tuple of Planet
        Companions with parameters of their own from the start; positions relative to the star.
    resume : LinearModel, optional
        Of an earlier fit, to go on from; its companions are not taken over.
    companions : int
        Most companions that may get parameters of their own, if they stand out of what the
        alignment fit leaves.
    companion_threshold : float
        How far they must stand out, in units of the matched filter's scatter.
    response_npix : int
        Pupil samples of the copy of the model that gives derivatives.
    max_iterations : int
    tolerance : float
        Converged when a step lowers the penalised chi2 per pixel by less than this.
    kappa_floor : float
        Smallest model error, as a share of the star.
    relinearise : float
        Relative change of the field in the pupil (rms; radians for a phase) beyond which its
        response to the wavefront is computed anew, see `response.Responses`.
    robust : float
        Residuals of this many sigma count half (Cauchy's weights); inf for plain least squares.
    """

    free: tuple[str, ...] = ("star_offset", "lyot_shift", "lyot_rotation", "flux", "background")
    wavefront: bool = True
    basis: Basis | None = None
    cycles: tuple[float, ...] = (24.0, 32.0)
    prior: WavefrontPrior = field(default_factory=WavefrontPrior)
    own: tuple[str, ...] = ("star_offset", "flux", "background")
    drift: WavefrontPrior | None = None
    drift_cycles: float = 8.0
    planets: tuple[Planet, ...] = ()
    resume: LinearModel | None = None
    companions: int = 0
    companion_threshold: float = 4.0
    response_npix: int = 128
    max_iterations: int = 40
    tolerance: float = 1e-3
    kappa_floor: float = 0.0
    relinearise: float = 0.05
    robust: float = math.inf
