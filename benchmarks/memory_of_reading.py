"""Peak memory of reading a calints file of many integrations, over the size of the file.

    python -m benchmarks.memory_of_reading --size 1

The file is simulated, in a temporary folder, with as many integrations of 320 x 320 pixels as make
that many GB. It is read as `reduce` does, and with ``--dataset`` as pyKLIP does, in a process of
its own; the memory of the imports is left out.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.io import fits

from benchmarks.calints_files import calints, starlight

SIDE = 320


def write(path: Path, size: float) -> int:
    """Write a file of about `size` GB, plane by plane; returns the number of integrations."""
    count = max(1, round(size * 1e9 / (12 * SIDE**2)))
    rng = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        one = calints(Path(folder) / "one.fits", light=starlight(side=SIDE))
        with fits.open(one) as hdus:
            hdus[0].header["EXTEND"] = True
            hdus["SCI"].header["CRVAL1"], hdus["SCI"].header["CRVAL2"] = 100.0, 20.0
            path.write_bytes(b"")
            with path.open("ab") as file:
                for hdu in hdus:
                    if hdu.data is None:
                        file.write(hdu.header.tostring().encode())
                        continue
                    hdu.header["NAXIS3"] = count
                    file.write(hdu.header.tostring().encode())
                    mean, sigma = starlight(side=SIDE), hdus["ERR"].data[0]
                    for _ in range(count):
                        plane = hdu.data[0]
                        if hdu.name == "SCI":
                            plane = mean + sigma * rng.normal(size=mean.shape)
                        file.write(plane.astype(hdu.data.dtype.newbyteorder(">")).tobytes())
                    file.write(b"\0" * (-file.tell() % 2880))
    return count


def peak() -> float:
    """Largest memory of this process so far, bytes; the system counts in kB, macOS in bytes."""
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest * (1.0 if sys.platform == "darwin" else 1024.0)


def measure(path: Path, dataset: bool) -> tuple[float, float]:
    """Bytes that reading takes at most, and processor time, s."""
    warnings.simplefilter("ignore")
    import pyklip_diffrender as dr

    with tempfile.TemporaryDirectory() as folder:
        # What is imported and cached with the first file is not of the second.
        warm = Path(folder) / "warm.fits"
        write(warm, 0.0)
        if dataset:
            from pyklip.instruments.JWST import JWSTData

            dr.register(opd="flat")
            JWSTData([str(warm)])
        dr.ExposureSequence.from_files(warm)
        before, began = peak(), time.process_time()
        if dataset:
            JWSTData([str(path)])
        else:
            dr.ExposureSequence.from_files(path)
        return peak() - before, time.process_time() - began


def main() -> None:
    """Write the file, read it, and print the ratio."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=float, default=1.0, help="GB")
    parser.add_argument("--dataset", action="store_true", help="read it with pyKLIP's JWSTData")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "many_calints.fits"
        count = write(path, options.size)
        size = path.stat().st_size
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            taken, seconds = pool.apply(measure, (path, options.dataset))
    print(
        f"{count} integrations, {size / 1e9:.2f} GB: {taken / 1e9:.2f} GB of memory, "
        f"{taken / size:.2f} times the file, {seconds:.0f} s of processor time"
    )


if __name__ == "__main__":
    main()
