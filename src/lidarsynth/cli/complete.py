"""The verb `complete`: fill what scans lack."""

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
    Picture,
    Positional,
    Precision,
    Recipe,
    Resamples,
    Seed,
    SensorWord,
    Steps,
    arg,
)
from lidarsynth.cli.many import PICTURES, Many, work_through
from lidarsynth.cli.terminal import at_least, say


def complete(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures.")],
    out: Annotated[Path, arg(help="file to write, as in upsample; a folder where there are several scans; or a bag.")],
    corrupt: Recipe = None,
    model: Filler = "default",
    method: Method = "auto",
    steps: Steps = None,
    resamples: Resamples = None,
    min_confidence: Least = None,
    seed: Seed = 0,
    device: Device = "cpu",
    precision: Precision = "fp32",
    intensity: Intensity = "auto",
    sensor: SensorWord = None,
    labels: Labels = False,
    picture: Picture = True,
    without: Annotated[
        str | None,
        arg(metavar="CLASSES", help="take these away, such as car,person or traffic, and fill what they hid, no more."),
    ] = None,
    many: Annotated[Many, arg(name="")] = Many(),  # noqa: B008, frozen
) -> None:
    """Fill what a scan lacks: every measured point stays, bit by bit, and new ones are added.

    With --corrupt a part of the scan is hidden first. The file then holds what the rest was filled to, and the errors
    of the hidden pixels are printed beside those of interpolation. With --without what was measured of these classes,
    as the file's labels or the network name them, is gone instead, and what stands behind is filled in.
    """
    from lidarsynth.lidar.corruption import check_recipe
    from lidarsynth.lidar.removal import removable
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.batch import Job
    from lidarsynth.verbs.description import errors_table, mean_table

    at_least(1, {"steps": steps, "resamples": resamples})
    at_least(0, {"seed": seed})
    if corrupt is not None:
        check_recipe(corrupt)
        if without is not None:
            raise ValueError("expected --corrupt or --without, found both")
    removed = None if without is None else removable(without)
    how = Filling(method, steps, resamples, seed=seed, precision=precision, removed=removed)
    job = Job(
        "complete",
        model,
        device,
        how,
        corrupt=corrupt,
        sensor=sensor,
        picture=picture,
        least=min_confidence,
        labels=labels,
    )
    results = [result for result in work_through(job, scans, out, many, intensity) if result.errors]
    if len(results) <= PICTURES:
        for result in results:
            say(errors_table(result.source.name, result.errors))
    if len(results) > 1:
        say(mean_table([result.errors for result in results]))
