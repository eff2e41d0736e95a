"""What a scan measured, beside an image of it: all of its points, and the new ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarsynth.lidar.marks import MARKS, confidences, marks_of, were_new
from lidarsynth.lidar.projection import Pixels
from lidarsynth.lidar.recognition import elevations_of
from lidarsynth.lidar.scan import RangeImage, Scan


def with_measured(scan: Scan, measured: np.ndarray, filled: RangeImage, pixels: Pixels) -> Scan:
    """Every point of the scan bit by bit, and the pixels of `filled` outside `measured` (H, W) bool as new points.

    pixels  of the scan's points in the image

    Points come row by row, each row from behind over the left; `ring` is the row. Those above or below the view come
    last, with the ring of the first or last row. A scan without reflectance takes that of its pixels. Every further
    field of the scan stays with its points, so do its rings where they are not the rows; new ones have 0 there, the
    label of their pixel, and the time of the points measured in their direction. Labels of a filled image are those of
    measured points too, where the scan has none. `extra["new"]` is 1 for new points, and for those that were new in
    the scan; where the image has `confidence`, measured points have 1, those what they had.
    """
    new = replace(filled, mask=filled.mask & ~measured).to_scan()
    row, column = pixels
    reflectance, label = scan.reflectance, scan.label
    if not reflectance.any():
        reflectance = np.where(row >= 0, filled.reflectance[row, column], reflectance)
    if label is None and filled.label is not None:
        label = np.where(row >= 0, filled.label[row, column], 0)
    assert new.ring is not None
    xyz = np.concatenate([scan.xyz, new.xyz])
    ends = np.where(elevations_of(scan.xyz) > np.mean(filled.sensor.elevations), 0, filled.sensor.height - 1)
    own = np.where(row < 0, ends, row)
    ring, place = (np.concatenate([part, new.ring]) for part in (own, np.where(row < 0, filled.sensor.height, row)))
    azimuth = np.arctan2(xyz[:, 1], xyz[:, 0]).astype(np.float64)
    order = np.argsort(10.0 * place - azimuth, kind="stable")  # by ring, then azimuth: a turn is less than 10
    both = Scan(
        xyz,
        np.concatenate([reflectance, new.reflectance]),
        ring=ring,
        time=None if scan.time is None else np.concatenate([scan.time, _time_towards(new.xyz, scan)]),
        label=_labels(label, new),
        extra={name: np.concatenate([values, np.zeros(len(new), values.dtype)])
               for name, values in _kept(scan, own).items()}
        | {"new": np.concatenate([were_new(scan), np.ones(len(new), np.uint8)])}
        | {name: np.concatenate([confidences(scan), values])
           for name, values in new.extra.items() if name == "confidence"},
    )  # fmt: skip
    return both[order]


def _kept(scan: Scan, row: np.ndarray) -> dict[str, np.ndarray]:
    """The further fields of a scan, and its rings where they are not the rows and no field has them as they were. What
    bears the name of a mark and is none is something else of the file's."""
    said = scan.ring is not None and not {"ring", "file_ring"} & set(scan.extra) and (scan.ring != row).any()
    theirs, kept = set(MARKS) - marks_of(scan).keys(), {}
    for name, values in scan.extra.items():
        word = f"file_{name}" if name in theirs else name
        while word != name and word in scan.extra:
            word = f"file_{word}"
        kept[word] = values
    return {**kept, **({"ring": scan.ring} if said else {})}  # type: ignore[dict-item]


def _time_towards(xyz: np.ndarray, scan: Scan) -> np.ndarray:
    """(N,) the time of the measured point nearest in azimuth to each of `xyz`: a spinning sensor looks there then."""
    assert scan.time is not None
    azimuth = np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0])
    order = np.argsort(azimuth)
    place = np.searchsorted(azimuth[order], np.arctan2(xyz[:, 1], xyz[:, 0])).clip(0, len(order) - 1)
    return scan.time[order[place]]


def _labels(measured: np.ndarray | None, new: Scan) -> np.ndarray | None:
    if measured is None:
        return None
    return np.concatenate([measured, np.zeros(len(new), measured.dtype) if new.label is None else new.label])
