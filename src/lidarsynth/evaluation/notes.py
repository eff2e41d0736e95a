"""Notes on sets of images that are read to be judged: what makes their numbers mean something else; one line each."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from torch import Tensor

from lidarsynth.evaluation.image_sets import ImageSet, Item, stem_of
from lidarsynth.evaluation.protocol import EvaluationProtocol
from lidarsynth.evaluation.sample_tensors import beams_off
from lidarsynth.lidar.recognition import recognise, same_kind
from lidarsynth.lidar.scan import RangeImage, Scan
from lidarsynth.lidar.sensor import WORDS, Sensor, get_sensor

METRES = 1.5  # no outdoor scan ends so near
LOOKED_AT = 8  # scans or tensors of a set, at least and from everywhere, whether all are of one sensor
GRID = "R2DM's grid is hdl-64e"
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


def _sensors_of(images: ImageSet) -> list[str]:
    """The sensors of those that are points, of some from everywhere, as recognised."""
    scans = (scan for scan in _some(images) if isinstance(scan, Scan))
    return list(dict.fromkeys(name for scan in scans if (name := recognise(scan)[0])))


def _some(images: ImageSet) -> Iterator[Item]:
    return (images.item(i) for i in range(0, len(images), max(1, len(images) // LOOKED_AT)))


def tensors_taken(sides: Sides, rays: Sensor, named: str | Sensor | None) -> tuple[str, ...]:
    """Notes where a side, by some from everywhere, has tensors whose rows are other beams than the sensor's they are
    taken for; or, unless a sensor was named for them, which rays those have that hold no points."""
    told = []
    for side, images in sides.items():
        tensors = [t for t in _some(images) if isinstance(t, Tensor) and t.ndim == 3] if images else []
        if off := max((beams_off(tensor, rays) for tensor in tensors if len(tensor) == 5), default=0.0):
            told.append(f"the points of {side}, which are tensors, lie {off:.1f} degrees off the beams of {rays.name}, "
                        f"for whose rows they are taken: --sensor names theirs ({GRID})")  # fmt: skip
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
    if given.height % own.height == 0 and given.resized(own.height, own.width).elevations == own.elevations:
        return ()
    drawn = images is not None and not isinstance(first, RangeImage)
    why = f"are drawn into the reference's images, of {own.name}" if drawn else f"know their own sensor, {own.name}"
    word = named.name if isinstance(named, Sensor) else named
    return (f"the samples {why}: {word}, named for points and tensors, is not used",)


def unlike_metres(sides: Sides) -> tuple[str, ...]:
    """A note where the images of a side, by the first and the last, have ranges as they come out of a network."""
    notes = []
    for side, images in sides.items():
        some = [images.item(i) for i in {0, len(images) - 1}] if images else []
        farthest = max((float(item.range.max(initial=0)) for item in some if isinstance(item, RangeImage)), default=0)
        if 0 < farthest <= METRES:
            notes.append(f"ranges of {side} are {farthest:.2f} m at most: expected metres, not shares of a limit")
    return tuple(notes)


def one_set(
    judged: ImageSet | None, truth: ImageSet | None, hashes: Mapping[str, str], protocol: EvaluationProtocol
) -> tuple[str, ...]:
    """A note where both sides are the same images: of one place, or copies, by the hashes of what was read."""
    one, other = ((images.stamp, images.names) if images else ("", ()) for images in (judged, truth))
    if (one != other or not one[0]) and hashes["samples"] != hashes["reference"]:
        return ()
    same, p = "samples and reference are the same images", protocol
    if p.reproject or ("samples" in p.gated) != ("real" in p.gated) or (p.clouds and p.clouds.redrawn):
        return (
            f"{same}, and {p.title} takes the reference otherwise than samples: distances are what that costs, or 0",
        )
    return (f"{same}: distances are 0, or as far as chance goes",)
