"""Notes on sets of images that are read to be judged: what makes their numbers mean something else; one line each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from lidarsynth.evaluation.image_sets import ImageSet, Item, stem_of
from lidarsynth.evaluation.protocol import EvaluationProtocol
from lidarsynth.evaluation.sample_tensors import beams_off, columns_off
from lidarsynth.lidar.beams import same_beams
from lidarsynth.lidar.frame import check_frame
from lidarsynth.lidar.recognition import recognise, same_kind
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import WORDS, Sensor, get_sensor
from lidarsynth.lidar.view import out_of_view
from lidarsynth.streets.hdl64e import own_car

METRES = 1.5  # no outdoor scan ends so near
BEYOND = 0.05  # share of an image's returns outside its sensor's limits, of which a note is made
APART = 0.25  # share of the columns with points beside which none has any: of 111 real scans 0, of half the columns 1
LOOKED_AT = 8  # scans or tensors of a set, at least and from everywhere, whether all are of one sensor
GRID = "R2DM's grid is hdl-64e"
TURNS = {
    "mirrored left to right": lambda image: image[:, ::-1],
    "turned by half a turn": lambda image: np.roll(image, image.shape[1] // 2, axis=1),
    "mirrored front to back": lambda image: np.roll(image[:, ::-1], image.shape[1] // 2, axis=1),
}
# Shares of rays that return: of 18 real scans at most 0.38 where their car is, 0.65 of another car's, and at least 0.73
# where it would be if they were turned.
SEEN, UNSEEN = 0.7, 0.4
Sides = Mapping[str, ImageSet | None]  # what is judged, in words -> its images; None where statistics stand for them


def unlike_pairs(names: Sequence[str], true_names: Sequence[str]) -> tuple[str, ...]:
    """A note where sample i does not have the name of reference i, endings left out."""
    other = [(own, its) for own, its in zip(names, true_names, strict=True) if stem_of(own) != stem_of(its)]
    if not other:
        return ()
    first = " with ".join(other[0])
    return (f"{len(other)} of {len(names)} samples are compared with a reference of another name, first {first}",)


def unlike_sensors(sides: Sides, drawn: Sensor) -> tuple[str, ...]:
    """A note where points, by some scans of each side, are of other sensors than the one whose images they are drawn
    into, or than the other side's; of images their own beams tell."""
    taken = {side: names for side, images in sides.items() if images and (names := _sensors_of(images))}
    known = {name for names in taken.values() for name in names}
    known |= {drawn.name} & WORDS.keys()  # a user's own may be a unit of any of them
    if not taken or all(same_kind(name, min(known)) for name in known):
        return ()
    told = " and ".join(f"{side} of {', '.join(names)}" for side, names in taken.items())
    return (f"the points of {told} are drawn into images of {drawn.name}: other beams",)


def out_of_images(sides: Sides, drawn: Sensor) -> tuple[str, ...]:
    """Notes where points of a side, by some scans, are above or below the view of the sensor whose images they are
    drawn into, or on none of its lowest beams; not of points in another frame, nor where both sensors are known, of
    which `unlike_sensors` tells."""
    notes = []
    for side, images in sides.items():
        scans = [scan for scan in _some(images) if isinstance(scan, Scan)] if images else []
        own = drawn.name not in WORDS
        unknown = [scan for scan in scans if (own or recognise(scan)[0] is None) and not check_frame(scan).faults]
        told = [text for scan in unknown if (text := out_of_view(scan.xyz, drawn))]
        if told and 2 * len(told) > len(scans):
            notes.append(f"expected points of {side} that {drawn.name} sees, whose images they are drawn into, found "
                         f"{told[0]}: other beams (of points on both sides --sensor names theirs)")  # fmt: skip
    return tuple(notes)


def _sensors_of(images: ImageSet) -> list[str]:
    """The sensors of those that are points, of some from everywhere, as recognised."""
    scans = (scan for scan in _some(images) if isinstance(scan, Scan))
    return list(dict.fromkeys(name for scan in scans if (name := recognise(scan)[0])))


def _some(images: ImageSet) -> Iterator[Item]:
    return (images.item(i) for i in _numbers(images))


