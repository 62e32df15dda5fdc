"""Convert parts of results to FITS extensions and JSON text, and back."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from astropy import units as u
from astropy.io import fits
from astropy.time import Time
from numpy.typing import NDArray
from torch import Tensor

from pyklip_diffrender.errors import CorruptFileError, DiffrenderError, IncompatibleSetupError
from pyklip_diffrender.instrument.nircam import nircam_coronagraph
from pyklip_diffrender.io.files import open_fits
from pyklip_diffrender.io.headers import fits_unit
from pyklip_diffrender.io.units import native_float64
from pyklip_diffrender.linear.model import LinearFrame, LinearModel, Unknown
from pyklip_diffrender.optics.system import OpticalSystem
from pyklip_diffrender.refinement.settings import FitSettings
from pyklip_diffrender.scene.objects import Planet
from pyklip_diffrender.scene.observation import Observation
from pyklip_diffrender.wavefront.bases import FourierModes, JointBasis, SegmentMotions
from pyklip_diffrender.wavefront.priors import WavefrontPrior

_DATACLASSES = {each.__name__: each for each in (FitSettings, WavefrontPrior, Planet)}
_DTYPES = {"torch.float64": torch.float64, "torch.float32": torch.float32}


def encoded(value: Any) -> Any:
    """Convert settings to JSON types.

    Raises `IncompatibleSetupError` for an object of unknown type, such as a user-defined basis.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": str(value)}
    if isinstance(value, Mapping):
        return {"mapping": {str(key): encoded(each) for key, each in value.items()}}
    if isinstance(value, tuple | list):
        return [encoded(each) for each in value]
    if isinstance(value, u.Quantity):  # Itself an array.
        return {"quantity": encoded(value.value), "unit": value.unit.to_string()}
    if isinstance(value, np.ndarray | torch.Tensor):
        return encoded(native_float64(value).tolist())
    if isinstance(value, np.generic):
        return encoded(value.item())
    if isinstance(value, torch.dtype):
        return {"dtype": str(value)}
    if isinstance(value, torch.device):
        return str(value)
    if isinstance(value, JointBasis):
        return {"bases": [encoded(part) for part in value.parts]}
    if isinstance(value, SegmentMotions):
        return {"basis": "SegmentMotions", "arguments": []}
    if isinstance(value, FourierModes):
        return {"basis": "FourierModes", "arguments": [value.max_cycles, value.min_cycles]}
    if is_dataclass(value) and type(value).__name__ in _DATACLASSES:
        content = {each.name: encoded(getattr(value, each.name)) for each in fields(value)}
        return {"class": type(value).__name__, "fields": content}
    raise IncompatibleSetupError(
        f"a {type(value).__name__} cannot be written to a file; fits with the package's own bases "
        "and settings can"
    )


def decoded(value: Any) -> Any:
    """The inverse of `encoded`; sequences come back as tuples."""
    if isinstance(value, list):
        return tuple(decoded(each) for each in value)
    if not isinstance(value, dict):
        return value
    if "float" in value:
        return float(value["float"])
    if "mapping" in value:
        return {key: decoded(each) for key, each in value["mapping"].items()}
    if "quantity" in value:
        return decoded(value["quantity"]) * u.Unit(value["unit"])
    if "dtype" in value:
        return _DTYPES[value["dtype"]]
    if "bases" in value:
        return JointBasis([decoded(part) for part in value["bases"]])
    if "basis" in value:
        kinds = {"SegmentMotions": SegmentMotions, "FourierModes": FourierModes}
        return kinds[value["basis"]](*value["arguments"])
    content = {key: decoded(each) for key, each in value["fields"].items()}
    return _DATACLASSES[value["class"]](**content)


def text_hdu(name: str, content: Mapping[str, Any]) -> fits.ImageHDU:
    """Extension with JSON text as bytes."""
    text = json.dumps({key: encoded(value) for key, value in content.items()})
    return fits.ImageHDU(np.frombuffer(text.encode(), dtype=np.uint8), name=name)


def text_of(hdus: fits.HDUList, name: str) -> dict[str, Any]:
    """Return the content of an extension that `text_hdu` made."""
    text = np.asarray(hdus[name].data, dtype=np.uint8).tobytes().decode()
    return {key: decoded(value) for key, value in json.loads(text).items()}


@contextmanager
def reading(
    path: str | os.PathLike[str], kind: str
) -> Iterator[tuple[fits.HDUList, dict[str, Any]]]:
    """Open a result of the class `kind`, with the content of its FACTS extension.

    Raises `CorruptFileError` if the file is missing or truncated, was not written by that class, or
    if a part that is read inside the block is missing or malformed.
    """
    name = Path(path).name
    with open_fits(path) as hdus:
        if "FACTS" not in hdus:
            raise CorruptFileError(
                f"{name}: no FACTS extension, only {[h.name for h in hdus]}; expected a file "
                f"written by {kind}.write"
            )
        try:
            yield hdus, text_of(hdus, "FACTS")
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            if isinstance(error, DiffrenderError):
                raise
            raise CorruptFileError(
                f"{name}: not a complete {kind} ({error}). Write it again"
            ) from error


def model_facts(model: OpticalSystem) -> dict[str, Any] | None:
    """Arguments of `nircam_coronagraph` that make the model; None for other models."""
    return dict(model.recipe) if model.maker is nircam_coronagraph else None


