"""The verb `upsample`: a sparse scan made dense."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import (
    Device,
    Filler,
    Intensity,
    Labels,
    Least,
    Method,
    Output,
    Picture,
    Positional,
    Precision,
    Resamples,
    Seed,
    SensorOut,
    SensorWord,
    Steps,
    arg,
)
from lidarsynth.cli.many import Many, work_through
from lidarsynth.cli.terminal import at_least


def upsample(
    scans: Annotated[
        Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures of sparse scans.")
    ],
    out: Output,
    sensor_in: Annotated[SensorWord, arg(name="from")] = None,
    sensor_out: SensorOut = None,
    times: Annotated[
        int | None, arg(metavar="INT", help="as many beams as the scan has, in its own view; default 4 without --to.")
    ] = None,
    model: Filler = "default",
    method: Method = "auto",
    steps: Steps = None,
    resamples: Resamples = None,
    min_confidence: Least = None,
    seed: Seed = 0,
    device: Device = "cpu",
    precision: Precision = "fp32",
    intensity: Intensity = "auto",
    labels: Labels = False,
    picture: Picture = True,
    many: Annotated[Many, arg(name="")] = Many(),  # noqa: B008, frozen
) -> None:
    """Make a scan of a sensor with few beams dense: every measured point stays, bit by bit, and new ones are added."""
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.batch import Job

    at_least(1, {"steps": steps, "resamples": resamples})
    at_least(0, {"seed": seed})
    how = Filling(method, steps, resamples, seed=seed, precision=precision)
    job = Job(
        "upsample",
        model,
        device,
        how,
        sensor=sensor_in,
        into=sensor_out,
        times=times,
        picture=picture,
        least=min_confidence,
        labels=labels,
    )
    work_through(job, scans, out, many, intensity)
