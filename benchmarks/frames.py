"""Which moved, tilted and turned scans `check_frame` finds, which of them its transform brings back, and which sensors
are recognised: with the rings that the files have, without, and with the points in any order too.

python benchmarks/frames.py scans/              files, folders, globs, bags, captures, each in its sensor's frame
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lidarsynth.lidar.frame import AXES, check_frame, parse_transform, transformed
from lidarsynth.lidar.recognition import recognise
from lidarsynth.lidar.scan import Scan
from lidarsynth.verbs.inputs import inputs_of

BACK = 0.6  # metres that the middle point may be off: what `check_frame` leaves uncorrected
MOVES = {
    "as it is": "0:0:0:0:0:0",
    "raised 1.73 m": "0:0:1.73:0:0:0",
    "lowered 1 m": "0:0:-1:0:0:0",
    "pitched 5": "0:0:0:0:5:0",
    "rolled 5": "0:0:0:5:0:0",
    "raised, pitched and rolled": "0:0:1.73:-3:4:0",
    "upside down": "0:0:0:180:0:0",
    "camera axes": "-y",
    "turned 90": "0:0:0:0:0:90",
}


def matrix_of(move: str) -> np.ndarray:
    """(4, 4) of a move: x:y:z:roll:pitch:yaw, or the axis of the file that shall be up."""
    if move not in AXES:
        return parse_transform(move)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(AXES[move][0]).T
    return matrix


def kinds(scan: Scan) -> Iterator[tuple[str, Scan]]:
    bare = replace(scan, ring=None)
    yield "as read", scan
    yield "no ring field", bare
    yield "any order", bare[np.random.default_rng(0).permutation(len(scan))]


def judged(scan: Scan, move: str) -> tuple[bool, bool]:
    """Whether a warning says that something is wrong, and whether its transform brings the points back."""
    there = transformed(scan.xyz, matrix_of(MOVES[move]))
    frame = check_frame(replace(scan, xyz=there))
    away = np.linalg.norm(transformed(there, frame.transform) - scan.xyz, axis=1)
    return bool(frame.faults) or (move == "turned 90" and bool(frame.hints)), float(np.median(away)) < BACK


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", nargs="+", type=Path)
    warned: Counter[tuple[str, str]] = Counter()
    undone: Counter[tuple[str, str]] = Counter()
    sensors: Counter[tuple[str, str]] = Counter()
    for item in inputs_of(parser.parse_args().scans).stream():
        for kind, scan in kinds(item.read().scan):
            sensors[kind, recognise(scan)[0] or "none"] += 1
            for move in MOVES:
                found, back = judged(scan, move)
                warned[kind, move] += found
                undone[kind, move] += found and back
    names = list(dict.fromkeys(kind for kind, _ in sensors))
    print("| move | " + " | ".join(names) + " |\n|---" + "|---" * len(names) + "|")
    for move in MOVES:
        cells = [f"{warned[kind, move]} warned, {undone[kind, move]} brought back" for kind in names]
        print(f"| {move} | " + " | ".join(cells) + " |")
    for kind in names:
        print(f"{kind}: " + ", ".join(f"{name} {count}" for (k, name), count in sensors.items() if k == kind))


if __name__ == "__main__":
    main()
