"""Damaged files without end: every reader and every file of settings, by a seeded mutator.

    python tests/fuzz.py --minutes 10 --seed 3        or: make fuzz MINUTES=10 SEED=3
    python tests/fuzz.py --case 3:1234                that case alone, with its traceback

Whatever a file holds, a reader answers within ten seconds of the processor: with content, or with one line. A case
`seed:number` is the same on every machine that has the same extras.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import random
import shutil
import signal
import sys
import tarfile
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import numpy as np
import torch
from test_captures import pcap, pcapng, udp, velodyne_packet

from lidarsynth.benchmark.config import read_config
from lidarsynth.benchmark.store import Seconds, Store
from lidarsynth.data.bag_errors import naming
from lidarsynth.data.bag_records import Cloud
from lidarsynth.data.bag_writer import write_bag
from lidarsynth.data.bags import open_bag
from lidarsynth.data.dataset import CachedImages, write_cache
from lidarsynth.data.ouster import read_metadata, sensor_of
from lidarsynth.data.street_sets import _claim, _settings
from lidarsynth.data.turns import capture_turns
from lidarsynth.evaluation.image_sets import as_image, image_set
from lidarsynth.evaluation.protocols import BEV_1
from lidarsynth.evaluation.statistics import Statistics, load_statistics, save_statistics
from lidarsynth.experiment.folder import read_experiment, save
from lidarsynth.experiment.presets import preset
from lidarsynth.files.formats import WRITERS, read, write
from lidarsynth.files.labels import read_labels
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import SENSORS, read_sensor
from lidarsynth.networks.minkowski_unet import MinkowskiUNet, widths_of
from lidarsynth.networks.rangenet_archive import read_rangenet
from lidarsynth.networks.sparse_weights import read_sparse
from lidarsynth.streets.frame import LabelledStreets
from lidarsynth.systems.table import build_network, load_folder
from lidarsynth.verbs.generation import claim
from lidarsynth.weights.official import read_official

SECONDS = 10  # of the processor that one file may take
WAITING = 60  # seconds by the clock, for what waits without computing; a crowded machine needs them
HANDLED = (ValueError, OSError, ImportError, MemoryError, RecursionError)  # what the command line says in one line
SENSOR = SENSORS["hdl-64e"].resized(8, 32)


class Target(NamedTuple):
    """A whole folder, the file in it that is damaged, and what reads it."""

    folder: Path
    file: str
    read: Callable[[Path], object]


class Hang(BaseException):
    """The time of one file is over."""


def targets(home: Path) -> dict[str, Target]:
    """Every kind of file that is read, written once as it should be."""
    found: dict[str, Target] = {}

    def add(name: str, file: str, make: Callable[[Path], object], read: Callable[[Path], object]) -> None:
        folder = home / name
        folder.mkdir(parents=True)
        try:
            make(folder / file)
        except ImportError:  # without an extra its files cannot be written, and not be read either
            return
        found[name] = Target(folder, file, read)

    scan = _scan()
    for ending in WRITERS:
        add(ending[1:], f"a{ending}", lambda path: write(path, scan), read)
    for ending, make in OTHERS.items():
        add(ending[1:], f"a{ending}", make, read)
    add("bag", "a.bag", _bag, _messages)
    add("mcap", "a.mcap", _bag, _messages)
    add("pcap", "a.pcap", lambda path: path.write_bytes(pcap(_packets())), lambda path: next(capture_turns(path), None))
    add("pcapng", "a.pcapng", lambda p: p.write_bytes(pcapng(_packets())), lambda path: next(capture_turns(path), None))
    add("ouster", "a.json", lambda path: path.write_text(json.dumps(OUSTER)), lambda p: sensor_of(read_metadata(p)))
    add("streets", "streets.json", _streets, _streets)
    add("store", "000000.json", lambda path: Store(path.parent).put(0, _image(), Seconds(1, 2), "a"), _stored)
    add("image", "a.npz", lambda path: write(path, _image()), lambda path: [*map(image_set(path).item, [0])])
    add(
        "label", "a.label", lambda path: np.arange(50, dtype=np.uint32).tofile(path), lambda path: read_labels(path, 50)
    )
    add("sensor-toml", "a.toml", lambda p: p.write_text('name = "a"\nbeams = 8\ntop = 3\nbottom = -25\n'), read_sensor)
    add("sensor-json", "a.json", lambda path: path.write_text(json.dumps(SENSOR.to_dict())), read_sensor)
    add("benchmark", "a.toml", _benchmark, lambda path: read_config("upsampling", path))
    add(
        "samples",
        "a.pth",
        lambda p: torch.save(torch.ones(5, 8, 32), p),
        lambda p: as_image(image_set(p).item(0), SENSOR, "auto"),
    )
    add("cache", "index.json", lambda path: _cache(path.parent), lambda path: CachedImages(path.parent)[0])
    add(
        "statistics",
        "a.safetensors",
        lambda p: save_statistics(p, Statistics(BEV_1, SENSOR, "real")),
        lambda p: load_statistics(p),
    )
    add("experiment", "experiment.json", lambda path: _model(path.parent), lambda path: _small(path.parent))
    add("weights", "model.safetensors", lambda path: _model(path.parent), lambda path: load_folder(path.parent))
    add("official", "a.pth", _official, read_official)
    add("sparse", "model.ckpt", _sparse, lambda path: read_sparse(path, "minkowskinet"))
    add("archive", "a.tar.gz", _archive, read_rangenet)
    add(
        "generate",
        "generate.json",
        lambda path: path.write_text('{"seed": 1, "steps": 2}'),
        lambda path: claim(path.parent, {}),
    )
    return found


def _scan() -> Scan:
    rng = np.random.default_rng(0)
    return Scan(rng.uniform(-20, 20, (50, 3)).astype(np.float32), rng.random(50).astype(np.float32))


def _las(path: Path) -> None:
    import laspy

    file = laspy.create(point_format=3, file_version="1.2")
    file.x, file.y, file.z = _scan().xyz.T
    file.intensity = (_scan().reflectance * 65535).astype(np.uint16)
    file.write(str(path))


def _feather(path: Path) -> None:
    import pyarrow as pa
    from pyarrow import feather

    columns = dict(zip(("x", "y", "z", "intensity"), (*_scan().xyz.T, _scan().reflectance), strict=True))
    feather.write_feather(pa.table(columns), str(path))


def _e57(path: Path) -> None:
    import pye57

    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw(
        {f"cartesian{axis}": column.astype(float) for axis, column in zip("XYZ", _scan().xyz.T, strict=True)}
    )
    file.close()


def _text(path: Path) -> None:
    np.savetxt(path, np.column_stack([_scan().xyz, _scan().reflectance]), header="x y z intensity", comments="")


OTHERS = {".las": _las, ".laz": _las, ".feather": _feather, ".e57": _e57, ".csv": _text, ".pts": _text}
OUSTER = {
    "beam_altitude_angles": [float(20 - i) for i in range(16)],
    "beam_azimuth_angles": [0.0] * 16,
    "lidar_mode": "512x10",
    "prod_line": "OS-1-16",
}


def _bag(path: Path) -> None:
    scan = _scan()
    fields = dict(zip(("x", "y", "z", "intensity"), (*scan.xyz.T, scan.reflectance), strict=True))
    with write_bag(path) as bag:
        bag.write_cloud("/points", Cloud(10**9, "lidar", 10**9, fields))


def _messages(path: Path) -> None:
    with open_bag(path) as bag, naming(path):
        [*bag.clouds(bag.point_topic())]


def _packets() -> list[bytes]:
    return [udp(velodyne_packet(0x22, 3000 * i, 20, 5000), 2368) for i in range(14)]


def _streets(path: Path) -> None:
    _claim(path.parent, _settings(LabelledStreets(0, 1, SENSOR), "pcd"))


def _stored(path: Path) -> None:
    store = Store(path.parent)
    if not store.lacks({0: "a"}):
        store.seconds(1)


def _image() -> RangeImage:
    rng = np.random.default_rng(1)
    mask = rng.random((8, 32)) < 0.8
    distance = (rng.uniform(2, 60, mask.shape) * mask).astype(np.float32)
    return RangeImage(distance, (rng.random(mask.shape) * mask).astype(np.float32), mask, SENSOR)


def _benchmark(path: Path) -> None:
    path.write_text(
        'data = "set"\nimages = 3\ncorruptions = ["beams:4"]\n[[method]]\nname = "a"\ninterpolation = "nearest"\n'
    )


def _cache(folder: Path) -> None:
    list(write_cache(folder, lambda i: _image(), 3, SENSOR, {"name": "noise"}, lambda i: ("a", "b", str(i))))


def _model(folder: Path) -> None:
    save(folder, preset("tiny"), build_network(preset("tiny")))


def _small(folder: Path) -> None:
    """Build what the record says, where it is no larger than the one that was written."""
    experiment = read_experiment(folder)
    model = experiment.model
    if model.base_channels <= 64 and max(experiment.data.height, experiment.data.width) <= 1024:
        load_folder(folder)


def _official(path: Path) -> None:
    weights = {"model.a": torch.ones(2, 3), "model.b": torch.zeros(2)}
    torch.save({"cfg": {"model": {"base_channels": 8}}, "weights": weights, "ema_weights": weights}, path)


def _sparse(path: Path) -> None:
    torch.save({"state_dict": MinkowskiUNet(widths_of(0.04)).state_dict()}, path)


def _archive(path: Path) -> None:
    config = b"backbone: {OS: 32, input_depth: {range: true, xyz: true, remission: true}, extra: {layers: 21}}\n"
    with tarfile.open(path, "w:gz") as archive:
        for name in ("backbone", "segmentation_decoder", "segmentation_head", "arch_cfg.yaml"):
            member = tarfile.TarInfo(f"net/{name}")
            member.size = len(config)
            archive.addfile(member, io.BytesIO(config))


NUMBERS = (
    "0",
    "-1",
    "1e999",
    "NaN",
    "99999999999999999999999",
    "1.5",
    "true",
    "null",
    '""',
    "[]",
    "{}",
    '"\\u001b[31m"',
)


def damaged(data: bytes, rng: random.Random) -> bytes:
    """The content with one to four random damages."""
    for _ in range(rng.randint(1, 4)):
        data = rng.choice((_flip, _cut, _repeat, _stuff, _swap, _number, _key))(data, rng)
    return data


def _flip(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(rng.randint(1, 8)):
        changed[rng.randrange(len(changed))] = rng.choice((0, 255, 127, 128, rng.randrange(256)))
    return bytes(changed)


def _cut(data: bytes, rng: random.Random) -> bytes:
    a, b = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    return data[:a] + data[b:] if rng.random() < 0.5 else data[a:b]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    a = rng.randrange(len(data) + 1)
    part = data[a : a + rng.randint(1, 40)]
    return data[:a] + part * rng.choice((2, 10, 3000)) + data[a:]


def _stuff(data: bytes, rng: random.Random) -> bytes:
    a = rng.randrange(len(data) + 1)
    return (
        data[:a]
        + rng.choice((b"[" * 5000, b"a." * 9000, b"\x1b[2J\n", b"\xff" * 9, bytes(64), rng.randbytes(30)))
        + data[a:]
    )


def _swap(data: bytes, rng: random.Random) -> bytes:
    a, b, c = sorted(rng.randrange(len(data) + 1) for _ in range(3))
    return data[:a] + data[b:c] + data[a:b] + data[c:]


def _number(data: bytes, rng: random.Random) -> bytes:
    """Another value in the place of a number, where the content is text."""
    digits = [i for i, byte in enumerate(data[:100_000]) if 48 <= byte <= 57]
    if not digits:
        return data
    start = end = rng.choice(digits)
    while end < len(data) and data[end : end + 1] in b"0123456789.e-" and end - start < 30:
        end += 1
    return data[:start] + rng.choice(NUMBERS).encode() + data[end:]


def _key(data: bytes, rng: random.Random) -> bytes:
    """One value of a JSON table replaced by something of another kind."""
    try:
        table = json.loads(data)
    except (ValueError, RecursionError):
        return data
    parent, key = table, None
    while isinstance(parent, dict | list) and parent and rng.random() < 0.9:
        key = rng.choice(list(parent)) if isinstance(parent, dict) else rng.randrange(len(parent))
        if not isinstance(parent[key], dict | list) or rng.random() < 0.3:
            parent[key] = rng.choice((None, -1, 0, 10**30, "x" * 500, [], {}, [[[]]], float("nan"), True, {"a": 1}))
            break
        parent = parent[key]
    return json.dumps(table).encode()


def case(found: dict[str, Target], seed: int, number: int, scratch: Path) -> str:
    """Run one case; the name of its target. Raises what should not have been raised."""
    rng = random.Random(f"{seed}:{number}")
    name = rng.choice(sorted(found))
    target = found[name]
    whole = (target.folder / target.file).read_bytes()
    for path in target.folder.iterdir():
        (scratch / path.name).write_bytes(path.read_bytes())
    (scratch / target.file).write_bytes(damaged(whole, rng))
    there = sorted(path.name for path in scratch.iterdir())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # on a terminal each would be a line or two more
            target.read(scratch / target.file)
    except HANDLED as error:
        if isinstance(error, ValueError) and "\n" in str(error):
            raise AssertionError(f"more than one line: {str(error)!r:.200}") from error
    left = sorted(path.name for path in scratch.iterdir())
    if left != there:
        raise AssertionError(f"files left behind: {set(left) ^ set(there)}")
    for path in scratch.iterdir():
        path.unlink()
    return name


def _alarm(signum: int, frame: FrameType | None) -> None:
    raise Hang(f"more than {SECONDS} s of the processor, or {WAITING} s of waiting")


def run(seed: int, until: Callable[[int], bool], first: int = 0) -> Iterator[tuple[int, str, str]]:
    """Cases `first`, ... of a seed while `until` says so: (number, target, traceback or "")."""
    signal.signal(signal.SIGALRM, _alarm)
    signal.signal(signal.SIGPROF, _alarm)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as home:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            found = targets(Path(home) / "whole")
        for target in found.values():  # whole files first: what is imported late would count as a hang
            with contextlib.suppress(*HANDLED):
                target.read(target.folder / target.file)
        number = first
        while until(number):
            scratch = Path(home) / f"case-{number}"
            scratch.mkdir()
            name, failure = "", ""
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            signal.setitimer(signal.ITIMER_REAL, WAITING)
            try:
                name = case(found, seed, number, scratch)
            except KeyboardInterrupt:
                raise
            except BaseException:
                failure = traceback.format_exc()
            finally:
                signal.setitimer(signal.ITIMER_PROF, 0)
                signal.setitimer(signal.ITIMER_REAL, 0)
            shutil.rmtree(scratch, ignore_errors=True)  # a hundred thousand of them take minutes at the end
            yield number, name, failure
            number += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--case", help="seed:number")
    options = parser.parse_args()
    if options.case:
        seed, number = map(int, options.case.split(":"))
        print(*run(seed, lambda i: i == number, number))
        return
    end, counts, failures = time.monotonic() + 60 * options.minutes, Counter(), 0
    for number, name, failure in run(options.seed, lambda _: time.monotonic() < end):
        counts[name] += 1
        if failure:
            failures += 1
            print(f"case {options.seed}:{number} of seed {options.seed}\n{failure}", flush=True)
    print(f"seed {options.seed}: {sum(counts.values())} cases, {failures} failures; {dict(sorted(counts.items()))}")
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
