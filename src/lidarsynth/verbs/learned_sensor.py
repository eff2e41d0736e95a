"""What the verb `sensor` does: learn a sensor from scans, as a `.toml` that every verb takes, and how sure it is."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from lidarsynth.data.ouster import is_metadata, read_metadata, sensor_of
from lidarsynth.lidar.blocked import SCANS
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.learning import FEWEST, NEAR, SMEARED, LearnedSensor, learn_sensor
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.recognition import FAR
from lidarsynth.lidar.scan import Scan, with_points
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.verbs.inputs import Input, Inputs

T = TypeVar("T")
LOOKED_AT = 3  # scans, for the frame they are in
FARTHEST = 1000.0  # metres: no spinning sensor has returns from beyond
STRAY = 0.02  # of the points: so many beyond all beams are of others
ENOUGH = 100  # scans: more change nothing that a thousandth of a degree shows


def learn(inputs: Inputs, name: str, broken: list[str] | None = None, moved: list[str] | None = None) -> LearnedSensor:
    """The sensor of at most ENOUGH of the inputs, evenly chosen. Those that cannot be read are left out, and why is
    added to `broken`; where none can be, ValueError. In which other frame one of the first LOOKED_AT is, is added to
    `moved`."""
    told = [] if broken is None else broken, [] if moved is None else moved
    if inputs.count is None:
        return learn_sensor(_readable(spread(inputs.stream(), ENOUGH), *told), name)
    every = max(-(-inputs.count // ENOUGH), 1)
    return learn_sensor(_readable(islice(inputs.stream(), 0, None, every), *told), name)


def spread(items: Iterable[T], most: int) -> list[T]:
    """At most `most` items of a stream of unknown length, evenly chosen: every first, second, fourth or 2^k-th, of
    which half as many or more are kept. No more than `most` + 1 are held at a time."""
    kept, every = [], 1
    for number, item in enumerate(items):
        if number % every == 0:
            kept.append(item)
        if len(kept) > most:
            kept, every = kept[::2], 2 * every
    return kept


def from_metadata(path: Path, name: str) -> Sensor | None:
    """The sensor of an Ouster metadata file, or None where it is something else."""
    return sensor_of(read_metadata(path), name) if is_metadata(path) else None


def _readable(inputs: Iterable[Input], broken: list[str], moved: list[str]) -> Iterator[Scan]:
    read = 0
    for item in inputs:
        try:
            scan = with_points(item.read().scan, str(item.path))
        except ValueError as error:
            broken.append(str(error))
            continue
        if read < LOOKED_AT and (frame := check_frame(scan)).faults:
            moved.append(f"{item.path}: {frame.warning()}")
        read += 1
        yield scan
    if broken and not read:
        raise ValueError(broken[0])


def write_toml(path: Path, text: str) -> None:
    """The text as a file, whole or not at all, in a folder that is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, text)


def sensor_toml(sensor: Sensor, comments: Sequence[str] = ()) -> str:
    """A sensor file as `read_sensor` reads it, whatever the name holds."""
    said = ("".join(c if c.isprintable() else "?" for c in comment) for comment in comments)
    name = json.dumps(sensor.name.encode("utf-8", "replace").decode(), ensure_ascii=False).replace("\x7f", "\\u007f")
    lines = [*(f"# {comment}" for comment in said), f"name = {name}"]
    numbers = sensor.to_dict()
    for key in ("width", "min_range", "max_range", "mount"):
        lines.append(f"{key} = {numbers[key]}")
    lines.append(f"tilt = [{', '.join(map(str, sensor.tilt))}]  # degrees: nose up, left side up, against the road")
    lines.append(_listed("elevations", [f"{e:.3f}" for e in sensor.elevations]))
    if sensor.offsets:
        lines.append(_listed("offsets", [f"{h:.3f}" for h in sensor.offsets]))
    if sensor.blocked:
        lines.append(_listed("blocked", [f"[{row}, {first}, {last}]" for row, first, last in sensor.blocked]))
    return "\n".join(lines) + "\n"


def _listed(key: str, words: list[str]) -> str:
    rows = [", ".join(words[i : i + 8]) for i in range(0, len(words), 8)]
    return f"{key} = [\n  " + ",\n  ".join(rows) + ",\n]"


