"""A file that may have frames: its header, its means, and what is wrong with either."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from astropy.io import fits

from pyklip_diffrender.errors import DiffrenderError
from pyklip_diffrender.io.files import open_fits, product_in
from pyklip_diffrender.io.headers import merged_header
from pyklip_diffrender.scene.exposure import Exposure
from pyklip_diffrender.scene.integrations import why_odd_noise
from pyklip_diffrender.scene.observation import Observation, means_in
from pyklip_diffrender.scene.pixel_checks import (
    not_judged,
    why_few_pixels,
    why_no_star,
    why_odd_unit,
)
from pyklip_diffrender.wavefront.opd_map import length_unit
from pyklip_diffrender.wavefront.wss import EXTENSION

_MAP = "it is an OPD map, no frame of a star; OPD maps are given as opd"


@dataclass(frozen=True, eq=False)
class FrameFile:
    """A file that may become part of a sequence."""

    path: Path
    exposure: Exposure
    fault: str = ""  # why the headers say that the file has no frames, or empty
    for_reference: bool = False  # asked for as a reference star's, whatever its header says
    is_product: bool = False  # made from frames, and has none
    place: tuple[float, float] | None = None  # x, y of the star, from 0, if not the header's
    # The mean of the integrations of each pointing, or why they cannot be read; None until needed.
    frames: Observation | DiffrenderError | None = field(default=None, repr=False)

    @classmethod
    def in_hdus(cls, hdus: fits.HDUList, path: Path) -> FrameFile:
        """Read the header of an open file."""
        product = _why_a_product(hdus)
        if product:
            return cls(path, Exposure(path.name), product, is_product=True)
        try:
            science = hdus["SCI"]
            header = merged_header(hdus[0].header, science.header, path.name)
            shape = tuple(science.shape) if science.is_image else ()
            return cls(path, Exposure.of(header, path.name, shape))
        except DiffrenderError as error:
            return cls(path, Exposure(path.name), _without_name(error, path.name))

    @classmethod
    def opened(
        cls, path: Path, are_wanted: Callable[[Exposure], bool] = lambda exposure: False
    ) -> FrameFile:
        """Open a file once; read its header, and the means of its frames if these are wanted."""
        try:
            with open_fits(path, images=False) as hdus:
                file = cls.in_hdus(hdus, path)
                if file.fault or not are_wanted(file.exposure):
                    return file
                return replace(file, frames=_means(lambda: Observation(**means_in(hdus, path))))
        except DiffrenderError as error:
            return cls(path, Exposure(path.name), _without_name(error, path.name))

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.path.name

    def marked(self, *, reference: bool) -> FrameFile:
        """The file marked as a reference star's or the target's, whatever its header says."""
        return replace(self, exposure=replace(self.exposure, reference=reference))

    @cached_property
    def _judged(self) -> tuple[Observation | None, str]:
        """The frames and what is wrong with them; a file is read and judged once."""
        frames = self.frames
        if frames is None:
            frames = _means(lambda: Observation.means_from_fits(self.path, star=self.place))
        if isinstance(frames, DiffrenderError):
            return None, _without_name(frames, self.name)
        remark = not_judged(frames)
        if remark:
            frames = replace(frames, remarks=(*frames.remarks, remark))
        return frames, (
            why_few_pixels(frames)
            or why_odd_noise(frames.noise_ratios)
            or why_odd_unit(frames)
            # Where the user has stated the star's position, the position is not judged.
            or ("" if self.place is not None else why_no_star(frames))
        )

    @property
    def observation(self) -> Observation | None:
        """Mean of the used integrations of each pointing; None if no integration is used."""
        return self._judged[0]

    @property
    def fault_of_pixels(self) -> str:
        """Why the pixels cannot show a star behind the mask; empty if they can."""
        return self._judged[1]


def _means(read: Callable[[], Observation]) -> Observation | DiffrenderError:
    try:
        return read()
    except DiffrenderError as error:
        return error


def _without_name(error: Exception, name: str) -> str:
    return str(error).removeprefix(f"{name}: ")


def _why_a_product(hdus: fits.HDUList) -> str:
    """Why a file holds no frames but something made from them; empty for frames.

    Only the contents count: products keep cards of the frames, and may have any name.
    """
    first = hdus[0].header
    product, what = product_in(hdus), ""
    if product:
        what = f"{product}, a product of pyklip_diffrender"
    elif "SCI" not in hdus and any(_is_map(hdu) for hdu in hdus):
        return _MAP
    elif any(key in hdu.header for hdu in hdus[:2] for key in ("PYKLIPV", "PSFSUB")):
        what = "an image from which pyKLIP has subtracted the star"
    elif "SCI" not in hdus:
        names = ", ".join(hdu.name or "unnamed" for hdu in hdus)
        what = f"a file without an SCI extension ({names})"
        if any(key in first for key in ("OPD", "PUPILOPD", "PUPLSCAL", "WFSGUID", "TSTAMP")):
            what = f"an image of a model ({names}), without an SCI extension"
    return f"it is {what}; expected frames of stage 2 (calints)" if what else ""


def _is_map(hdu: Any) -> bool:
    """Whether an HDU has a map of path differences, as wavefront sensing writes them."""
    if hdu.name == EXTENSION:
        return True
    return hdu.is_image and length_unit(str(hdu.header.get("BUNIT", ""))) is not None
