"""The verb `insert`: road users more in recorded scans, with their boxes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import Device, Intensity, Picture, Positional, Seed, SensorWord, Source, arg
from lidarsynth.cli.many import Many, work_through
from lidarsynth.cli.terminal import at_least


def insert(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures.")],
    add: Annotated[
        str,
        arg(metavar="THINGS", help="such as car:2,person@8/-3/90: kind, count, or metres ahead and left, and degrees."),
    ],
    out: Annotated[Path, arg(help="file to write, .ply .pcd .bin .npy .npz; a folder for several scans.")],
    sensor: SensorWord = None,
    model: Source = "default",
    seed: Seed = 0,
    device: Device = "cpu",
    intensity: Intensity = "auto",
    picture: Picture = True,
    many: Annotated[Many, arg(name="")] = Many(),  # noqa: B008, frozen
) -> None:
    """Cars, people, cyclists, lorries more: with the scan's own rays, occlusion, classes, instances and 3-D boxes.

    What they hide is gone, what stands before them stays, all else bit by bit. Where no place is named they stand where
    there is room on road or sidewalk, by the file's labels, else by the network's; of scan i of several by seed + i.
    Points that are new have `new`, their class and the number of their box, and a .json beside the file has the boxes.
    """
    from lidarsynth.streets.wanted import wanted
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.batch import Job

    at_least(0, {"seed": seed})
    wanted(add)
    job = Job("insert", model, device, Filling(seed=seed), sensor=sensor, picture=picture, things=add)
    work_through(job, scans, out, many, intensity)
