"""Statistics -> numbers -> a report that says under which protocol, with what, and what to be careful about."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

from lidarsynth.evaluation.measures import MEASURES, SHARED, filled_scans, kept_distances, lacking_returns
from lidarsynth.evaluation.protocol import EvaluationProtocol, Row
from lidarsynth.evaluation.statistics import Statistics, definition
from lidarsynth.lidar.beams import same_beams
from lidarsynth.metrics.sensor_report import BeamReport, compare_beams
from lidarsynth.networks.device import usual_torch

DEFINITIONS = "## Definitions"  # every page has them
OnRow = Callable[[str, int, int], object] | None  # (what, done, in all) of rows, or of a row's parts; for progress bars


@dataclass(frozen=True)
class Result:
    """One row of the table: the value times the row's scale, or None and the reason."""

    name: str
    value: float | None
    unit: str = ""
    digits: int = 3
    reason: str = ""

    def __str__(self) -> str:
        if self.value is None:
            return "N/A"
        shown = round(self.value, self.digits) + 0.0  # which has no sign where it is 0
        return f"{shown:.{self.digits}f}{f' {self.unit}' if self.unit else ''}"


def results_of(
    samples: Statistics,
    real: Statistics,
    missing: Mapping[str, str] | None = None,
    seed: int = 0,
    on_row: OnRow = None,
) -> tuple[Result, ...]:
    """The protocol's rows, those that cannot be computed as N/A with the reason.

    missing  kind of network -> why it is not there
    seed     of the subsets of the squared MMDs
    Raises ValueError when the two were gathered under different protocols, as other sides than samples and reference,
    or of images of different sizes.
    """
    if samples.protocol != real.protocol:
        raise ValueError(f"expected statistics of one protocol, found {samples.protocol.title} and "
                         f"{real.protocol.title}")  # fmt: skip
    if (samples.role, real.role) != ("samples", "real"):
        raise ValueError(f"expected statistics of samples and of a reference (real), found {samples.role} and "
                         f"{real.role}; gather a reference as such")  # fmt: skip
    size, size_real = ((s.sensor.height, s.sensor.width) for s in (samples, real))
    if size != size_real:
        raise ValueError(f"expected samples and reference of one resolution, found {size} and {size_real}")
    rows = []
    for i, row in enumerate(samples.protocol.rows):
        if on_row:
            on_row(f"compute {row.name}", i, len(samples.protocol.rows))
        rows.append(_result(row, samples, real, missing or {}, seed, on_row))
    kept_distances.cache_clear()
    return (*rows, *(Result(name, None, reason=reason) for name, reason in samples.protocol.absent))


def _result(
    row: Row, samples: Statistics, real: Statistics, missing: Mapping[str, str], seed: int, on_row: OnRow
) -> Result:
    reason = _lack(row, samples, real, missing)
    value = None
    if not reason:
        try:
            if on_row and row.measure in SHARED:
                SHARED[row.measure](samples, real, partial(on_row, f"compute {row.name}"))
            value = MEASURES[row.measure](row, samples, real, seed) * row.scale
        except ValueError as error:
            reason = str(error)
        if value is not None and not math.isfinite(value):
            value, reason = None, lacking_returns(row, samples, real)
    return Result(row.name, value, row.unit, row.digits, reason)


def _lack(row: Row, samples: Statistics, real: Statistics, missing: Mapping[str, str]) -> str:
    """What a row needs and does not have, or ''."""
    kind = row.network
    if kind is None:
        return ""
    if kind not in samples.moments and kind in missing:
        return missing[kind]
    for statistics, name in ((samples, "samples"), (real, "reference")):
        if kind not in statistics.moments:
            return f"the statistics of the {name} have no {kind} features; {missing.get(kind, 'make them again')}"
        if kind == "rangenet" and not statistics.lit:
            verb = "has" if name == "reference" else "have"
            return f"the {name} {verb} no return with a reflectance, which {kind} needs"
    if samples.weights.get(kind) != real.weights.get(kind):
        return f"samples and reference were made with different weights of {kind}"
    return ""


