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
    say(f"wrote {_view(out, street)}: the four results in the browser")
    info(model)
    made = sorted(path for path in out.rglob("*") if path.is_file())
    say("\n".join([f"\n{len(made)} files in {out}/, look at the pictures:", *(f"  {path}" for path in made)]))


def _view(out: Path, street: Path) -> Path:
    """One page of what was generated and completed, to be opened in any browser."""
    from lidarsynth.viewer.beside import read_shown
    from lidarsynth.viewer.page import Entry, write_page

    dense = {"completed": out / "dense.ply", "sixteen beams": out / "sixteen_beams.pcd", "truth": street}
    stops = [(path.stem, {"generated": path}) for path in sorted((out / "generated").glob("*.ply"))]
    stops += [
        ("every fourth beam", {"completed": out / "beams.ply", "truth": street}),
        ("without a sector", {"completed": out / "sector.ply", "truth": street}),
        ("sixteen beams", dense),
    ]
    path = out / "view.html"
    write_page(path, "demo", (Entry(name, {c: read_shown(p) for c, p in of.items()}) for name, of in stops))
    return path
