"""The command line: one table verb -> function. Heavy imports are inside the verbs, so that --help is instant."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from lidarsynth.lidar.scan import RangeImage, Scan
    from lidarsynth.metrics.reconstruction import Errors
    from lidarsynth.model import LidarModel

Positional = tyro.conf.Positional
Format = Literal["ply", "pcd", "bin", "npy", "npz"]
Sampler = Literal["ddpm", "ddim", "dpmpp-2m", "heun"]
Method = Literal["auto", "conditional", "repaint"]
Intensity = Literal["auto", "unit", "byte", "uint16", "none"]
Count = Annotated[int, tyro.conf.arg(aliases=["-n"])]
From = Annotated[str | None, tyro.conf.arg(name="from")]


def generate(
    count: Count = 4,
    out: Path = Path("out"),
    model: str = "default",
    format: Format = "ply",
    steps: int = 32,
    sampler: Sampler = "ddpm",
    seed: int = 0,
    batch_size: int = 4,
    pictures: bool = True,
) -> None:
    """New scans: a file and a picture per scan. Stopped, the same command goes on where it was.

    Args:
        count: how many scans.
        out: folder to write to.
        model: default, a preset, a folder, or an official .pth.
        format: of the files.
        steps: network evaluations per scan.
        sampler: of the reverse process.
        seed: scan i depends on seed + i only.
        batch_size: scans at once; changes speed and memory, not the scans.
        pictures: write a .png beside each scan.
    """
    from tqdm import tqdm

    from lidarsynth.lidar.render import save_png
    from lidarsynth.model import load

    settings = {"model": model, "format": format, "steps": steps, "sampler": sampler, "seed": seed}
    _same_settings(out, settings)
    names = [out / f"{i:06d}.{format}" for i in range(count)]
    endings = [lambda path: path, lambda path: path.with_suffix(".png")][: 1 + pictures]
    missing = [i for i, path in enumerate(names) if not all(ending(path).exists() for ending in endings)]
    if missing:
        loaded = load(model)
        first = missing[0]
        total = (count - first) * steps
        with tqdm(total=total, unit="step", delay=2, desc="generate") as bar:
            done = 0
            for i, image in enumerate(loaded.stream(count, steps, seed, sampler, batch_size, first), first):
                _write(names[i], image)
                if pictures:
                    save_png(names[i].with_suffix(".png"), _portrait(image))
                done += steps
                bar.update(done - bar.n)
    print(f"wrote {count} scans to {out}/ ({len(missing)} new): {names[0].name} ... {names[-1].name}")


def complete(
    scans: Positional[list[Path]],
    out: Path,
    corrupt: str | None = None,
    model: str = "default",
    method: Method = "auto",
    steps: int | None = None,
    resamples: int = 10,
    seed: int = 0,
    intensity: Intensity = "auto",
    picture: bool = True,
) -> None:
    """Fill what a scan lacks; measured points stay as they are. Prints the errors where --corrupt hid the truth.

    Args:
        scans: files, or one folder of scans.
        out: file to write, or a folder when there are several scans.
        corrupt: hide part of the scan first and compare: beams:4, points:0.1, sector:90, region:5:20:-5:5, or several
            joined by +.
        model: default, a preset, a folder, or an official .pth.
        method: conditional tells the network what is known; repaint works with any network.
        steps: network steps, default 4 (conditional) or 32 (repaint).
        resamples: passes over each step of repaint.
        seed: of the noise and of random corruptions.
        intensity: scale of the file's intensity, if it is not recognised rightly.
        picture: write before / after / truth as a .png beside each file.
    """
    from lidarsynth.completion import complete_file
    from lidarsynth.metrics.reconstruction import mean_errors
    from lidarsynth.model import load

    pairs = _outputs(_files(scans), out)
    loaded = load(model)
    if method == "conditional":
        loaded.evaluations(method)  # refuses before any scan is read
    tables = []
    for path, target in pairs:
        result = complete_file(loaded, _read(path, intensity), corrupt, method, steps, resamples, seed)
        _write(target, result.image)
        _say_written(target, result.figure() if picture else None)
        tables.append(result.errors)
        if result.errors:
            _print_errors(path.name, result.errors)
    if len(tables) > 1 and tables[0]:
        _print_errors(f"mean of {len(tables)} scans", {k: mean_errors([t[k] for t in tables]) for k in tables[0]})


def upsample(
    scan: Positional[Path],
    out: Path,
    sensor_in: From = None,
    model: str = "default",
    method: Method = "auto",
    steps: int | None = None,
    seed: int = 0,
    intensity: Intensity = "auto",
    picture: bool = True,
) -> None:
    """Make a scan of a sensor with few beams dense. Points outside the model's view are kept as measured.

    Args:
        scan: file of the sparse scan.
        out: file to write.
        sensor_in: sensor that made it: vlp-16, hdl-32e, ..., or a .toml/.json file; recognised if not given.
        model: default, a preset, a folder, or an official .pth.
        method: conditional tells the network what is known; repaint works with any network.
        steps: network steps, default 4 (conditional) or 32 (repaint).
        seed: of the noise.
        intensity: scale of the file's intensity, if it is not recognised rightly.
        picture: write before and after as a .png beside the file.
    """
    from lidarsynth.completion import upsample_file
    from lidarsynth.model import load

    sparse = _read(scan, intensity)
    result = upsample_file(load(model), sparse, sensor_in, method, steps, seed)
    _write(out, result.image if out.suffix == ".npz" else result.points)
    print(f"{scan}: {len(sparse)} points of {result.sensor} became {len(result.points)}")
    _say_written(out, result.figure() if picture else None)


def project(
    scan: Positional[Path],
    out: Path,
    sensor: str | None = None,
    method: Literal["auto", "spherical", "unfolding"] = "auto",
    width: int | None = None,
    seed: int = 0,
    intensity: Intensity = "auto",
    picture: bool = True,
) -> None:
    """Draw a scan as a range image: .npz with range, reflectance, mask and sensor, and a picture.

    Args:
        scan: file of the scan.
        out: .npz to write.
        sensor: a word such as hdl-64e, or a .toml/.json file; recognised if not given.
        method: spherical puts points into rows by elevation, unfolding by ring.
        width: columns, if other than the sensor's.
        seed: not used; every verb takes it.
        intensity: scale of the file's intensity, if it is not recognised rightly.
        picture: write a .png beside the file.
    """
    from lidarsynth.data.recognise import recognise
    from lidarsynth.lidar import projection

    points = _read(scan, intensity)
    if sensor is None:
        sensor, reason = recognise(points, scan)
        if sensor is None:
            raise ValueError(reason)
    image = projection.project(points, sensor, method, width)
    _write(out, image)
    print(f"{scan}: {len(points)} points, {image.sensor.name}, {image.mask.mean():.1%} of {image.shape} pixels filled")
    _say_written(out, _portrait(image) if picture else None)


def info(what: Positional[str] = "default", seed: int = 0) -> None:
    """What a model, a scan file or a preset is.

    Args:
        what: default, a preset, a model folder, an official .pth, or a scan file.
        seed: not used; every verb takes it.
    """
    from lidarsynth.report import describe

    print(describe(what))


def demo(out: Path = Path("demo"), seed: int = 0) -> None:
    """Everything once, offline, on a shipped synthetic scan; ends with the list of what it made.

    Args:
        out: folder to write to.
        seed: of all randomness.
    """
    street = Path(__file__).parent / "data" / "synthetic" / "street.bin"
    scan = out / "street.bin"
    out.mkdir(parents=True, exist_ok=True)
    scan.write_bytes(street.read_bytes())
    project(scan, out / "street.npz")
    generate(4, out / "generated", seed=seed)
    complete([scan], out / "beams.ply", corrupt="beams:4", seed=seed)
    complete([scan], out / "sector.ply", corrupt="sector:90", seed=seed)
    info("default")
    made = sorted(path for path in out.rglob("*") if path.is_file())
    print(f"\n{len(made)} files in {out}/, look at the pictures:")
    for path in made:
        print(f"  {path}")


def data(
    source: Positional[Literal["synthetic", "files"]],
    root: Positional[Path],
    cache: Positional[Path | None] = None,
    sensor: str = "hdl-64e-kitti",
    projection: Literal["auto", "spherical", "unfolding"] = "auto",
    width: int = 1024,
    count: Count = 1000,
    seed: int = 0,
) -> None:
    """Prepare a cache of range images for training; killed at any moment, the same command goes on.

    Args:
        source: synthetic streets, or a folder of scan files.
        root: folder of the files; the cache itself for synthetic streets.
        cache: folder to write.
        sensor: whose images.
        projection: how points become rows.
        width: columns.
        count: synthetic scans.
        seed: of the synthetic streets.
    """
    from lidarsynth.data.sources import cache_files, cache_synthetic

    if source == "files" and cache is None:
        raise ValueError("expected data files ROOT CACHE, found no CACHE")
    folder = cache or root
    if source == "synthetic":
        stored = cache_synthetic(folder, count, sensor, width, seed)
    else:
        stored = cache_files(root, folder, sensor, projection, width)
    for done, total in _bar(stored):
        count = total if done else count
    print(f"wrote {count} images to {folder}/")


def train(
    preset: Positional[str],
    data: Path,
    out: Path,
    weights: From = None,
    set: tuple[str, ...] = (),
    threads: int = 0,
    seed: int = 0,
    dry_run: bool = False,
) -> None:
    """Train a preset on a cache; killed at any moment, the same command goes on where the last checkpoint was.

    Args:
        preset: such as default, r2dm-h, tiny.
        data: cache folder of `lidarsynth data`.
        out: folder for weights and state.
        weights: start from these weights.
        set: fields of the experiment to change, such as training.steps=1000.
        threads: of the processor, 0 = all.
        seed: of weights, order and noise.
        dry_run: print the resolved experiment and stop.
    """
    from lidarsynth.training.run import resolve, run

    experiment = resolve(preset, set, seed)
    if dry_run:
        print(json.dumps(asdict(experiment), indent=1))
        return
    for line in run(experiment, data, out, weights, threads):
        print(line, flush=True)
    print(f"wrote {out}/")


def _read(path: Path, intensity: str) -> Scan:
    from lidarsynth.data.files import read_with_report

    scan, dropped = read_with_report(path, intensity)
    if dropped:
        print(f"{path}: {dropped} points without a return or not finite were dropped, {len(scan)} stay")
    return scan


def _write(path: Path, scan: Scan | RangeImage) -> None:
    from lidarsynth.data.files import write

    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, scan)


def _say_written(path: Path, figure) -> None:
    from lidarsynth.lidar.render import save_png

    print(f"wrote {path}" if figure is None else f"wrote {path} and {save_png(path.with_suffix('.png'), figure)}")


def _portrait(image: RangeImage):
    from lidarsynth.lidar.figure import panel
    from lidarsynth.lidar.perspective import perspective
    from lidarsynth.lidar.render import range_strip, reflectance_strip

    return panel([[("range", range_strip(image))], [("reflectance", reflectance_strip(image))],
                  [("points", perspective(image, size=(1024, 576)))]])  # fmt: skip


def _print_errors(title: str, errors: dict[str, Errors]) -> None:
    print(f"{title}: error of the hidden pixels ({next(iter(errors.values())).pixels})")
    print(f"  {'method':<12}{'range MAE':>11}{'reflectance MAE':>18}")
    for name, error in errors.items():
        print(f"  {name:<12}{error.range_mae:>9.3f} m{error.reflectance_mae:>18.4f}")


def _files(scans: list[Path]) -> list[Path]:
    if len(scans) == 1 and scans[0].is_dir():
        from lidarsynth.data.sources import scan_files

        return scan_files(scans[0])
    return scans


def _outputs(scans: list[Path], out: Path) -> list[tuple[Path, Path]]:
    """Each scan with the file to write: `out` itself, or out/NAME.ply when there are several."""
    if len(scans) == 1 and out.suffix:
        return [(scans[0], out)]
    names = [path.name.split(".")[0] for path in scans]
    if len(set(names)) < len(names):
        raise ValueError(f"expected scans of different names to write into {out}/, found two of one name")
    return [(path, out / f"{name}.ply") for path, name in zip(scans, names, strict=True)]


def _same_settings(out: Path, settings: dict) -> None:
    """Begin or go on with a folder of generated scans; refuse one that was made otherwise."""
    record = out / "generate.json"
    if record.exists():
        found = json.loads(record.read_text())
        if found != settings:
            raise ValueError(f"{out}: expected a folder made with {settings}, found one made with {found}")
        return
    out.mkdir(parents=True, exist_ok=True)
    scratch = record.with_suffix(".tmp")
    scratch.write_text(json.dumps(settings))
    os.replace(scratch, record)


def _bar(stored):
    """Pass (done, total) pairs on, under a progress bar."""
    from tqdm import tqdm

    with tqdm(unit="image", delay=2) as bar:
        for done, total in stored:
            bar.total = total
            bar.update(done - bar.n)
            yield done, total


VERBS = {
    "demo": demo,
    "generate": generate,
    "complete": complete,
    "upsample": upsample,
    "project": project,
    "data": data,
    "train": train,
    "info": info,
}


def main(argv: list[str] | None = None) -> None:
    """Run one verb: exits 0, or 2 with one line that says what was expected and what was found."""
    try:
        tyro.extras.subcommand_cli_from_dict(
            VERBS, prog="lidarsynth", description=__doc__ and "Generate, complete and judge LiDAR scans.", args=argv
        )
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        line = " ".join(str(error).split())
        print(f"lidarsynth: {line or type(error).__name__}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("lidarsynth: stopped; the same command goes on", file=sys.stderr)
        sys.exit(130)