def summary(learned: LearnedSensor) -> str:
    """Lines for people: what was found, and how well it fits."""
    sensor = learned.sensor
    residuals = np.array([ring.residual for ring in learned.rings])
    share, (nose, left) = float(sensor.blocked_rays().mean()), sensor.tilt
    top, bottom = sensor.elevations[0], sensor.elevations[-1]
    lines = [
        f"{sensor.name}: {plural(sensor.height, 'beam')} from {top:+.2f} to {bottom:+.2f} degrees, "
        f"{sensor.width} columns, {sensor.min_range:g} to {sensor.max_range:g} m",
        f"  points lie {np.median(residuals):.4f} degrees off their beams (median), {residuals.max():.4f} (worst beam)",
        "  how far above the ground is not known"
        if learned.afloat
        else f"  {sensor.mount:g} m above the ground, nose {nose:+.1f} and left side {left:+.1f} degrees up",
        f"  blocked by its carrier, or out of its view: {share:.1%} of the rays"
        if sensor.blocked
        else "  nothing seen to be blocked"
        if learned.scans >= SCANS
        else f"  what is blocked is not known: {SCANS} scans of several places or more tell it",
        f"  from {plural(learned.scans, 'scan')}" + (f"; left out: {', '.join(learned.left)}" if learned.left else ""),
    ]
    return "\n".join(lines)


def doubts(learned: LearnedSensor) -> list[str]:
    """Why beams, columns or mount are not to be trusted, a line each: points more than SMEARED degrees off some, rings
    of few points or none, scans of several sensors, no ground, uneven steps, scans of several turns, beams of several
    rings."""
    name, known = learned.sensor.name, len(learned.rings)
    smeared = sum(ring.residual > SMEARED for ring in learned.rings)
    found = []
    if smeared:
        found.append(
            f"{name}: expected points within {SMEARED} degrees of their beams, found {smeared} of {known} beams wider: "
            "its elevations may be off; give scans with rings, as the sensor sent them, or name the sensor"
        )
    if learned.unused:
        last = known + learned.missing + learned.merged - 1
        found.append(
            f"{name}: expected points in each of the rings 0 to {last}, found none in {learned.unused}, which are left "
            "out: rightly, where rings count from 1 or leave numbers out; else give scans in which their beams meet "
            "something"
        )
    if few := learned.missing - learned.unused + learned.thin:
        kept = f" of the fit, {learned.thin} with their few points as rows" if learned.thin else ""
        found.append(
            f"{name}: expected {FEWEST} points beyond {NEAR:g} m in each of {few + known - learned.thin} rings, found "
            f"fewer in {few}, which are left out{kept}: give scans of wider places, or more of them"
        )
    if learned.beyond > STRAY:
        found.append(f"{name}: expected points on beams that elevations show, found {learned.beyond:.0%} above or "
                     f"below all {known} of them, of beams that see nothing beyond {FAR:g} m: give scans with "
                     "rings")  # fmt: skip
    if learned.split:
        found.append(f"{name}: {learned.split}")
    if learned.afloat:
        found.append(f"{name}: {learned.afloat}: mount and tilt are not learned, {learned.sensor.mount:g} m and level "
                     "are written: set them in the file")  # fmt: skip
    if learned.sensor.max_range > FARTHEST:
        found.append(f"{name}: expected points within {FARTHEST:g} m, found some to {learned.sensor.max_range:g} m: "
                     "stray ones, or no metres: set max_range in the file, or give points in metres")  # fmt: skip
    if learned.uneven and not learned.turns:
        found.append(f"{name}: expected points whole columns apart, found other steps, as of points left out at random "
                     f"or of noise: {learned.sensor.width} columns are a guess: give whole scans, or set them in the "
                     "file")  # fmt: skip
    took = f"{plural(learned.merged, 'ring')} {'is' if learned.merged == 1 else 'are'} taken as one beam with another"
    if learned.turns:
        found.append(f"{name}: {learned.turns} ({took if learned.merged else 'its columns may be too many'})")
    elif learned.merged:
        found.append(f"{name}: expected each beam in one ring, found its points in two (twice in the file?): {took}")
    return found
