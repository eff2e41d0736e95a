"""The verb `streets`: labelled synthetic data sets in layouts that others' tools read."""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from lidarsynth.cli.arguments import arg
from lidarsynth.cli.scan_files import may_draw
from lidarsynth.cli.terminal import at_least, counted, say
from lidarsynth.lidar.plural import plural

if TYPE_CHECKING:
    from lidarsynth.streets.frame import LabelledStreets


def streets(
    out: Annotated[Path, arg(help="folder of the data set.")],
    count: Annotated[int, arg(aliases=["-n"], help="how many scans, or drives with --frames, at least.")] = 100,
    sensor: Annotated[str, arg(metavar="SENSOR", help="such as vlp-16, or a .toml/.json file.")] = "hdl-64e-kitti",
    format: Annotated[
        Literal["semantickitti", "kitti", "nuscenes", "pcd"], arg(help="layout that others' tools read.")
    ] = "semantickitti",
    seed: Annotated[int, arg(help="scan i of a seed depends on nothing else.")] = 0,
    frames: Annotated[int, arg(help="of each drive; 0 = scans of places, where everything stands still.")] = 0,
    rate: Annotated[float, arg(help="turns per second.")] = 10.0,
    speed: Annotated[
        float | None, arg(metavar="KM/H", help="the car would like to drive; default: as the street has it.")
    ] = None,
    deskewed: Annotated[bool, arg(help="take the car's own motion out of a turn; boxes stand where seen.")] = False,
    perfect: Annotated[bool, arg(help="as a simulator casts: no ray-drop, noise or reflectance; see realise.")] = False,
    inside: Annotated[bool, arg(help="rooms, halls and garages in place of streets, for robots.")] = False,
    traffic: Annotated[float, arg(help="moving vehicles, riders among them: 1 = as usual, 2 = twice, 0 = none.")] = 1.0,
    parking: Annotated[float, arg(help="parked vehicles, likewise; 0 = no car parks or bicycles either.")] = 1.0,
    pedestrians: Annotated[float, arg(help="likewise; 0.08 = the share of real scans, of which 1 has 14 times.")] = 1.0,
    vegetation: Annotated[float, arg(help="trees and bushes, likewise; hedges stay.")] = 1.0,
    groups: Annotated[float, arg(help="of people who stand together, per 100 m and side of the street.")] = 0.0,
    motorcycles: Annotated[float, arg(help="places with parked ones, likewise.")] = 0.0,
    works: Annotated[float, arg(help="construction sites, likewise.")] = 0.0,
    cyclists: Annotated[float, arg(help="on the sidewalk's edge, likewise.")] = 0.0,
    heavy: Annotated[float, arg(help="lorries, coaches and trailers that stand, likewise.")] = 0.0,
    walls: Annotated[float, arg(help="walls and fences of more kinds, likewise.")] = 0.0,
    barriers: Annotated[float, arg(help="crash barriers, likewise.")] = 0.0,
    panels: Annotated[float, arg(help="larger than signs, likewise.")] = 0.0,
    garages: Annotated[float, arg(help="rows of them, likewise.")] = 0.0,
    riders: Annotated[float, arg(help="of bicycles and motorcycles, on the main road, likewise.")] = 0.0,
    walkers: Annotated[float, arg(help="people of more shapes on sidewalks, likewise.")] = 0.0,
    racks: Annotated[float, arg(help="of parked bicycles, likewise.")] = 0.0,
    kerbs: Annotated[float, arg(help="their height: 1 = 12 cm, 0.5 = half of it.")] = 1.0,
    rain: Annotated[float, arg(help="mm/h; 0 = none.")] = 0.0,
    fog: Annotated[float, arg(help="metres that one sees; 0 = none.")] = 0.0,
    overlap: Annotated[bool, arg(help="--no-overlap: nobody stands in others or in walls, as in drives.")] = True,
    workers: Annotated[int | None, arg(metavar="INT", help="processes, one per processor core if not given.")] = None,
    picture: Annotated[bool, arg(help="write overview.png, four frames with their boxes.")] = True,
) -> None:
    """Labelled scans of synthetic streets: classes, instances, 3-D boxes, poses; stopped, the same command goes on."""
    from lidarsynth.data.street_sets import with_those_there, write_streets
    from lidarsynth.lidar.sensor import get_sensor
    from lidarsynth.streets.areas import Density
    from lidarsynth.streets.frame import LabelledStreets, Options
    from lidarsynth.streets.weather import Weather

    at_least(0, {"workers": workers})
    density = Density(traffic, parking, pedestrians, vegetation, groups, motorcycles, works, kerbs, cyclists, heavy,
                      walls, barriers, panels, garages, riders, walkers, racks)  # fmt: skip
    weather, speed = Weather(rain, fog), speed and speed / 3.6
    options = Options(frames, rate, speed, deskewed, perfect, density, weather, inside=inside, overlap=overlap)
    made = with_those_there(out, LabelledStreets(seed, count, get_sensor(sensor), options), format)
    written = write_streets(out, made, format, os.cpu_count() or 1 if workers is None else workers)
    deque(counted((done, len(made)) for done in written), maxlen=0)
    kept = f", more than -n {count} asks for" if made.count > count else ""
    say(f"{out}/ has {plural(len(made), 'labelled scan')} of {made.sensor.name} in the layout of {format}{kept}")
    _tell_of_tilt(made, format)
    if picture and may_draw(out / "overview.png"):
        _picture(made, out / "overview.png")


def _tell_of_tilt(made: LabelledStreets, format: str) -> None:
    from lidarsynth.streets.turn import told_of_tilt

    if format != "nuscenes" and (told := told_of_tilt(made.sensor)):
        say(f"{told}; upright in the world, by place, heading and pose of the JSON, they have all")


def _picture(made: LabelledStreets, path: Path) -> None:
    from lidarsynth.data.street_sets import overview
    from lidarsynth.pictures.render import save_png

    say(f"wrote {save_png(path, overview(made))}")
