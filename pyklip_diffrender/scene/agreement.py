"""Requirements on observations that are fitted together."""

from __future__ import annotations

from collections.abc import Sequence

from pyklip_diffrender.errors import IncompatibleSetupError
from pyklip_diffrender.scene.admission import EPOCH
from pyklip_diffrender.scene.observation import Observation

__all__ = ["require_agreement"]


def require_agreement(observations: Sequence[Observation]) -> None:
    """Check that observations can share a fit.

    The frames of each have one place and orientation, their dates are at most 5 days apart, and
    where the orientation of one is known, or the frames are real, it is known of all.

    Raises
    ------
    IncompatibleSetupError
        With the names of those that do not belong together.
    """
    for each in observations:
        parts = each.pointings()
        if len(parts) > 1:
            raise IncompatibleSetupError(
                f"{each.name}: its {len(each)} frames show the star at {len(parts)} places or "
                "orientations, and the frames of an observation are averaged. Give its parts, "
                "observation.pointings(), as several observations"
            )
    if len(observations) < 2:
        return
    dated = [each for each in observations if each.date is not None]
    days = [float(each.date.mjd) for each in dated if each.date is not None]
    if days and max(days) - min(days) > EPOCH:
        listed = ", ".join(
            f"{each.name} ({each.date.isot[:10]})" for each in dated if each.date is not None
        )
        raise IncompatibleSetupError(
            f"observation: the wavefront of frames that are more than {EPOCH:g} days apart is not "
            f"the same: {listed}. Refine each epoch alone"
        )
    turning = [each for each in observations if not each.reference]
    unknown = [each for each in turning if each.position_angles is None]
    real = any(each.is_nircam for each in turning)
    if unknown and len(turning) > 1 and (real or len(unknown) < len(turning)):
        raise IncompatibleSetupError(
            f"{', '.join(each.name for each in unknown)}: the orientation on the sky is not known "
            "(ROLL_REF and V3I_YANG of the header, position_angles), and companions rotate with "
            "it. Add it, or refine one observation alone"
        )
