"""The verb `realise`: a simulator's scans as a real sensor would have reported them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from lidarsynth.cli.arguments import Device, Picture, Positional, Seed, SensorWord, Source, arg
from lidarsynth.cli.many import Many, work_through
from lidarsynth.cli.terminal import at_least


def realise(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures.")],
    out: Annotated[Path, arg(help="file to write, .ply .pcd .bin .npy .npz; a folder for several scans; or a bag.")],
    sensor: SensorWord = None,
    model: Source = "default",
    seed: Seed = 0,
    device: Device = "cpu",
    intensity: Annotated[
        Literal["auto", "unit", "byte", "uint16", "none"],
        arg(help="scale of a bag's intensities, in which those that it gets are written; none: as they seem to be."),
    ] = "none",
    picture: Picture = True,
    many: Annotated[Many, arg(name="")] = Many(),  # noqa: B008, frozen
) -> None:
    """Real looks for perfect points: rays drop out as a real sensor's do, and get its reflectance.

    For scans of CARLA, Gazebo, Isaac or AirSim, in which every ray returns. Points that stay are the simulator's, bit
    by bit with all their fields; a .label of a .bin is thinned with it. What the sensor cannot see, out of its view
    or limits, goes. Which rays drop is drawn: of scan i of several from seed + i.
    """
    from lidarsynth.systems.filling import Filling
    from lidarsynth.verbs.batch import Job

    at_least(0, {"seed": seed})
    job = Job("realise", model, device, Filling(seed=seed), sensor=sensor, picture=picture)
    work_through(job, scans, out, many, intensity)
