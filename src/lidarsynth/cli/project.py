"""The verb `project`: a scan drawn as a range image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from lidarsynth.cli.arguments import Intensity, NoSeed, Picture, Positional, SensorWord, arg
from lidarsynth.cli.many import Many, work_through
from lidarsynth.cli.terminal import at_least


def project(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, folders, globs, bags, captures.")],
    out: Annotated[Path, arg(help=".npz to write; another kind of file gets the points that won a pixel.")],
    sensor: SensorWord = None,
    method: Annotated[
        Literal["auto", "spherical", "unfolding"],
        arg(help="spherical puts points into rows by elevation, unfolding by ring."),
    ] = "auto",
    width: Annotated[int | None, arg(metavar="INT", help="columns, if other than the sensor's.")] = None,
    seed: NoSeed = 0,
    intensity: Intensity = "auto",
    picture: Picture = True,
    many: Annotated[Many, arg(name="")] = Many(),  # noqa: B008, frozen
) -> None:
    """Draw a scan as a range image: .npz with range, reflectance, mask and sensor, and a picture."""
    from lidarsynth.verbs.batch import Job

    at_least(4, {"width": width})
    job = Job("project", sensor=sensor, projection=method, width=width, picture=picture)
    work_through(job, scans, out, many, intensity)
