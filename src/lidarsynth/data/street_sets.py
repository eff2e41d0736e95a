"""Writing labelled streets as a data set that others' tools read; stopped at any moment, the same call goes on.

A frame is there when its JSON is, which is written last, and its files are as long as the JSON says; every file appears
whole or not at all. `streets.json` says what the set was made with, and the tables of the layout are written when all
frames are there. A set never shrinks.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from lidarsynth.data.index import resumable_file, short
from lidarsynth.data.layouts.kitti import KITTI
from lidarsynth.data.layouts.layout import Layout, points_told
from lidarsynth.data.layouts.nuscenes import NUSCENES
from lidarsynth.data.layouts.pcd import PCD
from lidarsynth.data.layouts.semantickitti import SEMANTICKITTI
from lidarsynth.data.workers import in_order
from lidarsynth.files.lock import only_writer
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.whole_file import sweep
from lidarsynth.pictures.figure import panel
from lidarsynth.streets.areas import MORE, TODAY
from lidarsynth.streets.drawing import bev_with_boxes, strips
from lidarsynth.streets.edition import EDITION
from lidarsynth.streets.frame import LabelledStreets, Options
from lidarsynth.streets.world import POSES

LAYOUTS: dict[str, Layout] = {
    "semantickitti": SEMANTICKITTI,
    "kitti": KITTI,
    "nuscenes": NUSCENES,
    "pcd": PCD,
}
RECORD = "streets.json"
CHUNK = 16  # frames that one process makes in a row, at most; they share their world


def write_streets(folder: Path, streets: LabelledStreets, layout: str, workers: int = 0) -> Iterator[int]:
    """Store all frames and yield how many are there, then the tables; of as many as the folder has, if it has more.

    layout   a word of LAYOUTS
    workers  processes; with fewer than two this one works itself
    Raises ValueError where the folder holds another set or something else, or another process writes to it, OSError of
    one line when the disk is full.
    """
    streets.check_drives()
    with only_writer(folder, "making of streets"):
        yield from _write(folder, streets, layout, workers)


def _write(folder: Path, streets: LabelledStreets, layout: str, workers: int) -> Iterator[int]:
    begun = _claim(folder, _settings(streets, layout))
    try:
        yield from _frames(folder, streets, layout, workers)
    except Exception:
        if begun and not _holds_more(folder):
            (folder / RECORD).unlink(missing_ok=True)
        raise


def _frames(folder: Path, streets: LabelledStreets, layout: str, workers: int) -> Iterator[int]:
    sweep(folder, deep=True)
    streets = with_those_there(folder, streets, layout)
    task = _Task(folder, streets, layout)
    there = task.there()
    done = len(there)
    yield done
    written = in_order(task.store, chunks(streets, there), workers)
    try:
        for count in written:
            done += count
            yield done
    finally:
        written.close()
        sweep(folder, deep=True)  # a killed worker's
    for path, content in LAYOUTS[layout].tables(streets, folder):
        _put(folder / path, content)


def with_those_there(folder: Path, streets: LabelledStreets, layout: str) -> LabelledStreets:
    """The streets with as many scans, or drives, as the folder has whole, where these are more than asked for."""
    of, frames = LAYOUTS[layout], max(streets.options.frames, 1)
    there = Counter(index // frames for index in {of.index(streets, path) for path in folder.glob(of.records)})
    for number in sorted((n for n, found in there.items() if n >= streets.count and found == frames), reverse=True):
        names = [of.record(streets, index) for index in range(number * frames, (number + 1) * frames)]
        if all(points_told(folder / name) is not None for name in names):  # and not somebody's own numbered JSON
            return LabelledStreets(streets.seed, number + 1, streets.sensor, streets.options)
    return streets


def chunks(streets: LabelledStreets, there: Iterable[int]) -> Iterator[list[int]]:
    """The frames that are not `there`, in runs of one world, each told when it is asked for: sets may be huge."""
    there, world = set(there), streets.options.frames or POSES
    for first in range(0, len(streets), world):
        last = min(first + world, len(streets))
        for start in range(first, last, CHUNK):
            if run := [index for index in range(start, min(start + CHUNK, last)) if index not in there]:
                yield run


class _Task:
    """What a worker has to know to make any chunk."""

    def __init__(self, folder: Path, streets: LabelledStreets, layout: str):
        self.folder, self.streets, self.layout = folder, streets, layout

    def there(self) -> list[int]:
        """Frames that have all their files, none of them cut off."""
        layout = LAYOUTS[self.layout]
        told = {layout.index(self.streets, path) for path in self.folder.glob(layout.records)}
        asked = sorted(index for index in told if 0 <= index < len(self.streets))
        return [index for index in asked if layout.has(self.folder, self.streets, index)]

    def store(self, chunk: list[int]) -> int:
        """Make the frames of a chunk; returns their number."""
        layout = LAYOUTS[self.layout]
        for index in chunk:
            frame = self.streets[index]
            if not len(frame.scan):
                raise ValueError(f"{self.streets.sensor.name}: expected a sensor that sees something from every place, "
                                 f"found no return of any beam in scan {index}")  # fmt: skip
            for path, content in layout.files(self.streets, index, frame):
                _put(self.folder / path, content)
            _put(self.folder / layout.record(self.streets, index), json.dumps(frame.record()).encode())
        return len(chunk)


def _settings(streets: LabelledStreets, layout: str) -> dict[str, Any]:
    options = asdict(streets.options)
    later: dict[str, Any] = {"perfect": False, "inside": False, "overlap": True, "kerbs": 1, "rough": 1}
    later |= dict.fromkeys(MORE, 0)
    for of in (options, options["density"], options["optics"]):
        for name in later.keys() & of.keys():
            if of[name] == later[name]:
                del of[name]  # a set of before there was this choice goes on
    asked = {"layout": layout, "seed": streets.seed, "sensor": streets.sensor.to_dict(), "options": options}
    return asked | {"edition": _edition(streets.options, layout)}


def _edition(options: Options, layout: str) -> int:
    """EDITION, or one more where 2026-11-25 brought boxes that stand where seen, cyclists who roll off kerbs, or no
    vehicles in car parks, one where label_2 lists what the camera sees alone, and two where everyone is set apart since
    2026-11-28, and stands in no wall and goes through none since 2026-11-29: other sets go on."""
    drives = options.frames > 0 and (options.deskewed or options.density.cyclists > 0)
    apart = options.frames > 0 or options.density != TODAY or not options.overlap
    return EDITION + (drives or options.density.parking == 0) + (layout == "kitti") + 2 * apart


def _claim(folder: Path, settings: dict[str, Any]) -> bool:
    """Begin a folder, and say so, or go on with one that was begun with the same settings; scans may grow in number.

    What a stopped command has begun, and nothing was written to since, is begun anew.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: expected a folder to write to, found a file")
    settings, path = json.loads(json.dumps(settings)), folder / RECORD
    if path.exists():
        found = read_json(path)
        if found == settings:
            return False
        if _holds_more(folder):
            asked, was = _differing(settings, found), _differing(found, settings)
            raise ValueError(f"{folder}: expected a folder of streets made with {_told(asked)}, found {_told(was)}; "
                             "use another --out")  # fmt: skip
    elif folder.exists() and _holds_more(folder):  # folders alone are of a disk that was full at the first file
        raise ValueError(f"{folder}: expected an empty folder, or one with {RECORD}; use another --out")
    folder.mkdir(parents=True, exist_ok=True)
    _put(path, (json.dumps(settings, indent=1) + "\n").encode())
    return True


