"""How verbs read one scan and write one result, and say so."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lidarsynth.cli.terminal import say, warn

if TYPE_CHECKING:
    from lidarsynth.lidar.scan import RangeImage, Scan


def read_scan(path: Path, intensity: str) -> Scan:
    """The scan of a file; says how many points were dropped. Raises ValueError."""
    from lidarsynth.files.fields import dropped_points
    from lidarsynth.files.formats import read_with_report

    scan, dropped = read_with_report(path, intensity)
    if dropped:
        say(f"{path}: {dropped_points(dropped)}, {len(scan)} stay")
    return scan


def write_and_say(path: Path, scan: Scan | RangeImage) -> None:
    """Write a file and say so."""
    from lidarsynth.files.formats import write

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, scan)
    say(f"wrote {path}")


def may_draw(path: Path) -> bool:
    """Whether a picture may go to a path that the user did not name; says so where another one lies there."""
    from lidarsynth.pictures.figure import in_the_way

    if other := in_the_way(path):
        warn(f"{other}; it stays: use another --out, or --no-picture")
    return other is None
