"""Where the images of a cache come from: synthetic streets, or a folder of scan files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from lidarsynth.data.dataset import write_cache
from lidarsynth.data.files import READERS, read
from lidarsynth.lidar.projection import project
from lidarsynth.lidar.sensor import get_sensor


def cache_synthetic(
    folder: str | Path, count: int, sensor: str = "hdl-64e-kitti", width: int = 1024, seed: int = 0
) -> Iterator[tuple[int, int]]:
    """Cast `count` synthetic streets into a cache; yields (images stored, images in all)."""
    from lidarsynth.data.synthetic.reader import SyntheticStreets

    spec = get_sensor(sensor).resized(width=width)
    streets = SyntheticStreets(seed=seed, length=count, sensor=spec)
    for done in write_cache(folder, streets.image, count, spec, {"name": "synthetic", "seed": seed}):
        yield done, count


def cache_files(
    root: str | Path, folder: str | Path, sensor: str, projection: str = "auto", width: int = 1024
) -> Iterator[tuple[int, int]]:
    """Project every readable scan under `root` into a cache; yields (images stored, images in all).

    Raises ValueError when there is none, or when one cannot be read.
    """
    spec = get_sensor(sensor).resized(width=width)
    paths = scan_files(root)
    source = {"name": "files", "root": str(Path(root).resolve()), "projection": projection}
    for done in write_cache(folder, lambda i: project(read(paths[i]), spec, projection), len(paths), spec, source):
        yield done, len(paths)


def scan_files(root: str | Path) -> list[Path]:
    """The scan files under a folder, sorted. Raises ValueError when there is none."""
    root = Path(root)
    if not root.is_dir():
        raise ValueError(f"{root}: expected a folder of scans, found {'a file' if root.exists() else 'nothing'}")
    paths = sorted(p for p in root.rglob("*") if p.is_file() and p.name.lower().endswith(tuple(READERS)))
    if not paths:
        raise ValueError(f"{root}: expected scans ({', '.join(READERS)}), found none")
    return paths
