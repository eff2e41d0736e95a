"""A scan and what it is compared with: series whose scan i belong together, and the stops of the page made of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lidarsynth.data.capture import is_capture
from lidarsynth.lidar.plural import plural
from lidarsynth.verbs.expansion import is_stream
from lidarsynth.verbs.inputs import Reading
from lidarsynth.viewer.page import Entry
from lidarsynth.viewer.series import Files, Series, series_of

MOST = 48  # scans in one file; every one is about a megabyte


def compared(paths: Sequence[Path], other: Path | None, reading: Reading) -> dict[str, Series]:
    """Series by caption: the scans, and those of `other`, joined by name where all have a partner, by number where
    none has one. Captions are names, or whole paths where these are alike.

    Raises ValueError where there is nothing to show, `other` is the same, some have a partner and others none, or the
    two differ in number.
    """
    if other is None:
        scans = series_of(paths, reading)
        several = len(paths) > 1 and scans.count is not None  # folders and captures hold more than one
        return {plural(scans.count or 0, "scan") if several else _caption(paths): scans}
    first, second = _captions(paths, other)
    scans = series_of(paths, _own(paths, [other], reading))
    partners = series_of([other], _own([other], paths, reading))
    if isinstance(scans, Files) and isinstance(partners, Files):
        partners = _by_name(scans, partners, other)
    if None not in (scans.count, partners.count) and scans.count != partners.count:
        number = plural(scans.count or 0, "scan")
        raise ValueError(f"{other}: expected {number} to compare, or one of each name, found {partners.count}")
    return {first: scans, second: partners}


def _own(paths: Sequence[Path], others: Sequence[Path], reading: Reading) -> Reading:
    """The reading without a topic or metadata where these are of the others: bags or captures, and captures."""
    topic = any(map(is_stream, paths)) or not any(map(is_stream, others))
    metadata = any(map(is_capture, paths)) or not any(map(is_capture, others))
    return replace(reading, topic=reading.topic if topic else None, metadata=reading.metadata if metadata else None)


def _name(path: Path) -> str:
    return path.absolute().name


def _caption(paths: Sequence[Path], word: Callable[[Path], str] = _name) -> str:
    return word(paths[0]) if len(paths) == 1 else f"{len(paths)} scans"


def _captions(paths: Sequence[Path], other: Path) -> tuple[str, str]:
    """Of the scans and of `other`: their names, or paths where these are alike. Raises ValueError for the same path."""
    if [path.absolute() for path in paths] == [other.absolute()]:
        raise ValueError(f"{other}: expected another scan to compare, found the same")
    words = (_name, str, lambda path: str(path.absolute()))
    pairs = ((_caption(paths, word), _caption([other], word)) for word in words)
    return next((first, second) for first, second in pairs if first != second)


def _by_name(scans: Files, partners: Files, other: Path) -> Files:
    """The partners in the scans' order, where every scan has one of its name; as they are where none has one.

    Raises ValueError otherwise: by number, scans of unlike names would stand beside each other."""
    place = {name: i for i, name in enumerate(partners.names)}
    alone = [name for name in scans.names if name not in place]
    if len(alone) == len(scans.names):
        return partners
    if alone and len(scans.names) == len(partners.names):  # of unlike numbers it is said below
        number = f"{len(alone)} of {plural(len(scans.names), 'scan')}"
        raise ValueError(f"{other}: expected a scan of each name, or of none, found none for {number}, the first: "
                         f"{alone[0]}")  # fmt: skip
    if alone:
        return partners
    order = [place[name] for name in scans.names]
    return Files(scans.names, [partners.paths[i] for i in order], partners.reading, partners.cut)


def entries(series: Mapping[str, Series], broken: list[str]) -> Iterator[Entry]:
    """Every stop with its scans; those of which one cannot be read are left out, and what is wrong with it put on
    `broken`. Raises ValueError beyond MOST scans, and where all are broken."""
    first = next(iter(series.values()))
    if (first.count or 0) * len(series) > MOST:
        raise ValueError(f"expected at most {MOST} scans for one file, found {(first.count or 0) * len(series)}; name "
                         "fewer, or leave out --out")  # fmt: skip
    number = shown = 0
    while first.count is None or number < first.count:
        number += 1
        try:
            versions = {caption: scans[number - 1] for caption, scans in series.items()}
        except IndexError:
            break
        except (ValueError, OSError) as error:
            if any(len(scans.names) < number for scans in series.values()):
                raise  # not this scan is broken, but what it is read from: there is no next one
            broken.append(str(error))
            continue
        shown += 1
        if shown * len(series) > MOST:
            raise ValueError(f"expected at most {MOST} scans for one file, found more; name fewer, or leave out --out")
        yield Entry(first.names[number - 1], versions)
    if broken and not shown:
        raise ValueError(broken[0] if len(broken) == 1 else f"expected scans, found all {len(broken)} broken; the "
                         f"first: {broken[0]}")  # fmt: skip
