"""The command line: one table verb -> function. Heavy imports are inside the verbs, so that --help is instant."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from lidarsynth.arguments import (
    Count,
    Device,
    Format,
    GenerationSteps,
    Intensity,
    Method,
    NoSeed,
    Output,
    Picture,
    Positional,
    Recipe,
    Resamples,
    Sampler,
    Seed,
    SensorOut,
    SensorWord,
    Source,
    Steps,
    arg,
    fields_joined,
)
from lidarsynth.benchmark.verb import benchmark
from lidarsynth.terminal import answer, at_least, counted, load_with_bar, progress_line, say, step_bar
from lidarsynth.training.options import Options

if TYPE_CHECKING:
    import numpy as np

    from lidarsynth.completion import Filled
    from lidarsynth.lidar.scan import RangeImage, Scan


def generate(
    count: Count = 4,
    out: Annotated[Path, arg(help="folder to write to.")] = Path("out"),
    model: Source = "default",
    format: Annotated[Format, arg(help="of the files.")] = "ply",
    steps: GenerationSteps = None,
    sampler: Annotated[Sampler | None, arg(help="of the reverse process; default ddpm.")] = None,
    seed: Annotated[int, arg(help="scan i depends on seed + i only.")] = 0,
    batch_size: Annotated[int, arg(help="scans at once on a GPU; a CPU makes them one by one, as fast.")] = 4,
    device: Device = "cpu",
    picture: Picture = True,
) -> None:
    """New scans: a file and a picture per scan. Stopped, the same command goes on where it was."""
    from lidarsynth.generation import batches, claim, fingerprint, generate_into

    at_least(1, {"count": count, "steps": steps, "batch-size": batch_size})
    at_least(0, {"seed": seed})
    loaded = load_with_bar(model, device)
    steps = loaded.generation_steps(steps, sampler)
    settings = {"weights": fingerprint(loaded), "format": format, "steps": steps, "sampler": sampler, "seed": seed}
    claim(out, settings)
    endings = (f".{format}", ".png") if picture else (f".{format}",)
    # Batches of other sizes round differently on a CPU, and are no faster.
    runs = batches(out, count, endings, 1 if device == "cpu" else batch_size)
    with step_bar("generate", len(runs) * steps) as on_step:
        new = sum(1 for _ in generate_into(out, loaded, runs, endings, steps, sampler, seed, on_step))
    say(f"{out}/ has {count} scans, {new} of them new: 000000.{format} ... {count - 1:06d}.{format}")


def complete(
    scans: Annotated[Positional[list[Path]], arg(metavar="SCAN...", help="files, or one folder of scans.")],
    out: Annotated[Path, arg(help="file to write, as in upsample, or a folder where there are several scans.")],
    corrupt: Recipe = None,
    model: Source = "default",
    method: Method = "auto",
    steps: Steps = None,
    resamples: Resamples = 10,
    seed: Seed = 0,
    device: Device = "cpu",
    intensity: Intensity = "auto",
    picture: Picture = True,
) -> None:
    """Fill what a scan lacks: every measured point stays, bit by bit, and new ones are added.

    With --corrupt a part of the scan is hidden first. The file then holds what the rest was filled to, and the errors
    of the hidden pixels are printed beside those of interpolation.
    """
    from lidarsynth.completion import complete_scan
    from lidarsynth.report import errors_table, mean_table
    from lidarsynth.targets import targets

    at_least(1, {"steps": steps, "resamples": resamples})
    at_least(0, {"seed": seed})
    loaded, tables = None, []
    for path, target in targets(scans, out):
        scan = _read(path, intensity)
        loaded = loaded or load_with_bar(model, device)
        with step_bar(path.name, loaded.evaluations(method, steps, resamples)) as on_step:
            filled = complete_scan(loaded, scan, corrupt, method, steps, resamples, seed, on_step)
        _write_filled(target, filled, picture)
        if filled.errors:
            say(errors_table(path.name, filled.errors))
            tables.append(filled.errors)
    if len(tables) > 1:
        say(mean_table(tables))


def upsample(
    scan: Annotated[Positional[Path], arg(help="file of the sparse scan.")],
    out: Output,
    sensor_in: Annotated[SensorWord, arg(name="from")] = None,
    sensor_out: SensorOut = None,
    model: Source = "default",
    method: Method = "auto",
    steps: Steps = None,
    resamples: Resamples = 10,
    seed: Seed = 0,
    device: Device = "cpu",
    intensity: Intensity = "auto",
    picture: Picture = True,
) -> None:
    """Make a scan of a sensor with few beams dense: every measured point stays, bit by bit, and new ones are added."""
    from lidarsynth.completion import into_sensor, named_sensor, upsample_scan
    from lidarsynth.targets import target

    at_least(1, {"steps": steps, "resamples": resamples})
    at_least(0, {"seed": seed})
    target(out, scan)
    sparse = _read(scan, intensity)
    sensor = named_sensor(sparse, scan, "--from", sensor_in)
    loaded = load_with_bar(model, device)
    loaded = into_sensor(loaded, sensor_out) if sensor_out else loaded
    with step_bar(scan.name, loaded.evaluations(method, steps, resamples)) as on_step:
        filled = upsample_scan(loaded, sparse, sensor, method, steps, resamples, seed, on_step)
    say(f"{scan}: {len(sparse)} points of {sensor.name} became {len(filled.points)}")
    _write_filled(out, filled, picture)


def project(
    scan: Annotated[Positional[Path], arg(help="file of the scan.")],
    out: Annotated[Path, arg(help=".npz to write; another kind of file gets the points that won a pixel.")],
    sensor: SensorWord = None,
    method: Annotated[
        Literal["auto", "spherical", "unfolding"],
        arg(help="spherical puts points into rows by elevation, unfolding by ring."),
    ] = "auto",
    width: Annotated[int | None, arg(metavar="INT", help="columns, if other than the sensor's.")] = None,
    seed: NoSeed = 0,
    intensity: Intensity = "auto",
    picture: Picture = True,
) -> None:
    """Draw a scan as a range image: .npz with range, reflectance, mask and sensor, and a picture."""
    from lidarsynth.completion import named_sensor
    from lidarsynth.lidar import projection
    from lidarsynth.pictures import portrait
    from lidarsynth.targets import target

    at_least(4, {"width": width})
    target(out, scan)
    points = _read(scan, intensity)
    image = projection.project(points, named_sensor(points, scan, "--sensor", sensor), method, width)
    if not image.mask.any():
        raise ValueError(f"{scan}: expected points within {image.sensor.name}'s view, found none of {len(points)}")
    say(f"{scan}: {len(points)} points, {image.sensor.name}, {image.mask.mean():.1%} of {image.shape} pixels filled")
    _write(out, image, portrait(image) if picture else None)


def info(
    what: Annotated[
        Positional[str],
        arg(help="default, a preset, a release, a model folder, an official .pth, a sensor, or a scan file."),
    ] = "default",
    seed: NoSeed = 0,
) -> None:
    """What a model, a preset, a sensor or a scan file is."""
    from lidarsynth.report import describe

    say(describe(what))


def demo(
    out: Annotated[Path, arg(help="folder to write to.")] = Path("demo"), model: Source = "default", seed: Seed = 0
) -> None:
    """Everything once, offline, on a shipped synthetic scan; ends with the list of what it made."""
    import numpy as np

    street = Path(__file__).parent / "shipped" / "street.npz"
    project(street, out / "street.npz")
    sparse = _read(street, "auto")
    _write(out / "sixteen_beams.pcd", sparse[np.asarray(sparse.ring) % 4 == 0])
    generate(4, out / "generated", model, seed=seed)
    complete([street], out / "beams.ply", "beams:4", model, seed=seed)
    complete([street], out / "sector.ply", "sector:90", model, seed=seed)
    upsample(out / "sixteen_beams.pcd", out / "dense.ply", model=model, seed=seed)
    info(model)
    made = sorted(path for path in out.rglob("*") if path.is_file())
    say("\n".join([f"\n{len(made)} files in {out}/, look at the pictures:", *(f"  {path}" for path in made)]))


def data(
    source: Positional[Literal["synthetic", "files", "kitti", "kitti360", "nuscenes", "nuscenes-sweeps"]],
    root: Positional[Path],
    cache: Positional[Path | None] = None,
    split: str | None = None,
    sensor: str | None = None,
    projection: Literal["auto", "spherical", "unfolding"] | None = None,
    width: int | None = None,
    workers: int | None = None,
    count: Count = 1000,
    check: bool = False,
    seed: int = 0,
    intensity: Literal["auto", "unit", "byte", "uint16", "none"] = "auto",
    apart: bool = False,
) -> None:
    """Prepare a cache of range images for training; killed at any moment, the same command goes on.

    Args:
        source: synthetic streets, a folder of scan files, or a data set.
        root: where the files are; the cache itself for synthetic streets.
        cache: folder to write.
        split: train, val, test or all; of nuscenes mini, trainval or test.
        sensor: whose images: hdl-64e, ... or a .toml/.json file. This, projection and width have defaults by source;
            the sensor of files is recognised from the first.
        projection: how points become rows.
        width: columns; below 1024 they are chosen from 1024, or 2048 when unfolding, as in R2DM.
        workers: processes, one per processor core if not given.
        count: synthetic scans.
        check: also compare the checksums of what is there already, and make anew what is damaged.
        seed: of the synthetic streets.
        intensity: scale of files: 0-1, 0-255, 0-65535, or none for files without.
        apart: every synthetic scan from a street of its own, for sets that are compared; else sixteen from each.
    """
    from lidarsynth.data.sources import prepare, summary

    more = (workers, count, check, seed, intensity, apart)
    for _ in counted(prepare(source, root, cache, split, sensor, projection, width, *more)):
        pass
    say(f"wrote {summary(cache or root)}")


def train(
    preset: Annotated[Positional[str], arg(help="such as default, r2dm-h, tiny.")],
    data: Annotated[Path | None, arg(metavar="CACHE|synthetic", help="or several, A,B; or streets.")] = None,
    out: Annotated[Path | None, arg(help="folder for weights and checkpoints; default runs/PRESET.")] = None,
    weights: Annotated[str | None, arg(name="from", metavar="MODEL", help="start from these weights.")] = None,
    set: Annotated[tuple[str, ...], arg(help="such as training.steps=9; or --training.steps 9.")] = (),
    validation: Annotated[Path | None, arg(metavar="CACHE", help="images that are not trained on.")] = None,
    resume: Annotated[bool, arg(help="insist that there is a run to continue.")] = False,
    dry_run: Annotated[bool, arg(help="print the resolved experiment and stop.")] = False,
    seed: Annotated[int, arg(help="of weights, order and noise.")] = 0,
    options: Annotated[Options, arg(name="")] = Options(),  # noqa: B008, frozen
) -> None:
    """Train a preset; killed at any moment, the same command goes on exactly, from the newest checkpoint."""
    from lidarsynth.training.run import resolve, run

    experiment = resolve(preset, set, seed, data)
    if dry_run:
        say(json.dumps(asdict(experiment), indent=1))
        return
    if data is None:
        raise ValueError("expected --data CACHE or --data synthetic, found neither")
    out = out or Path("runs") / preset
    steps = experiment.training.steps
    done = list(progress_line(run(experiment, data, out, weights, validation, options, resume), steps))
    if done:  # other processes than the first say nothing
        say(
            f"wrote {out}/" + (f", stopped after step {done[-1]}; the same command goes on" if done[-1] < steps else "")
        )


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
) -> None:
    """Judge samples against a reference under a named protocol; killed at any moment, the same command goes on."""
    from lidarsynth import evaluation
    from lidarsynth.terminal import image_bar

    at_least(1, {"batch-size": batch_size})
    at_least(0, {"seed": seed})
    if not samples:
        raise ValueError("expected SAMPLES to judge: a folder, a cache or .safetensors parts, found none")
    with image_bar() as on_images:
        if part is not None:
            evaluation.gather_part(samples, part, out, protocol, sensor, batch_size, device, on_images, side, reference)
        elif reference is not None:
            evaluation.check_out(out)
            report = evaluation.evaluate(samples, reference, protocol, sensor, seed, batch_size, device, on_images)
            say(str(report))
            evaluation.write_report(report, out)
        else:
            raise ValueError("expected --reference CACHE, STATS or FOLDER, found none")
    say(f"wrote {out}" if part else f"wrote {out} and {out.with_suffix('.md')}")


def _read(path: Path, intensity: str) -> Scan:
    from lidarsynth.data.files import read_with_report

    scan, dropped = read_with_report(path, intensity)
    if dropped:
        say(f"{path}: {dropped} points without a return or not finite were dropped, {len(scan)} stay")
    return scan


def _write(path: Path, scan: Scan | RangeImage, figure: np.ndarray | None = None) -> None:
    """Write a file, and its picture beside it, and say so."""
    from lidarsynth.data.files import write
    from lidarsynth.lidar.render import save_png

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, scan)
    say(f"wrote {path}" if figure is None else f"wrote {path} and {save_png(path.with_suffix('.png'), figure)}")


def _write_filled(path: Path, filled: Filled, picture: bool) -> None:
    content = filled.image if path.suffix.lower() == ".npz" else filled.points
    _write(path, content, filled.figure() if picture else None)


VERBS = {
    "demo": demo,
    "generate": generate,
    "complete": complete,
    "upsample": upsample,
    "project": project,
    "data": data,
    "train": train,
    "evaluate": evaluate,
    "benchmark": benchmark,
    "info": info,
}


def main(argv: list[str] | None = None) -> None:
    """Run one verb: exits 0, or 2 with one line that says what was expected and what was found."""
    argv = sys.argv[1:] if argv is None else argv
    answer(VERBS, fields_joined(argv) if argv[:1] == ["train"] else argv)