def warnings_of(samples: Statistics, real: Statistics, results: Sequence[Result] = ()) -> tuple[str, ...]:
    """What is unlike the protocol, or makes numbers hard to compare; one line each."""
    protocol, told = samples.protocol, []
    if protocol.samples is not None and samples.count != protocol.samples:
        told.append(f"{protocol.title} judges {protocol.samples:,} samples, found {samples.count:,}")
    size = (samples.sensor.height, samples.sensor.width)
    own_size = protocol.networks or protocol.sets  # made for, or published with, images of one sensor
    if (
        own_size
        and not protocol.clouds
        and (samples.sensor.name, *size) != (protocol.sensor, protocol.height, protocol.width)
    ):
        told.append(f"{protocol.title} is of {protocol.height} x {protocol.width} images of {protocol.sensor}, found "
                    f"{size[0]} x {size[1]} of {samples.sensor.name}")  # fmt: skip
    if samples.count != real.count:
        told.append(f"{samples.count:,} samples against {real.count:,} of the reference: "
                    "scores of small sets are larger, compare only with the same counts")  # fmt: skip
    if samples.bev and real.bev and samples.count == real.count and samples.bev.count != real.bev.count:
        told.append(f"{samples.bev.count:,} samples against {real.bev.count:,} of the reference in bird's eye view: "
                    "scores of small sets are larger, compare only with the same counts")  # fmt: skip
    for kind in sorted(samples.moments.keys() & real.moments.keys()):
        size = len(samples.moments[kind].mean)
        for statistics, name in ((samples, "samples"), (real, "reference")):
            if 2 <= statistics.count <= size:
                told.append(f"{statistics.count:,} images of the {name} give a singular covariance of {size} {kind} "
                            "features: the Frechet distance is larger than that of many")  # fmt: skip
    for statistics, name in ((samples, "samples"), (real, "reference")):
        empty = len(statistics.bev.scans) - len(filled_scans(statistics)) if statistics.bev else 0
        if empty:
            told.append(f"{empty} of the {name} have no point within the bird's eye gate, and no part in the MMD")
    for statistics, name in ((samples, "samples"), (real, "reference")):
        cells = statistics.occupancy
        if cells and (empty := sum(not len(scan) for scan in cells.scans)):
            told.append(f"{empty} of the {name} have no point within +-{cells.extent:g} m, and no part in the MMD")
    if protocol.measured and real.measured < real.count:
        told.append(f"{real.count - real.measured:,} of the reference hold no measured points (a cache keeps none): x, "
                    "y, z are those of the pixels' rays, in the official program the points' own")  # fmt: skip
    if samples.sharpness and real.sharpness and samples.measured * real.count != real.measured * samples.count:
        told.append(f"{samples.measured:,} of the samples and {real.measured:,} of the reference hold measured points, "
                    "others lie on their pixels' rays: the rows of thickness see the difference")  # fmt: skip
    for statistics, name in ((samples, "samples"), (real, "reference")):
        total = max(statistics.count, statistics.bev.count if statistics.bev else 0)
        if statistics.others:
            told.append(f"{statistics.others:,} of {total:,} images of the {name} are of other beams than those of "
                        f"{statistics.sensor.name}, which all are judged as")  # fmt: skip
        if "rangenet" in statistics.moments and 0 < statistics.lit < statistics.count:
            told.append(dark(statistics.count - statistics.lit, statistics.count, name))
    if not same_beams(samples.sensor, real.sensor):
        told.append(f"samples are of {samples.sensor.name}, the reference of {real.sensor.name}: other beams")
    return tuple(told)


def dark(count: int, total: int, name: str) -> str:
    """The note that so many images of a side have no reflectance, and others do."""
    return f"{count:,} of {total:,} images of the {name} have no reflectance, which counts as 0"


