"""The verb `project`: a scan drawn as a range image."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from lidarsynth.cli.arguments import Intensity, NoSeed, Picture, Positional, SensorWord, arg
from lidarsynth.cli.scan_files import read_scan, write_and_say
from lidarsynth.cli.terminal import at_least, say


def project(
    scan: Annotated[Positional[Path], arg(help="file of the scan.")],
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
) -> None:
    """Draw a scan as a range image: .npz with range, reflectance, mask and sensor, and a picture."""
    from lidarsynth.lidar import projection
    from lidarsynth.pictures.portrait import portrait
    from lidarsynth.verbs.completion import named_sensor
    from lidarsynth.verbs.output_files import target

    at_least(4, {"width": width})
    target(out, scan)
    points = read_scan(scan, intensity)
    image = projection.project(points, named_sensor(points, scan, "--sensor", sensor), method, width)
    if not image.mask.any():
        raise ValueError(f"{scan}: expected points within {image.sensor.name}'s view, found none of {len(points)}")
    say(f"{scan}: {len(points)} points, {image.sensor.name}, {image.mask.mean():.1%} of {image.shape} pixels filled")
    write_and_say(out, image, portrait(image) if picture else None)
