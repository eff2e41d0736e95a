"""The verb `complete`: fill what scans lack."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import (
    Device,
    Intensity,
    Method,
    Picture,
    Positional,
    Recipe,
    Resamples,
    Seed,
    Source,
    Steps,
    arg,
)
from lidarsynth.cli.scan_files import read_scan, write_filled
from lidarsynth.cli.terminal import at_least, load_with_bar, say, step_bar


def complete(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, or one folder of scans.")],
    out: Annotated[Path, arg(help="file to write, as in upsample, or a folder where there are several scans.")],
    corrupt: Recipe = None,
    model: Source = "default",
    method: Method = "auto",
    steps: Steps = None,
    resamples: Resamples = None,
    seed: Seed = 0,
    device: Device = "cpu",
    intensity: Intensity = "auto",
    picture: Picture = True,
) -> None:
    """Fill what a scan lacks: every measured point stays, bit by bit, and new ones are added.

    With --corrupt a part of the scan is hidden first. The file then holds what the rest was filled to, and the errors
    of the hidden pixels are printed beside those of interpolation.
    """
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.completion import complete_scan
    from lidarsynth.verbs.description import errors_table, mean_table
    from lidarsynth.verbs.output_files import targets

    at_least(1, {"steps": steps, "resamples": resamples})
    at_least(0, {"seed": seed})
    how, loaded, tables = Filling(method, steps, resamples, seed=seed), None, []
    for path, target in targets(scans, out):
        scan = read_scan(path, intensity)
        loaded = loaded or load_with_bar(model, device)
        with step_bar(path.name, loaded.calls(loaded.resolved(how))) as on_step:
            filled = complete_scan(loaded, scan, corrupt, how, on_step)
        write_filled(target, filled, picture)
        if filled.errors:
            say(errors_table(path.name, filled.errors))
            tables.append(filled.errors)
    if len(tables) > 1:
        say(mean_table(tables))