@dataclass(frozen=True)
class Report:
    """The outcome of an evaluation; `str()` is its table."""

    protocol: EvaluationProtocol
    results: tuple[Result, ...]
    counts: Mapping[str, int]  # samples, reference, and those in the bird's eye view
    hashes: Mapping[str, str]  # of images, statistics and weights
    seeds: Mapping[str, int]
    warnings: tuple[str, ...] = ()
    seconds: float = 0.0  # wall time
    sources: Mapping[str, str] = field(default_factory=dict)
    images: str = ""  # size and sensor
    beams: BeamReport | None = None
    classes: Mapping[str, float] | None = None  # class -> IoU, without pixels of class 0

    @property
    def values(self) -> dict[str, float | None]:
        """Row -> value as in the table, None where N/A."""
        return {result.name: result.value for result in self.results}

    def __str__(self) -> str:
        width = max(len(result.name) for result in self.results) + 2
        lines = [f"{self.protocol.title}: {self.counts['samples']:,} samples against {self.counts['reference']:,}"]
        lines[0] += f", {self.images}" if self.images else ""
        lines += [f"  {r.name:<{width}}{r!s:>14}" for r in self.results]
        reasons = dict.fromkeys(r.reason for r in self.results if r.reason)
        for reason in reasons:
            lines.append(f"  N/A: {', '.join(r.name for r in self.results if r.reason == reason)}: {reason}")
        lines += [f"  note: {warning}" for warning in self.warnings]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Plain lists, numbers and texts for JSON; what is not finite becomes None."""
        protocol, beams = self.protocol, None
        if self.beams:
            beams = {name: _plain(values.tolist()) for name, values in vars(self.beams).items()}
        return {
            "protocol": protocol.name,
            "version": protocol.version,
            "definition": definition(protocol),
            "values": {r.name: {"value": r.value, "unit": r.unit, "reason": r.reason} for r in self.results},
            "images": self.images,
            "counts": dict(self.counts),
            "seeds": dict(self.seeds),
            "hashes": dict(self.hashes),
            "sources": dict(self.sources),
            "warnings": list(self.warnings),
            "seconds": round(self.seconds, 3),
            "record": _plain(asdict(protocol)),
            "beams": beams,
            "classes": dict(self.classes) if self.classes else None,
        }

    def json(self) -> str:
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def markdown(self) -> str:
        """The same as a page: table, notes, what it was made with, and how each number is defined."""
        p = self.protocol
        lines = [f"# {p.title}", "", p.source + ".", "", "| measure | value | |", "|---|---:|---|"]
        lines += [f"| {r.name} | {r} | {r.reason} |" for r in self.results]
        lines += ["", *(f"- {text}" for text in self.warnings)] if self.warnings else []
        lines += ["", "## Made with", "", f"- images: {self.images}"]
        for title, table in (
            ("", self.counts),
            ("seed of ", self.seeds),
            ("from ", self.sources),
            ("hash of ", self.hashes),
        ):
            lines += [f"- {title}{name}: {value}" for name, value in table.items()]
        lines += [f"- definition: {definition(p)}", f"- wall time: {self.seconds:.1f} s", "", DEFINITIONS, ""]
        lines += [f"- {row.name}: {row.formula}" for row in p.rows]
        lines += [f"- pixels: {p.near:g} < range < {p.far:g} m of {', '.join(p.gated)}"] if p.gated else []
        lines += [f"- {note}" for note in p.notes]
        if self.classes:
            lines += ["", "## Classes", "", "| class | IoU |", "|---|---:|"]
            lines += [f"| {name} | {value:.2%} |" for name, value in self.classes.items()]
        if self.beams:
            lines += ["", "## Beams", "", "```", str(self.beams), "```"]
        return "\n".join(lines) + "\n"


def _plain(value: Any) -> Any:
    """JSON has no infinity and no NaN."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@usual_torch()
def report_of(
    samples: Statistics,
    real: Statistics,
    missing: Mapping[str, str] | None = None,
    seed: int = 0,
    on_row: OnRow = None,
) -> Report:
    """The whole report of two sets of statistics, but for wall time and sources. Raises ValueError as `results_of`."""
    results = results_of(samples, real, missing, seed, on_row)
    beams = None
    if samples.beams and real.beams and not (samples.others or real.others):
        with suppress(ValueError):  # of other beams; the rows say so
            beams = compare_beams(samples.beams, real.beams)
    counts = {"samples": samples.count, "reference": real.count}
    if samples.protocol.sets:
        counts |= {"samples as point sets": len(samples.sets()), "reference as point sets": len(real.sets())}
    if samples.bev and real.bev:
        counts |= {"samples in bird's eye view": samples.bev.count, "reference in bird's eye view": real.bev.count}
    hashes = {"samples": samples.digest, "reference": real.digest, **samples.weights}
    warnings = warnings_of(samples, real, results)
    if beams and beams.one_sided:
        silent = f"{beams.one_sided} of {len(beams.elevation)} beams"
        warnings += (f"{silent} return on one side only: no range per beam counts them",)
    return Report(samples.protocol, results, counts, hashes, {"subsets": seed}, warnings, beams=beams)
