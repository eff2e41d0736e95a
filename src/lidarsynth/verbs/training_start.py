"""What a training run began with, kept beside its checkpoints: it goes on with the same images and weights only."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from hashlib import sha256
from os.path import normpath
from pathlib import Path

from lidarsynth.data.dataset import SeveralCaches
from lidarsynth.data.index import PLACE, done, read_index
from lidarsynth.experiment.record import Card
from lidarsynth.lidar.small_file import read_json
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.training.examples import Streets, TrainingImages, folders_of, words_of

START = "start.json"


@dataclass(frozen=True)
class Start:
    """What a run is begun with.

    images       how many of what, in words: what a card says of them, and not where they lie on this disk
    fingerprint  of the images of caches, 16 hex digits, wherever the folders lie; "" of streets
    weights      as they were asked for, or None
    judged       which images it is judged on: as `fingerprint`, or the word of streets; "" where none are named
    """

    images: str
    fingerprint: str = ""
    weights: str | None = None
    judged: str = ""


def start_of(
    images: TrainingImages, data: str | Path, weights: str | None, validation: str | Path | None = None
) -> Start:
    """Of open images, and the words of them, of the weights and of what is judged. Raises ValueError where `data` or
    `validation` is no cache."""
    if isinstance(images, Streets):
        count = "endless"
    else:
        count = f"{images.scans if isinstance(images, SeveralCaches) else len(images):,}"
    details = [f"{key} {value}" for key, value in images.source.items() if key not in ("name", *PLACE)]
    words = ", ".join([f"{count} images of {images.source['name']}", *details])
    judged = "" if validation is None else str(validation) if words_of(validation) else _fingerprint(validation)
    return Start(words, "" if isinstance(images, Streets) else _fingerprint(data), weights, judged)


def _fingerprint(data: str | Path) -> str:
    """From the checksums that the indexes of the caches hold, in their order."""
    shards = [sorted(read_index(folder)["shards"].items()) for folder in folders_of(data)]
    content = [[(entry["count"], entry.get("sha256")) for _, entry in of if entry["count"]] for of in shards]
    return sha256(json.dumps(content).encode()).hexdigest()[:16]


def shared_images(data: str | Path, validation: str | Path | None) -> str:
    """A note where scans of the caches that a run is judged on are among those it learns from, or "": by where they
    lay, or as whole shards of the same content."""
    if validation is None or words_of(data) or words_of(validation):
        return ""
    learned = set().union(*(marks for folder in folders_of(data) for marks in _marks(folder)))
    held_out = [marks for folder in folders_of(validation) for marks in _marks(folder)]
    if not (shared := sum(not learned.isdisjoint(marks) for marks in held_out)):
        return ""
    return (f"{validation}: expected scans that are not trained on, found {shared:,} of its {len(held_out):,} "
            f"in {data}: what they judge says nothing of other scans")  # fmt: skip


def unfinished(data: str | Path) -> str:
    """A note where a cache that is learned from was killed in the making, or ""."""
    for folder in () if words_of(data) else folders_of(data):
        index = read_index(folder)
        if done(index) < index["count"]:
            return (f"{folder}: expected a finished cache, found {done(index):,} of {index['count']:,} scans done; the "
                    "same data command goes on, and a run that was begun before does not")  # fmt: skip
    return ""


def _marks(folder: str) -> Iterator[set[str]]:
    """What tells each image of a cache: its place in a shard of some content, and the path of its scan, if there is."""
    index = read_index(folder)
    for entry in index["shards"].values():
        root, frames = index["source"].get("root"), entry.get("frames")
        for k in range(entry["count"]):
            content = {f"{entry['sha256']} {k}"} if "sha256" in entry else set()
            yield content | ({normpath("/".join([root, *frames[k]]))} if isinstance(root, str) and frames else set())


def write_start(out: Path, start: Start) -> None:
    """Keep what a run begins with. Raises OSError."""
    write_whole(out / START, json.dumps(asdict(start), indent=1) + "\n")


def check_start(out: Path, start: Start, card: Card) -> str:
    """A note on what is not used where a run goes on, or "". Raises ValueError for other images or weights.

    card  of the run's checkpoint: of a run from before there was this file it tells how many images of what there were
    """
    if not (out / START).exists():
        return _check_card(out, start, card)
    try:
        found = Start(**read_json(out / START))
    except TypeError:  # made by other hands
        raise ValueError(f"{out / START}: expected what a run began with, found another table") from None
    same = found.fingerprint == start.fingerprint and (start.fingerprint or found.images == start.images)
    if not same:  # words have not always counted the scans of several caches once
        was, given = ((f"{s.images} ({s.fingerprint})" if s.fingerprint else s.images) for s in (found, start))
        raise ValueError(_other(out, was, given))
    if start.weights not in (None, found.weights):
        raise ValueError(f"{out}: expected its own run, begun from {found.weights or 'no weights'}, found --from "
                         f"{start.weights}; leave it away, or another folder begins a new run")  # fmt: skip
    if found.judged and start.judged and found.judged != start.judged:
        return (f"{out}: expected the validation images that the run began with, found others: its curves and "
                "judged.csv hold numbers of both")  # fmt: skip
    return ""


def _check_card(out: Path, start: Start, card: Card) -> str:
    was, given = (words.partition(", ")[0] for words in (card.data.rpartition("; ")[2], start.images))
    if was and _counted_by_cache(was) != _counted_by_cache(given):
        raise ValueError(_other(out, was, given))
    return f"--from {start.weights} is not used: the run in {out} goes on" if start.weights else ""


def _other(out: Path, was: str, given: str) -> str:
    return f"{out}: expected its own run, which learns from {was}, found {given}; another folder begins a new run"


def _counted_by_cache(words: str) -> str:
    """What tells images apart by their words: of several caches not their sum, which once counted scans as shown."""
    _, several, named = words.partition(" images of several caches ")
    return several + named or words
