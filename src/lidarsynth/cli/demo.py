"""The verb `demo`: everything once, offline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import Seed, Source, arg
from lidarsynth.cli.complete import complete
from lidarsynth.cli.generate import generate
from lidarsynth.cli.info import info
from lidarsynth.cli.project import project
from lidarsynth.cli.scan_files import read_scan, write_and_say
from lidarsynth.cli.terminal import say


def demo(
    out: Annotated[Path, arg(help="folder to write to.")] = Path("demo"), model: Source = "default", seed: Seed = 0
) -> None:
    """Everything once, offline, on a shipped synthetic scan; ends with the list of what it made."""
    import numpy as np

    street = Path(__file__).parents[1] / "shipped" / "street.npz"
    project([street], out / "street.npz")
    sparse = read_scan(street, "auto")
    write_and_say(out / "sixteen_beams.pcd", sparse[np.asarray(sparse.ring) % 4 == 0])
    generate(4, out / "generated", model, seed=seed)
    complete([street], out / "beams.ply", "beams:4", model, seed=seed)
    complete([street], out / "sector.ply", "sector:90", model, seed=seed)
    complete([out / "sixteen_beams.pcd"], out / "dense.ply", model=model, seed=seed)
    info(model)
    made = sorted(path for path in out.rglob("*") if path.is_file())
    say("\n".join([f"\n{len(made)} files in {out}/, look at the pictures:", *(f"  {path}" for path in made)]))
