"""The verb `data`: prepare a cache of range images for training."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from lidarsynth.cli.arguments import Positional, arg
from lidarsynth.cli.terminal import at_least, counted, say, warn

MOST = 10_000_000  # synthetic scans of one cache; more fit on no disk


def data(
    source: Positional[str],
    root: Positional[Path],
    cache: Positional[Path | None] = None,
    split: str | None = None,
    sensor: str | None = None,
    projection: str | None = None,
    width: int | None = None,
    workers: int | None = None,
    count: Annotated[int | None, arg(aliases=["-n"])] = None,
    check: bool = False,
    seed: int = 0,
    intensity: Literal["auto", "unit", "byte", "uint16", "none"] = "auto",
    apart: bool = False,
    inside: bool = False,
    transform: str | None = None,
    axes: str = "flu",
    mount: float | None = None,
    rings: str | None = None,
) -> None:
    """Prepare a cache of range images for training; killed at any moment, the same command goes on.

    Args:
        source: synthetic, files of a folder, or a data set such as kitti, kitti360, nuscenes; a wrong word lists all.
        root: where the files are; the cache itself for synthetic streets.
        cache: folder to write.
        split: train, val, test or all; of nuscenes mini, trainval or test.
        sensor: whose images: hdl-64e, ... or a .toml/.json file. This, projection and width have defaults by source;
            the sensor of files is recognised from the first.
        projection: how points become rows: auto, spherical or unfolding.
        width: columns; of files and synthetic streets as many as the sensor has, if not given. Below 1024 they are
            chosen from 1024, or 2048 when unfolding, as in R2DM.
        workers: processes, one per processor core if not given.
        count: synthetic scans; 1000 if not given.
        check: also compare the checksums of what is there already, and make anew what is damaged.
        seed: of the synthetic streets.
        intensity: scale of files: 0-1, 0-255, 0-65535, or none for files without.
        apart: every synthetic scan from a street of its own, for sets that are compared; else sixteen from each.
        inside: synthetic scans of rooms, halls and garages, for robots, the sensor as high as its mount says.
        transform: brings points of files into the sensor's frame: x:y:z:roll:pitch:yaw, or a file of 4 x 4 numbers.
        axes: where x, y, z of files point (f b l r u d), as of complete.
        mount: metres of the sensor above z = 0 of files, where that is the ground.
        rings: of files of several sensors, such as 32-63; all others are left out.
    """
    from lidarsynth.data.sources import prepare, shards, summary, unfit
    from lidarsynth.verbs.placement import parse_rings, read_transform

    at_least(1, {"count": count})
    at_least(0, {"seed": seed, "workers": workers})
    if count is not None and count > MOST:
        raise ValueError(f"expected --count of at most {MOST:,} synthetic scans, found {count:,}")
    frame = read_transform(transform, mount, axes), parse_rings(rings)
    more = (workers, count, check, seed, intensity, apart, inside, *frame)
    there = shards(cache or root)
    for _ in counted(prepare(source, root, cache, split, sensor, projection, width, *more)):
        pass
    if (note := unfit(source, root, sensor, intensity, *frame, split)) is not None:
        warn(note)
    say(f"{'nothing is new:' if shards(cache or root) == there else 'wrote'} {summary(cache or root)}")