def _holds_more(folder: Path) -> bool:
    """Whether there is a file beside the record, hidden ones aside."""
    files = (entry for entry in folder.rglob("*") if entry.is_file() and not entry.name.startswith("."))
    return any(entry != folder / RECORD for entry in files)


def _told(settings: dict[str, Any]) -> str:
    """Settings in a message; of a sensor its name, where that differs."""
    sensor = settings.get("sensor")
    if isinstance(sensor, dict):
        settings = settings | {"sensor": sensor["name"]} if "name" in sensor else settings | sensor
    return "{" + ", ".join(f"{key} {short(value)}" for key, value in settings.items() if value is not sensor) + "}"


def _differing(these: Any, those: Any) -> Any:
    """What of these settings is otherwise in those, None where they have none, without what is equal."""
    if not (isinstance(these, dict) and isinstance(those, dict)):
        return these
    keys = [key for key in (these | those) if key not in those or key not in these or these[key] != those[key]]
    return {key: _differing(these.get(key), those.get(key)) for key in keys}


def _put(path: Path, content: bytes | BinaryIO) -> None:
    """The file, whole or not at all. Raises OSError of one line."""
    source = BytesIO(content) if isinstance(content, bytes) else content
    size = source.seek(0, 2)
    source.seek(0)
    path.parent.mkdir(parents=True, exist_ok=True)
    with resumable_file(path, size) as scratch, open(scratch, "wb") as file:
        shutil.copyfileobj(source, file)


def overview(streets: LabelledStreets) -> np.ndarray:
    """(H, W, 3) uint8: up to four frames of the set from above with their boxes, and one as strips."""
    chosen = sorted({len(streets) * k // 4 for k in range(4)})
    frames = [streets[index] for index in chosen]
    views = [(f"frame {index}", bev_with_boxes(frame)) for index, frame in zip(chosen, frames, strict=True)]
    rows = [views[:2], views[2:]] if len(views) == 4 else [views]  # in rows of one number all are of one size
    return panel([*rows, [("range and class of the first", strips(frames[0], streets.sensor))]])
