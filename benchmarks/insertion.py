"""How near what `insert` puts into scans comes to the same things cast where they stand, and how they are read.

python benchmarks/insertion.py [--sensor WORD ...] [--streets N] [--add THINGS] [--real FOLDER ...]

Streets that nothing was trained on, without traffic, are cast; road users inserted into the scans; then the same shapes
put into the streets, and these cast anew with the same noise. Of labelled real scans, read as `benchmarks/street.py
--classes` reads them: which share of the points of what was inserted the network of classes names so, and of what was
recorded.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from street import labelled

import lidarsynth as ls
from lidarsynth.cli.terminal import answer
from lidarsynth.lidar.removal import TRAFFIC
from lidarsynth.lidar.scan import Scan
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.streets.raycast import Caster
from lidarsynth.streets.reader import SyntheticStreets, Worlds
from lidarsynth.streets.shapes import Mesh
from lidarsynth.streets.turn import sensor_pose
from lidarsynth.streets.wanted import wanted
from lidarsynth.streets.world import POSES, THING, World
from lidarsynth.systems.insertion import placed, with_points

HELD_OUT = 777_118  # a seed that nothing was trained on
THINGS = [CLASS_NUMBER[word] for word in TRAFFIC]
SAME = 0.1  # of a column: rays are the same
OFF = 0.1  # metres


def with_things(world: World, meshes: list[Mesh]) -> World:
    """The world and shapes more, (T, 3, 3) metres in its frame."""
    each = [(len(mesh), mesh) for mesh in meshes]

    def more(name: str, parts: list[np.ndarray]) -> np.ndarray:
        return np.concatenate([getattr(world, name), *parts])

    full = {name: [np.full(count, value) for count, _ in each] for name, value in (("kind", THING), ("front", -1))}
    full |= {name: [getattr(mesh, name) for _, mesh in each] for name in ("corners", "material", "label")}
    full |= {"tint": [np.zeros(count) for count, _ in each], "thing": [np.full(count, -1) for count, _ in each]}
    return replace(
        world, **{name: more(name, parts).astype(getattr(world, name).dtype) for name, parts in full.items()}
    )


class Of:
    """One world for all numbers, as `SyntheticStreets` asks for it."""

    def __init__(self, world: World):
        self.both = world, Caster(world.corners)

    def __getitem__(self, number: int) -> tuple[World, Caster]:
        return self.both


def pairs(word: str, count: int, add: str) -> Iterator[tuple[Scan, Scan, int]]:
    """Scans with what was inserted; the same cast; how many things they have."""
    model = ls.load("default")
    worlds = Worlds(HELD_OUT, ls.get_sensor(word), TRAFFIC)
    streets = SyntheticStreets(HELD_OUT, 1 << 20, word, TRAFFIC, worlds=worlds)
    for number in range(3, POSES * count, POSES):
        scan, sensor = streets[number], streets.sensor.resized(width=max(2083, streets.sensor.width))
        there = placed(model.into(sensor), scan, wanted(add), np.random.default_rng(number))
        world, _ = worlds[number // POSES]
        matrix = sensor_pose(sensor, world.poses[number % POSES]).astype(np.float32)
        shapes = [one.spot.on_ground(one.mesh) for one in there.put]
        shapes = [replace(one, corners=one.corners @ matrix[:3, :3].T + matrix[:3, 3]) for one in shapes]
        cast = SyntheticStreets(HELD_OUT, 1 << 20, word, TRAFFIC, worlds=Of(with_things(world, shapes)))
        yield with_points(scan, there).scan, cast[number], len(shapes)


def compared(found: Scan, cast: Scan, columns: int) -> np.ndarray:
    """Points of things: inserted, cast, of the same ray in both, of these nearer than OFF; other points: in the scan
    with what was inserted alone, in the one that was cast alone, in both."""
    step = 2 * np.pi / columns
    mine, theirs = (10 * s.ring + np.arctan2(s.xyz[:, 1], s.xyz[:, 0]).astype(np.float64) for s in (found, cast))
    order = np.argsort(theirs)
    place = np.searchsorted(theirs[order], mine - SAME * step).clip(max=len(order) - 1)
    one = np.flatnonzero(np.abs(theirs[order[place]] - mine) < SAME * step)
    other = order[place[one]]
    thing = [np.isin(s.label, THINGS) for s in (found, cast)]
    far = [np.linalg.norm(s.xyz, axis=1) for s in (found, cast)]
    both = thing[0][one] & thing[1][other]
    near = np.abs(far[0][one] - far[1][other])[both] < OFF
    rest = ~thing[0][one] & ~thing[1][other]
    alone = [int((~mine).sum() - rest.sum()) for mine in thing]
    return np.array([thing[0].sum(), thing[1].sum(), both.sum(), near.sum(), *alone, rest.sum()])


def read_back(folder: Path, add: str) -> Iterator[tuple[str, int, int]]:
    """Of each class of labelled scans: points of what was recorded (or inserted), how many the network names so."""
    model = ls.load("default")
    for number, image in enumerate(labelled(folder)):
        found = model.insert(image.to_scan(), add, seed=number, sensor=image.sensor).scan
        named, new = model.label(found).label, found.extra["new"] > 0
        for word in ("car", "person", "bicyclist"):
            for whose, part in (("inserted", new), ("recorded", ~new)):
                at = part & (found.label == CLASS_NUMBER[word])
                yield f"{word}, {whose}", int(at.sum()), int((named[at] == CLASS_NUMBER[word]).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sensor", nargs="*", default=["hdl-64e-kitti", "os1-64", "hdl-32e", "vlp-16"])
    parser.add_argument("--streets", type=int, default=8)
    parser.add_argument("--add", default="car:3,person:3,bicyclist,truck")
    parser.add_argument("--real", nargs="*", type=Path, default=[])
    asked = parser.parse_args()
    for word in asked.sensor:
        columns = max(2083, ls.get_sensor(word).width)
        rows = [(compared(*scans, columns), count) for *scans, count in pairs(word, asked.streets, asked.add)]
        (mine, theirs, both, near, more, less, rest), things = sum(r for r, _ in rows), sum(n for _, n in rows)
        print(f"{word}: {things} things in {len(rows)} streets, {mine} points inserted, {theirs} cast, {both} of one "
               f"ray, of these {near / both:.1%} within {OFF} m; other points {more} there alone, {less} cast alone, "
               f"{rest} in both")  # fmt: skip
    for folder in asked.real:
        count: dict[str, np.ndarray | int] = {}
        for name, points, right in read_back(folder, asked.add):
            count[name] = count.get(name, 0) + np.array([points, right])
        for name, (points, right) in sorted(count.items()):
            print(f"{folder.name}: {name}: {points} points, {right / max(points, 1):.0%} named so")


if __name__ == "__main__":
    answer(main)
