"""Files and tables of a reduction where spaceKLIP looks for them, and in its form."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.detection import Detection
from pyklip_diffrender.io.files import write_fits
from pyklip_diffrender.io.headers import fits_text, known_number
from pyklip_diffrender.pyklip_backend.output_files import on_product

# Candidates in the form of spaceKLIP's table of sources.

_OTHER_FLUXES = ("FLUX_SI", "FLUX_SI_ERR", "FLUX_SI_ALT", "FLUX_SI_ALT_ERR")
_MAGNITUDES = ("APPMAG", "APPMAG_ERR", "MSTAR", "MSTAR_ERR")


def source_table(detection: Detection, product: Path) -> Table:
    """Table of the sources in the file `product`, highest S/N first, as of `extract_companions`.

    Offsets are in arcsec, contrasts to the star. What depends on the star's magnitude is NaN, and
    so are the throughputs, which the contrasts include.
    """
    table = detection.candidates
    count = len(table)
    unknown = np.full(count, np.nan)

    def column(name: str) -> NDArray[Any]:
        """Values of a column, NaN where the frames do not allow it."""
        values = table[name] if name in table.colnames else unknown
        return np.asarray(getattr(values, "value", values))

    columns: dict[str, NDArray[Any]] = {
        "ID": np.arange(1, count + 1),
        "RA": column("delta_ra"),
        "RA_ERR": column("delta_ra_error"),
        "DEC": column("delta_dec"),
        "DEC_ERR": column("delta_dec_error"),
        "FLUX_JY": column("flux_density"),
        "FLUX_JY_ERR": column("flux_density_error"),
        **dict.fromkeys(_OTHER_FLUXES, unknown),
        "CON": column("contrast"),
        "CON_ERR": column("contrast_error"),
        "DELMAG": column("delta_mag"),
        "DELMAG_ERR": column("delta_mag_error"),
        **dict.fromkeys(_MAGNITUDES, unknown),
        "SNR": column("snr"),
        "LN(Z/Z0)": unknown,
        "TP_CORONMSK": unknown,
        "TP_COMSUBST": unknown,
        "FITSFILE": np.full(count, str(product)),
    }
    return Table(columns)


# Files of a reduction where spaceKLIP looks for them, and in its form.

_HEADER_COLUMNS = (
    "TELESCOP", "TARGPROP", "TARG_RA", "TARG_DEC", "INSTRUME", "DETECTOR", "FILTER", "CWAVEL",
    "DWAVEL", "PUPIL", "CORONMSK", "EXP_TYPE", "EFFINTTM", "SUBARRAY", "APERNAME", "PPS_APER",
    "PIXSCALE", "PIXAR_SR", "BUNIT", "BLURFWHM",
)  # fmt: skip
"""Columns of the database that spaceKLIP reads from the header of a product."""


def _values(table: Table, name: str) -> list[str | float | None]:
    """Values of a column as headers can hold them: text, finite numbers, or None."""
    # spaceKLIP copies cards into its columns as they are: masked, None, or text for a number.
    cells = table[name] if name in table.colnames else [None] * len(table)
    values: list[str | float | None] = []
    for each in cells:
        cell = each.item() if isinstance(each, np.generic) else each
        if isinstance(cell, str):
            values.append(fits_text(cell))
        else:
            is_number = isinstance(cell, int | float) and math.isfinite(cell)
            values.append(cell if is_number else None)
    return values


def complete_header(product: Path, table: Table, mode: str) -> None:
    """Add the keywords of spaceKLIP's products, and a WCS, to the header of a product.

    Its pixels are turned to north. `table` is the concatenation; `mode` is such as "ADI+RDI".
    """
    science = table[np.array(table["TYPE"], dtype=str) == "SCI"]
    frame = fits.getheader(science["FITSFILE"][0], "SCI")
    place = [known_number(frame, key) for key in ("CRVAL1", "CRVAL2", "PIXAR_A2")]
    with fits.open(product, mode="update", memmap=False) as hdus:
        header = hdus[0].header
        for name in _HEADER_COLUMNS:
            value = _values(science, name)[0]
            # FITS has no NaN in headers; spaceKLIP takes a missing keyword for one.
            if value is not None:
                header[name] = value
        starts, counts = (
            [each for each in _values(science, name) if isinstance(each, int | float)]
            for name in ("EXPSTART", "NINTS")
        )
        if starts:
            header["EXPSTART"] = float(min(starts))
        header["NINTS"] = int(sum(counts))
        header["MODE"], header["ANNULI"], header["SUBSECTS"] = mode, 1, 1
        if None in place:
            return
        *pointing, area = (float(each or 0.0) for each in place)
        degrees = area**0.5 / 3600
        header["WCSAXES"] = 2
        for axis, (name, sign) in enumerate((("RA---TAN", -1), ("DEC--TAN", 1)), 1):
            header[f"CTYPE{axis}"], header[f"CUNIT{axis}"] = name, "deg"
            header[f"CRPIX{axis}"] = header["PSFCENTX" if axis == 1 else "PSFCENTY"] + 1
            header[f"CRVAL{axis}"] = pointing[axis - 1]
            for other in (1, 2):
                header[f"CD{axis}_{other}"] = sign * degrees if other == axis else 0.0


def write_rolls(product: Path, dataset: Any, files: Iterable[str | os.PathLike[str]]) -> None:
    """Write the median of the subtracted frames of every file beside the product of all.

    The header is the product's. All frames of one of the `files`, of the target, have the
    same roll.
    """
    header = fits.getheader(product)
    names = [Path(str(name)).name for name in dataset.filenames]
    for number, file in enumerate(files, 1):
        own = [k for k, name in enumerate(names) if name.startswith(Path(file).name)]
        header["NINTS"] = len(own)
        with warnings.catch_warnings():
            # Pixels without a value in any frame.
            warnings.filterwarnings("ignore", "All-NaN slice", RuntimeWarning)
            images = np.nanmedian(dataset.output[:, own], axis=(1, 2))
        path = product.with_name(f"{product.stem}_roll{number}.fits")
        write_fits(fits.HDUList([fits.PrimaryHDU(images.astype(np.float32), header)]), path)


def write_snr(path: Path, detection: Detection, product: Path) -> None:
    """Write the S/N map on the pixels of a product, turned to north, with its header."""
    header = fits.getheader(product)
    shape = (header["NAXIS2"], header["NAXIS1"])
    turned = on_product(
        detection.snr,
        detection.observation.center[0],
        shape,
        np.array([header["PSFCENTX"], header["PSFCENTY"]]),
        detection.north,
    )
    header["BUNIT"] = ("", "S/N of a point source")
    write_fits(fits.HDUList([fits.PrimaryHDU(turned.astype(np.float32), header)]), path)


def write_contrast(product: Path, detection: Detection) -> None:
    """Write the 5-sigma contrast curve in the arrays of spaceKLIP's calibrated curves.

    Separations (arcsec) and contrasts are (1, n), as for one number of KL modes. They include the
    throughput of the coronagraph and of the subtraction, and the small-sample correction.
    """
    curve = detection.contrast_curve
    stem = str(product).removesuffix(".fits")
    np.save(f"{stem}_cal_seps.npy", curve["separation"].value[np.newaxis])
    for name in ("cons", "maskcons"):
        np.save(f"{stem}_cal_{name}.npy", np.asarray(curve["small_sample"])[np.newaxis])


def write_database(path: Path, table: Table) -> None:
    """Write the concatenation in the text format from which spaceKLIP reads it."""
    text = table.copy()
    for name in text.colnames:
        if text[name].dtype == object:
            text[name] = [
                str(getattr(value, "tolist", lambda v=value: v)()) for value in text[name]
            ]
    text.write(path, format="ascii", overwrite=True)


def write_mask(path: Path, table: Table) -> None:
    """Write the transmission of the mask, turned to north, if the database has the rolls' masks.

    Raises ImportError if it has, and spaceKLIP, which turns them, is not installed.
    """
    science = table[np.array(table["TYPE"], dtype=str) == "SCI"]
    files = _values(science, "MASKFILE")
    if not all(isinstance(each, str) and each != "NONE" for each in files):
        return
    from spaceKLIP.psf import get_transmission

    with fits.open(science["MASKFILE"][0]) as hdus:
        hdus["SCI"].data = get_transmission(table)
        hdus.writeto(path, output_verify="fix", overwrite=True)