def _numbers(images: ImageSet) -> range:
    return range(0, len(images), max(1, len(images) // LOOKED_AT))


def tensors_taken(sides: Sides, rays: Sensor, named: str | Sensor | None) -> tuple[str, ...]:
    """Notes where a side, by some from everywhere, has tensors whose rows are other beams than the sensor's they are
    taken for; or, unless a sensor was named for them, which rays those have that hold no points."""
    told = []
    for side, images in sides.items():
        tensors = [t for t in _some(images) if isinstance(t, Tensor) and t.ndim == 3] if images else []
        if off := max((beams_off(tensor, rays) for tensor in tensors if len(tensor) == 5), default=0.0):
            told.append(f"the points of {side}, which are tensors, lie {off:.1f} degrees off the beams of {rays.name}, "
                        f"for whose rows they are taken: --sensor names theirs ({GRID})")  # fmt: skip
        if off := max((columns_off(tensor, rays) for tensor in tensors if len(tensor) == 5), default=0.0):
            told.append(f"the points of {side}, which are tensors, lie {off:.0f} degrees off their columns, which run "
                        "from behind over the left: is x or y negated, or are they exchanged?")  # fmt: skip
        if named is None and any(len(tensor) == 2 for tensor in tensors):
            told.append(f"{side} are tensors without points, taken for the rays of {rays.name}: --sensor names others "
                        f"({GRID})")  # fmt: skip
    return tuple(told)


def unused_sensor(named: str | Sensor | None, images: ImageSet | None, own: Sensor) -> tuple[str, ...]:
    """A note where a sensor was named, and the samples are images, or statistics, that know another of their own; or
    points and tensors that are drawn into the images of a reference that cannot be drawn again.

    own  of the samples, where they are not images
    """
    if named is None:
        return ()
    first, given = images.item(0) if images else None, get_sensor(named)
    own = first.sensor if isinstance(first, RangeImage) else own
    if given.height % own.height == 0 and same_beams(given.resized(own.height, own.width), own):
        return ()
    drawn = images is not None and not isinstance(first, RangeImage)
    why = f"are drawn into the reference's images, of {own.name}" if drawn else f"know their own sensor, {own.name}"
    word = named.name if isinstance(named, Sensor) else named
    return (f"the samples {why}: {word}, named for points and tensors, is not used",)


def unlike_metres(sides: Sides) -> tuple[str, ...]:
    """A note where the images or points of a side, by the first and the last, have ranges as they come out of a
    network, or images beyond the limits of their own sensor."""
    notes = []
    for side, images in sides.items():
        taken = [images.item(i) for i in {0, len(images) - 1}] if images else []
        some = [item for item in taken if isinstance(item, RangeImage) and item.mask.any()]
        farthest = max(map(_farthest, taken), default=0)
        beyond = max(map(_beyond, some), default=0)
        if 0 < farthest <= METRES:
            notes.append(f"ranges of {side} are {farthest:.2f} m at most: expected metres, not shares of a limit")
        elif beyond > BEYOND:
            sensor = some[0].sensor
            notes.append(f"{beyond:.0%} of the returns of {side} are outside {sensor.min_range:g} to "
                         f"{sensor.max_range:g} m, the limits of {sensor.name}: expected metres")  # fmt: skip
    return tuple(notes)


def _farthest(item: Item) -> float:
    """The largest range of an image or of points; 0 of what has none, and of tensors, which tell their code."""
    if isinstance(item, RangeImage):
        return float(item.range[item.mask].max(initial=0))
    return float(np.linalg.norm(item.xyz, axis=1).max(initial=0)) if isinstance(item, Scan) else 0.0


def _beyond(image: RangeImage) -> float:
    """The share of an image's returns outside its sensor's limits, which count."""
    far = image.range[image.mask]
    return float(((far < image.sensor.min_range) | (far > image.sensor.max_range)).mean())


def columns_apart(sides: Sides, drawn: Sensor, projection: str) -> tuple[str, ...]:
    """A note where the points of one side alone, by some scans, are of fewer columns than the images that they are
    drawn into, so that columns stay empty between them."""
    apart = [side for side, images in sides.items() if images and _apart_by(images, drawn, projection) > APART]
    if len(apart) != 1:
        return ()
    return (f"points of {apart[0]} leave columns empty between them in the images of {drawn.width} columns that they "
            "are drawn into: as images (.npz, generate --format npz) they keep their own",)  # fmt: skip


def _apart_by(images: ImageSet, drawn: Sensor, projection: str) -> float:
    """The share of the columns with points beside which none has any, of some scans; 0 of what is no scan."""
    scans = [i for i in _numbers(images) if isinstance(images.item(i), Scan)]
    hits = [images.image(i, drawn, projection, resize=True).mask.any(axis=0) for i in scans]
    return float(np.median([(hit & ~np.roll(hit, -1)).sum() / max(1, hit.sum()) for hit in hits])) if hits else 0.0


def upside_down(sides: Sides, drawn: Sensor, projection: str) -> tuple[str, ...]:
    """A note where the rows of one side, by some images, are as those of the other from the last to the first."""
    if None in sides.values():
        return ()
    one, other = (_rows(images, drawn, projection) for images in sides.values() if images)
    straight, turned = (np.abs(rows - other).mean() for rows in (one, one[::-1]))
    if turned >= straight / 2:
        return ()
    return (f"rows of {' are as those of '.join(sides)} from the last to the first: row 0 is the highest beam",)


def _rows(images: ImageSet, drawn: Sensor, projection: str) -> np.ndarray:
    """(H,) the mean logarithm of the range, of some images; no return counts as 0 m."""
    some = _images(images, drawn, projection)
    return np.mean([np.log1p(image.range).mean(axis=1) for image in some], axis=0)


def _images(images: ImageSet | None, drawn: Sensor, projection: str) -> list[RangeImage]:
    """Some images of a side, in the sensor's size."""
    return [images.image(i, drawn, projection, resize=True) for i in _numbers(images)] if images else []


def turned_images(sides: Sides, drawn: Sensor, projection: str) -> tuple[str, ...]:
    """Notes where the images of a side, by some, are mirrored or turned, as the rays prove that end on KITTI's own car:
    there points return, and few do where the car would be then."""
    hides = own_car(drawn)
    if not hides.any():
        return ()
    notes = []
    for side, images in sides.items():
        masks = [image.mask for image in _images(images, drawn, projection) if image.sensor.name == drawn.name]
        if not masks:
            continue
        returns, told = np.mean(masks, axis=0), []
        for how, turn in TURNS.items():
            ought, seems = (float(returns[rays].mean()) for rays in _apart(hides, turn(hides)))
            told.append((seems, ought, how))
        seems, ought, how = min(told)  # several resemble one another
        if ought > SEEN and seems < UNSEEN:
            notes.append(f"images of {side} look {how}: {ought:.0%} of the rays that end on the car of {drawn.name} "
                         f"return, and {seems:.0%} of those that would then")  # fmt: skip
    return tuple(notes)


def _apart(one: np.ndarray, other: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What is only in the one, and only in the other."""
    return one & ~other, other & ~one


def other_frames(sides: Sides) -> tuple[str, ...]:
    """Notes where the points of a side, by the first scan, are not in their sensor's frame."""
    notes = []
    for side, images in sides.items():
        first = images.item(0) if images else None
        if isinstance(first, Scan) and (faults := check_frame(first).faults):
            notes.append(f"expected points of {side} in the sensor's frame (x forward, z up), found them "
                         f"{', '.join(faults)}")  # fmt: skip
    return tuple(notes)


def one_set(
    judged: ImageSet | None,
    truth: ImageSet | None,
    hashes: Mapping[str, str],
    protocol: EvaluationProtocol,
    unlike: int = 0,
) -> tuple[str, ...]:
    """A note where both sides are the same images: of one place, or copies, by the hashes of what was read; or where
    some of their files are, as of a folder within the other.

    unlike  how many are compared with another image, by a protocol of pairs
    """
    one, other = ((images.stamp, images.names, images.source) if images else ("", (), "") for images in (judged, truth))
    same, p = "samples and reference are the same images", protocol
    apart = p.reproject or ("samples" in p.gated) != ("real" in p.gated) or (p.clouds and p.clouds.redrawn)
    copies = one[:2] == other[:2] if apart else one == other  # a copy that was damaged since has the same index, too
    if not (copies and one[0]) and hashes["samples"] != hashes["reference"]:
        return _shared_files(judged, truth)
    if unlike and hashes["samples"] == hashes["reference"]:
        return (f"{same} in another order: {unlike} of {len(judged or ())} are compared with another image",)
    if apart:
        return (
            f"{same}, and {p.title} takes the reference otherwise than samples: distances are what that costs, or 0",
        )
    return (f"{same}: distances are 0, or as far as chance goes",)


def _shared_files(judged: ImageSet | None, truth: ImageSet | None) -> tuple[str, ...]:
    """A note where some samples lie in files that the reference has, too."""
    if not judged or not truth:
        return ()
    real = set(_files_of(truth))
    if not (shared := sum(file in real for file in _files_of(judged))):
        return ()
    return (f"{shared} of {len(judged)} samples are scans of the reference, too: the sets look nearer than they are",)


def _files_of(images: ImageSet) -> Iterator[tuple[Path, str]]:
    """The file of each image, whatever links lead there, and its number in a batch; of lists and caches none."""
    for name in images.names:
        file, _, number = name.rpartition("[") if name.endswith("]") else (name, "", "")  # no scan's file ends so
        if Path(file).is_file():
            yield Path(file).resolve(), number
