"""The verb `upsample`: a sparse scan made dense."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import (
    Device,
    Intensity,
    Method,
    Output,
    Picture,
    Positional,
    Resamples,
    Seed,
    SensorOut,
    SensorWord,
    Source,
    Steps,
    arg,
)
from lidarsynth.cli.scan_files import read_scan, write_filled
from lidarsynth.cli.terminal import at_least, load_with_bar, say, step_bar


def upsample(
    scan: Annotated[Positional[Path], arg(help="file of the sparse scan.")],
    out: Output,
    sensor_in: Annotated[SensorWord, arg(name="from")] = None,
    sensor_out: SensorOut = None,
    model: Source = "default",
    method: Method = "auto",
    steps: Steps = None,
    resamples: Resamples = None,
    seed: Seed = 0,
    device: Device = "cpu",
    intensity: Intensity = "auto",
    picture: Picture = True,
) -> None:
    """Make a scan of a sensor with few beams dense: every measured point stays, bit by bit, and new ones are added."""
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.completion import named_sensor, upsample_scan
    from lidarsynth.verbs.output_files import target

    at_least(1, {"steps": steps, "resamples": resamples})
    at_least(0, {"seed": seed})
    target(out, scan)
    sparse = read_scan(scan, intensity)
    sensor = named_sensor(sparse, scan, "--from", sensor_in)
    loaded = load_with_bar(model, device)
    loaded = loaded.into(sensor_out) if sensor_out else loaded
    how = Filling(method, steps, resamples, seed=seed)
    with step_bar(scan.name, loaded.calls(loaded.resolved(how))) as on_step:
        filled = upsample_scan(loaded, sparse, sensor, how, on_step)
    say(f"{scan}: {len(sparse)} points of {sensor.name} became {len(filled.points)}")
    write_filled(out, filled, picture)
