"""How verbs read one scan and write one result, and say so."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from lidarsynth.cli.terminal import say

if TYPE_CHECKING:
    import numpy as np

    from lidarsynth.lidar.scan import RangeImage, Scan


def read_scan(path: Path, intensity: str) -> Scan:
    """The scan of a file; says how many points were dropped. Raises ValueError."""
    from lidarsynth.files.fields import dropped_points
    from lidarsynth.files.formats import read_with_report

    scan, dropped = read_with_report(path, intensity)
    if dropped:
        say(f"{path}: {dropped_points(dropped)}, {len(scan)} stay")
    return scan


def write_and_say(path: Path, scan: Scan | RangeImage, figure: np.ndarray | None = None) -> None:
    """Write a file, and its picture beside it, and say so."""
    from lidarsynth.files.formats import write
    from lidarsynth.pictures.render import save_png

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, scan)
    say(f"wrote {path}" if figure is None else f"wrote {path} and {save_png(path.with_suffix('.png'), figure)}")
