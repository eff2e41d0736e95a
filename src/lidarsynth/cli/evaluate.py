"""The verb `evaluate`: judge samples against a reference."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from lidarsynth.cli.arguments import Device, Intensity, Positional, arg
from lidarsynth.cli.terminal import at_least, check_device, say


def evaluate(
    samples: Annotated[Positional[list[Path]], arg(metavar="SAMPLES", help="folder, cache, or .safetensors parts.")],
    reference: Annotated[Path | None, arg(metavar="CACHE|STATS|FOLDER", help="what to compare with.")] = None,
    protocol: Annotated[str, arg(help="such as r2dm-2024, bev-1; a wrong word lists all.")] = "bev-1",
    out: Annotated[Path, arg(help=".json, with .md beside it; of a part .safetensors.")] = Path("report.json"),
    part: Annotated[str | None, arg(metavar="I/N", help="only gather the statistics of this part, to merge.")] = None,
    side: Annotated[Literal["samples", "reference"], arg(help="what the images of a part are.")] = "samples",
    sensor: Annotated[str | None, arg(help="of samples that are points; default: the reference's.")] = None,
    batch_size: Annotated[int, arg(help="images at once; makes no difference but of rounding.")] = 4,
    seed: Annotated[int, arg(help="of the subsets of the squared MMDs.")] = 0,
    device: Device = "cpu",
    intensity: Intensity = "auto",
) -> None:
    """Judge samples against a reference under a named protocol; killed at any moment, the same command goes on."""
    from lidarsynth.cli.terminal import image_bar
    from lidarsynth.evaluation import evaluate as evaluation
    from lidarsynth.evaluation.parts import notes_of

    at_least(1, {"batch-size": batch_size})
    at_least(0, {"seed": seed})
    check_device(device)
    if not samples:
        raise ValueError("expected SAMPLES to judge: a folder, a cache or .safetensors parts, found none")
    if part is None and side != "samples":
        raise ValueError(f"expected --side {side} with --part, found no part")
    with image_bar() as on_images:
        if part is not None:
            more = (device, on_images, side, reference, intensity)
            evaluation.gather_part(samples, part, out, protocol, sensor, batch_size, *more)
            for note in notes_of([out]):
                say(f"note: {note}")
        elif reference is not None:
            evaluation.check_out(out)
            more = (device, on_images, intensity)
            report = evaluation.evaluate(samples, reference, protocol, sensor, seed, batch_size, *more)
            say(str(report))
            evaluation.write_report(report, out)
        else:
            raise ValueError("expected --reference CACHE, STATS or FOLDER, found none")
    say(f"wrote {out}" if part else f"wrote {out} and {out.with_suffix('.md')}")
