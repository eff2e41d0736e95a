"""The verb `benchmark` of the command line. The heavy imports are inside, so that --help is instant."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from lidarsynth.cli.arguments import Device, Positional, arg
from lidarsynth.cli.terminal import at_least, image_bar, load_with_bar, say


def benchmark(
    kind: Annotated[Positional[Literal["upsampling", "generation"]], arg(help="what the methods do.")],
    config: Annotated[Positional[Path], arg(metavar="CONFIG", help=".toml: data, protocols, and a [[method]] a row.")],
    out: Annotated[Path, arg(help="folder to write to.")] = Path("benchmark"),
    data: Annotated[
        str | None, arg(metavar="CACHE|FOLDER|synthetic:N:SEED", help="instead of the file's data or reference.")
    ] = None,
    classes: Annotated[
        Path | None, arg(metavar="WEIGHTS", help="RangeNet archive, for semantic IoU and the colours of points.")
    ] = None,
    seed: Annotated[int | None, arg(metavar="INT", help="instead of the file's; scan i takes seed + i.")] = None,
    batch_size: Annotated[int, arg(help="scans at once on a GPU; a CPU makes them one by one, as fast.")] = 4,
    device: Device = "cpu",
) -> None:
    """Methods side by side: tables, numbers and pictures; killed at any moment, the same command goes on."""
    from lidarsynth.benchmark import run
    from lidarsynth.files.lock import only_writer

    at_least(0, {"seed": seed})
    at_least(1, {"batch-size": batch_size})
    options = {"--out": out, "--data": data, "--classes": classes, "--seed": seed}
    words = [word for option, value in options.items() if value is not None for word in (option, str(value))]
    words += ["--device", device] if device != "cpu" else []
    command = shlex.join(["lidarsynth", "benchmark", kind, str(config), *words])
    load = partial(load_with_bar, device=device)
    with only_writer(out, "benchmark"), image_bar() as on_images:
        text = run.benchmark(kind, config, out, load, data, classes, seed, device, batch_size, on_images, command)
    say(text)
    made = [name for name in (run.RESULTS, run.TABLE, run.FIGURE, run.SCORES) if (out / name).is_file()]
    say(f"wrote {out}/ with {', '.join(made)}")
