"""The command `pyklip-diffrender survey`."""

from __future__ import annotations

from pathlib import Path

import click

from pyklip_diffrender.surveys.driver import survey

__all__ = ["run"]


def run(config: Path, output: Path, scheduler: str | None = None, *, progress: bool = False) -> int:
    """Run a survey and say what it has shown.

    Returns
    -------
    int
        Exit status: 0 if all jobs are finished, 1 if some failed, 130 if interrupted.
    """
    try:
        table = survey(config, output, scheduler, progress=progress)
    except KeyboardInterrupt:
        click.echo(
            "pyklip-diffrender: interrupted; finished jobs are kept, and the same command goes on",
            err=True,
        )
        return 130
    failed = table[table["status"] == "failed"]
    counts = {status: int((table["status"] == status).sum()) for status in ("finished", "failed")}
    click.echo(f"{counts['finished']} of {len(table)} jobs finished, {counts['failed']} failed")
    # The candidates of a job with an injected planet include that planet.
    real = (table["status"] == "finished") & table["injected_contrast"].mask
    for row in table[real & ~table["snr"].mask]:
        click.echo(
            f"  {row['name']}: S/N {row['snr']:.1f} at {row['separation_arcsec']:.3f} arcsec, "
            f"contrast {row['contrast']:.2e} +- {row['contrast_error']:.1e}"
        )
    for row in failed:
        click.echo(f"  {row['name']} failed: {row['message']}")
    for name in ("results.ecsv", "results.parquet", "survey.html"):
        if (output / name).exists():
            click.echo(f"wrote {output / name}")
    return 1 if len(failed) else 0
