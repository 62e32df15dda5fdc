"""Reductions of a spaceKLIP database: `run_obs` in place of spaceKLIP's own, and its files.

spaceKLIP is imported only where one of its functions is needed.
"""

from __future__ import annotations

import logging
import math
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units as u
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from pyklip_diffrender.detection import Detection
from pyklip_diffrender.errors import DiffrenderError, DiffrenderWarning, IncompatibleSetupError
from pyklip_diffrender.instrument.masks import MASKS, mask_of_header
from pyklip_diffrender.io.files import write_fits, write_table
from pyklip_diffrender.io.headers import file_name, fits_text, known_number
from pyklip_diffrender.options import SPECTRA
from pyklip_diffrender.pyklip_backend.backend_settings import DiffrenderSettings
from pyklip_diffrender.pyklip_backend.output_files import on_product
from pyklip_diffrender.pyklip_backend.registration import reduce_jwst_files
from pyklip_diffrender.reduction.several import by_star, in_words, search_together
from pyklip_diffrender.refinement import to_jansky
from pyklip_diffrender.scene.frame_file import FrameFile
from pyklip_diffrender.scene.sequence import ExposureSequence

_log = logging.getLogger(__name__)

# Candidates in the form of spaceKLIP's table of sources.


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

    def with_error(theirs: str, ours: str) -> dict[str, NDArray[Any]]:
        return {theirs: column(ours), f"{theirs}_ERR": column(f"{ours}_error")}

    columns: dict[str, NDArray[Any]] = {
        "ID": np.arange(1, count + 1),
        **with_error("RA", "delta_ra"),
        **with_error("DEC", "delta_dec"),
        **with_error("FLUX_JY", "flux_density"),
        **dict.fromkeys(("FLUX_SI", "FLUX_SI_ERR", "FLUX_SI_ALT", "FLUX_SI_ALT_ERR"), unknown),
        **with_error("CON", "contrast"),
        **with_error("DELMAG", "delta_mag"),
        **dict.fromkeys(("APPMAG", "APPMAG_ERR", "MSTAR", "MSTAR_ERR"), unknown),
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


def run_obs(
    database: Any,
    *,
    opd: Any,
    restrict_to: str | None = None,
    subdir: str = "diffrender",
    save_rolls: bool = False,
    star_flux: Mapping[str, float | str | u.Quantity] | None = None,
    spectra: Sequence[str] = SPECTRA,
    verbose: bool = False,
    **settings: Any,
) -> dict[str, Detection]:
    """Subtract the star from every concatenation of a spaceKLIP database, and search for planets.

    All rolls of a concatenation are fitted together. References (TYPE is REF) are used as
    `reduce` uses frames of reference stars, see its option `references`; none are needed. The
    products are added to ``database.red`` and the candidates to ``database.src``.
    Every file is judged before the first fit as `pyklip_diffrender.ExposureSequence.from_files`
    judges it.

    Files of each concatenation have the prefix ``<mode>_NANNU1_NSUBS1_<concatenation>``:

    - ``-KLmodes-all.fits``: the subtracted image, north up, with spaceKLIP's and pyKLIP's keywords;
    - ``-throughput.fits``, ``-snr.fits``: throughput, and S/N of a point source;
    - ``-results.ecsv``: candidates, in the columns of ``extract_companions``;
    - ``-KLmodes-all_cal_seps.npy``, ``_cal_cons.npy``, ``_cal_maskcons.npy``: 5-sigma contrast
      curve with the small-sample correction, as ``calibrate_contrast`` saves it;
    - ``-frames.ecsv``: every file, its use and the reason;
    - a folder with the files of `pyklip_diffrender.Detection.write`, and ``fit.fits``.

    ``<concatenation>.dat`` is its table, and ``<concatenation>_psfmask.fits`` the transmission of
    the mask, if the table names the rolls' mask files.

    Concatenations of one target, of several filters or epochs, are then searched together as
    `pyklip_diffrender.combine` does, and the folder ``combined_<target>`` has the files of
    `pyklip_diffrender.Combination.write`.

    Parameters
    ----------
    database : spaceKLIP.database.Database
        With stage-2 frames (calints) of a NIRCam coronagraph in which the star is at
        STARCENX, STARCENY: aligned ones, usually. Other concatenations are skipped.
    opd : path, OPDMap, Quantity or array
        The wavefront to start from; see `DiffrenderSettings`. Of a folder of maps, the one nearest
        in time is taken; "flat" stands for a flat wavefront.
    restrict_to : str, optional
        Only concatenations whose name contains this.
    subdir : str
        Folder of the products in ``database.output_dir``.
    save_rolls : bool
        Also write the subtracted image of each file, with `_roll1` and so on after its name.
    star_flux : mapping of str to float, str or Quantity, optional
        Flux density of the star by filter, such as ``{"F444W": "0.45 Jy"}``, to which contrasts
        then refer; see `pyklip_diffrender.reduce`. Without it, or in other filters, the diffracted
        light determines it. The subtracted images hardly change.
    spectra : sequence of str
        Spectra of planets for the search over concatenations; see `pyklip_diffrender.combine`.
    verbose : bool
        Print what is being done.
    **settings
        Other fields of `DiffrenderSettings`, such as `pattern`, `threshold` and
        `star_flux_error`.

    Returns
    -------
    dict of str to Detection
        By concatenation.

    Raises
    ------
    IncompatibleSetupError
        For a `star_flux` that is no flux density, or of a filter that the database does not have,
        and for values that `DiffrenderSettings` refuses.
    TypeError
        For a name that is no field of it.
    ExceptionGroup
        After all concatenations, if some failed: their errors, each with a note that names the
        concatenation. The log has the tracebacks, and the others are complete.

    Warns
    -----
    DiffrenderWarning
        For every concatenation that is skipped or left out of the search of a target, for every
        target whose concatenations cannot be searched together, and for every file that is left
        out, with the reason.

    Examples
    --------
    With a `database` that spaceKLIP has made, and a folder of OPD maps:

    >>> from pyklip_diffrender import spaceklip
    >>> spaceklip.run_obs(database, opd="maps")  # doctest: +SKIP
    """
    fluxes = _fluxes(star_flux or {}, database)
    # What is wrong in them is said before the first file is read.
    common = {"opd": opd, **settings}
    DiffrenderSettings(**common)
    folder = Path(database.output_dir) / subdir
    folder.mkdir(parents=True, exist_ok=True)
    products: dict[str, Path] = {}
    detections: dict[str, Detection] = {}
    failures: list[Exception] = []
    admitted: dict[str, tuple[Table, ExposureSequence]] = {}
    for key, table in database.obs.items():
        if restrict_to is not None and restrict_to not in key:
            continue
        reason = why_unsupported(table)
        if reason:
            warnings.warn(f"{key} is skipped: {reason}", DiffrenderWarning, stacklevel=2)
            continue
        try:
            admitted[key] = _admitted(key, table)
        except DiffrenderError as error:
            error.add_note(f"concatenation {key}")
            failures.append(error)
    for key, (table, sequence) in admitted.items():
        _log.info("concatenation %s", key)
        try:
            products[key], detections[key] = _reduced(
                key,
                table,
                sequence,
                folder,
                save_rolls,
                {**common, "verbose": verbose, "star_flux": fluxes.get(_filter(table))},
            )
        except Exception as error:  # Reported after the other concatenations.
            _log.exception("concatenation %s failed", key)
            error.add_note(f"concatenation {key}")
            failures.append(error)
    if detections:
        database.read_jwst_s3_data([str(products[key]) for key in detections])
        for key, detection in detections.items():
            _store(database, products[key], source_table(detection, products[key]))
        _search_together(detections, folder, spectra)
    if failures:
        tried = len(failures) + len(detections)
        raise ExceptionGroup(f"{len(failures)} of {tried} concatenations failed", failures)
    return detections


def _search_together(
    detections: Mapping[str, Detection], folder: Path, spectra: Sequence[str]
) -> None:
    """Search the concatenations of every target that has several, and write what is found.

    Warns
    -----
    DiffrenderWarning
        For what is not searched.
    """
    if len(detections) < 2:
        return
    for target, group in by_star(detections).items():
        if len(group) < 2:
            continue
        found = search_together(list(group.values()), spectra=spectra)
        if isinstance(found, str):
            warnings.warn(
                f"{target} has no combined search: {found}", DiffrenderWarning, stacklevel=3
            )
            continue
        found.write(folder / f"combined_{file_name(target)}", overwrite=True)
        _log.info("%s: %s", target, in_words(found))
        for name, reason in found.left_out:
            warnings.warn(
                f"{target}: {name} is left out of the combined search: {reason}",
                DiffrenderWarning, stacklevel=3,
            )  # fmt: skip


def _filter(table: Table) -> str:
    return str(table["FILTER"][0])


def _fluxes(star_flux: Mapping[str, float | str | u.Quantity], database: Any) -> dict[str, float]:
    """Flux densities by filter, Jy."""
    filters = {_filter(table) for table in database.obs.values()}
    for name in star_flux:
        if name not in filters:
            raise IncompatibleSetupError(
                f"star_flux: got {name!r}, expected filters of the database: {sorted(filters)}"
            )
    return {name: to_jansky(value) for name, value in star_flux.items()}


def why_unsupported(table: Table) -> str | None:
    """Why a concatenation cannot be reduced; None if it can."""
    if "SCI" not in table["TYPE"]:
        return "it has no frames of a target (TYPE is SCI)"
    first = table[list(table["TYPE"]).index("SCI")]
    mask = mask_of_header(first["CORONMSK"])
    if first["INSTRUME"] != "NIRCAM" or first["EXP_TYPE"] != "NRC_CORON" or mask not in MASKS:
        return (
            f"{first['INSTRUME']} {first['EXP_TYPE']} with mask {first['CORONMSK']}; only NIRCam's "
            f"coronagraph is modelled ({', '.join(MASKS)})"
        )
    if first["DATAMODL"] != "STAGE2":
        return f"its frames are {first['DATAMODL']}; only STAGE2 (calints) can be used"
    return None


def _admitted(key: str, table: Table) -> tuple[Table, ExposureSequence]:
    """Rows of a concatenation whose files are used, and what all files were sorted into.

    Raises as `ExposureSequence.from_files`, and warns of every file that is left out.
    """
    paths = [Path(str(path)).absolute() for path in table["FITSFILE"]]
    listed: dict[bool, list[FrameFile]] = {True: [], False: []}
    for path, kind in zip(paths, table["TYPE"], strict=True):
        listed[str(kind) == "SCI"].append(FrameFile.opened(path, lambda exposure: True))
    sequence = ExposureSequence.of_opened(listed[True], listed[False])
    for name, reason in sequence.excluded:
        warnings.warn(f"{key}: {name} is left out: {reason}", DiffrenderWarning, stacklevel=3)
    used = {row.path for row in sequence.rows if row.use != "excluded"}
    chosen = np.array([path in used for path in paths])
    return table[chosen], sequence


def _reduced(
    key: str,
    table: Table,
    sequence: ExposureSequence,
    folder: Path,
    save_rolls: bool,
    settings: dict[str, Any],
) -> tuple[Path, Detection]:
    """Reduce one concatenation and write its files; the path of the product."""
    kinds = np.array(table["TYPE"], dtype=str)
    files = np.array(table["FITSFILE"], dtype=object)
    mode = "ADI+RDI" if (kinds == "REF").any() else "ADI"
    prefix = f"{mode}_NANNU1_NSUBS1_{key}"
    dataset = reduce_jwst_files(
        files[kinds == "SCI"], files[kinds == "REF"], folder=folder, prefix=prefix, **settings
    )
    # A concatenation has one filter, so one wavelength.
    (record,) = dataset.diffrender_results
    detection = record.subtraction.reduction.detection
    product = folder / f"{prefix}-KLmodes-all.fits"
    complete_header(product, table, mode)
    if save_rolls:
        write_rolls(product, dataset, files[kinds == "SCI"])
    write_snr(folder / f"{prefix}-snr.fits", detection, product)
    write_contrast(product, detection)
    detection.write(folder / prefix, overwrite=True)
    detection.fit.write(folder / prefix / "fit.fits", overwrite=True)
    write_table(source_table(detection, product), folder / f"{prefix}-results.ecsv")
    write_table(sequence.table, folder / f"{prefix}-frames.ecsv")
    write_database(folder / f"{key}.dat", table)
    write_mask(folder / f"{key}_psfmask.fits", table)
    return product, detection


def _store(database: Any, product: Path, sources: Table) -> None:
    """Add sources to the database, at the place of the product that they are in."""
    for key, table in database.red.items():
        paths = [os.fspath(path) for path in table["FITSFILE"]]
        if str(product) in paths:
            # The last one: the database may list a product that was made before, too.
            database.update_src(key, len(paths) - 1 - paths[::-1].index(str(product)), sources)
