"""The verb `info`: what a model, a preset, a sensor, a file or a folder is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import NoSeed, Positional, Rings, arg
from lidarsynth.cli.terminal import say


def info(
    what: Annotated[
        Positional[str],
        arg(help="a model, preset, release or sensor; or a file or folder: scans, bag, capture, cache, statistics."),
    ] = "default",
    transform: Annotated[
        str | None,
        arg(metavar="T", help="brings a scan into the sensor's frame: x:y:z:roll:pitch:yaw, or a file of 4 x 4."),
    ] = None,
    axes: Annotated[str, arg(metavar="XYZ", help="where x, y, z of a scan point: CARLA has fru, AirSim frd.")] = "flu",
    mount: Annotated[float | None, arg(metavar="M", help="metres of the sensor above a scan's z = 0.")] = None,
    rings: Rings = None,
    metadata: Annotated[Path | None, arg(metavar="FILE", help="JSON of an Ouster's, CSV of a Hesai's packets.")] = None,
    seed: NoSeed = 0,
) -> None:
    """What a model, a preset, a sensor, a file or a folder is."""
    from lidarsynth.verbs.description import describe
    from lidarsynth.verbs.inputs import Reading
    from lidarsynth.verbs.placement import parse_rings, read_transform

    moved = read_transform(transform, mount, axes)
    say(describe(what, Reading(metadata=metadata, transform=moved, rings=parse_rings(rings))))