def model_of(facts: dict[str, Any] | None, name: str) -> OpticalSystem:
    """Make a model from `model_facts`, on the CPU; `IncompatibleSetupError` if there are none."""
    if facts is None:
        raise IncompatibleSetupError(
            f"{name}: the model of this fit was not made by nircam_coronagraph, so it "
            "cannot be made from the file. Pass the model: Refinement.read(path, model=model)"
        )
    # This machine may not have the device of the fit.
    return nircam_coronagraph(**{**facts, "device": "cpu"})


def image(hdus: fits.HDUList, name: str, frame: int) -> NDArray[np.float64]:
    """Data of a frame's extension as native float64."""
    return native_float64(hdus[name, frame + 1].data)


def observation_hdus(observation: Observation, frame: int) -> tuple[dict[str, Any], list[Any]]:
    """Return metadata and extensions of an observation, with its frames averaged."""
    # An average of one frame rounds differently.
    combined = observation if len(observation) == 1 else observation.combined()
    facts = {
        "unit": combined.unit.to_string(),
        "pixelscale": combined.pixelscale,
        "center": combined.center,
        "filter": combined.filter,
        "date": None if combined.date is None else combined.date.isot,
        "mid_date": None if combined.mid_date is None else combined.mid_date.isot,
        "position_angles": combined.position_angles,
        "name": combined.name,
        "reference": combined.reference,
        "star_offset": combined.star_offset,
        "first_pixel": combined.first_pixel,
        "integrations": combined.integrations,
        "header": combined.header.tostring(sep="\n"),
    }
    arrays = {
        "DATA": combined.data[0],
        "ERROR": combined.error[0],
        "VALID": combined.valid[0].astype(np.uint8),
    }
    hdus = [fits.ImageHDU(a, name=name, ver=frame + 1) for name, a in arrays.items()]
    for hdu in hdus[:2]:
        hdu.header["BUNIT"] = fits_unit(combined.unit)
    return facts, hdus


def observation_of(hdus: fits.HDUList, facts: dict[str, Any], frame: int) -> Observation:
    """Make an observation from the metadata and extensions of `observation_hdus`."""
    angles, date, middle = facts["position_angles"], facts["date"], facts["mid_date"]
    offset, first_pixel = facts["star_offset"], facts["first_pixel"]
    return Observation.from_arrays(
        image(hdus, "DATA", frame),
        image(hdus, "ERROR", frame),
        valid=image(hdus, "VALID", frame) > 0,
        unit=facts["unit"],
        pixelscale=facts["pixelscale"],
        center=np.array(facts["center"]),
        filter=facts["filter"],
        date=None if date is None else Time(date),
        mid_date=None if middle is None else Time(middle),
        position_angles=None if angles is None else np.array(angles),
        name=facts["name"],
        reference=facts["reference"],
        star_offset=None if offset is None else tuple(offset),
        first_pixel=None if first_pixel is None else tuple(first_pixel),
        # Files of earlier versions do not say it.
        integrations=tuple(facts.get("integrations", ())),
        header=fits.Header.fromstring(facts["header"], sep="\n"),
    )


_FRAME_ARRAYS = ("residual", "weight", "jacobian", "rows", "drift", "common")


def linear_hdus(linear: LinearModel) -> list[Any]:
    """Return the extensions of a linear model."""
    columns = [
        fits.Column("NAME", "20A", array=np.array([each.name for each in linear.unknowns])),
        fits.Column("COMPONENT", "J", array=[each.component for each in linear.unknowns]),
        fits.Column("FRAME", "J", array=[each.frame for each in linear.unknowns]),
        fits.Column("VECTOR", "D", array=linear.vector.numpy()),
        fits.Column("MEAN", "D", array=linear.mean.numpy()),
        fits.Column("DEVIATION", "D", array=linear.deviation.numpy()),
    ]
    hdus = [
        fits.BinTableHDU.from_columns(columns, name="UNKNOWNS"),
        fits.ImageHDU(linear.curvature.numpy(), name="CURVATURE"),
    ]
    for k, frame in enumerate(linear.frames):
        for name in _FRAME_ARRAYS:
            array = getattr(frame, name).numpy()
            # FITS has no empty images.
            hdu = fits.ImageHDU(array if array.size else None, name=f"LINEAR_{name}", ver=k + 1)
            hdu.header["FIRSTMOD"] = (frame.first_mode, "row of the first wavefront mode")
            hdus.append(hdu)
    return hdus


def linear_of(hdus: fits.HDUList, frames: int, name: str) -> LinearModel:
    """Make a linear model from the extensions of `linear_hdus`.

    Raises `CorruptFileError` if its parts are inconsistent.
    """
    table = hdus["UNKNOWNS"].data
    unknowns = tuple(
        Unknown(str(label).strip(), int(component), int(frame))
        for label, component, frame in zip(
            table["NAME"], table["COMPONENT"], table["FRAME"], strict=True
        )
    )
    parts = []
    for k in range(frames):
        arrays: dict[str, Tensor] = {}
        for key in _FRAME_ARRAYS:
            data = hdus[f"LINEAR_{key}", k + 1].data
            kind = {"jacobian": np.float32, "rows": np.int64, "drift": np.int64}.get(
                key, np.float64
            )
            array = np.zeros(0, kind) if data is None else np.array(data, dtype=kind)
            arrays[key] = torch.from_numpy(array)
        first = int(hdus["LINEAR_RESIDUAL", k + 1].header["FIRSTMOD"])
        parts.append(LinearFrame(**arrays, first_mode=first))
    vector, mean, deviation = (
        torch.from_numpy(native_float64(table[key])) for key in ("VECTOR", "MEAN", "DEVIATION")
    )
    curvature = torch.from_numpy(native_float64(hdus["CURVATURE"].data))
    return LinearModel(unknowns, tuple(parts), vector, mean, deviation, curvature)
