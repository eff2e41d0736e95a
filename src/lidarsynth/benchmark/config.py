"""What a benchmark compares: a TOML file -> frozen records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from lidarsynth.evaluation.measures import LARGEST_SEED
from lidarsynth.experiment.record import from_dict
from lidarsynth.lidar.plural import plural
from lidarsynth.lidar.small_file import read_toml
from lidarsynth.networks.interpolation import METHODS, RESIZED


@dataclass(frozen=True)
class UpsamplingMethod:
    """One row of a table of upsampling, or one for each of several `steps`. It has an interpolation or a model."""

    name: str
    interpolation: str | None = None  # nearest | bilinear | bicubic, or as images are enlarged: resized-nearest ...
    model: str | None = None  # whatever `load` takes
    method: str | None = None  # of the model's `complete`: conditional | repaint; None = its own
    steps: int | tuple[int, ...] | None = None  # None = the model's own
    resamples: int | None = None  # passes over each step of repaint
    sampler: str | None = None
    images: int | None = None  # only the first so many, where a method is slow
    published: str | None = None  # row of the published table; default: the interpolation

    @property
    def steps_asked(self) -> int | None:
        """The steps of one row. Raises ValueError for a method that is several rows."""
        return _one(self.steps)


@dataclass(frozen=True)
class GenerationMethod:
    """One row of a table of generation, or one for each of several `steps`. It has one source of scans."""

    name: str
    model: str | None = None  # whatever `load` takes
    samples: str | None = None  # scans made elsewhere: a folder, a cache, or as `reference`
    held_out: str | None = None  # the same, of real scans: how near the real ones are to each other
    noise: bool = False  # what sampling starts from
    steps: int | tuple[int, ...] | None = None  # None = the model's own
    sampler: str | None = None  # ddpm | ddim | dpmpp-2m | sde-dpmpp-2m | heun | columns; None = the model's own
    count: int | None = None  # scans to make, if other than the benchmark's
    published: str | None = None  # row of the published table

    @property
    def steps_asked(self) -> int | None:
        """The steps of one row. Raises ValueError for a method that is several rows."""
        return _one(self.steps)


@dataclass(frozen=True)
class Upsampling:
    """A benchmark of completion: parts of measured scans are hidden, filled, and compared with what was hidden."""

    data: str  # a cache, a folder of scans or images, "synthetic:COUNT:SEED", or "street", the shipped scan
    title: str = "Upsampling"
    protocol: str | tuple[str, ...] = "r2dm-upsampling-2024"
    corruption: str = "beams:4"  # as `lidar.corruption.corrupt` reads it
    images: int | None = None  # the first so many; None = all
    seed: int = 0  # scan i takes seed + i
    sensor: str | None = None  # of scans that are points; None = the protocol's
    projection: str = "auto"  # of scans that are points
    figure: int | None = None  # number of the scan in the figure; None = the first with labels, else the first
    method: tuple[UpsamplingMethod, ...] = ()


@dataclass(frozen=True)
class Generation:
    """A benchmark of generation: sets of new scans are compared with a set of measured ones."""

    reference: str  # as `Upsampling.data`
    title: str = "Generation"
    protocol: str | tuple[str, ...] = "bev-1"
    count: int = 64  # scans per method
    seed: int = 0  # scan i takes seed + i
    sensor: str | None = None  # of scans that are points; None = the protocol's
    figure: int = 0  # number of the scan in the figure
    method: tuple[GenerationMethod, ...] = ()


KINDS: dict[str, tuple[type, type, str]] = {  # word -> records, and the field that --data replaces
    "upsampling": (Upsampling, UpsamplingMethod, "data"),
    "generation": (Generation, GenerationMethod, "reference"),
}
SOURCES: dict[type, tuple[str, ...]] = {
    UpsamplingMethod: ("interpolation", "model"),
    GenerationMethod: ("model", "samples", "held_out", "noise"),
}
LEAST = {"seed": 0, "figure": 0, "images": 1, "count": 1, "steps": 1, "resamples": 1}
AnyMethod = TypeVar("AnyMethod", UpsamplingMethod, GenerationMethod)


def read_config(
    kind: str, path: str | Path, data: str | None = None, seed: int | None = None
) -> Upsampling | Generation:
    """The `Upsampling` or `Generation` of a TOML file; `data` and `seed` replace the file's own.

    Raises ValueError in one line that names the key, what was expected and what was found.
    """
    path = Path(path)
    try:
        values = read_toml(path)
    except OSError as error:
        raise ValueError(f"{path}: expected a readable file, found {error.strerror}") from None
    record, method, field = KINDS[kind]
    values |= {key: value for key, value in ((field, data), ("seed", seed)) if value is not None}
    tables = values.pop("method", [])
    if not isinstance(tables, list) or not tables:
        raise ValueError(f"{path}: expected at least one [[method]], found {tables!r:.60}")
    methods = tuple(from_dict(table, f"{path}: method {i}", method) for i, table in enumerate(tables, 1))
    config = replace(from_dict(values, str(path), record), method=methods)
    _check_numbers(config, str(path))
    words = protocols_of(config)
    if not words or len(set(words)) < len(words):
        raise ValueError(f"{path}.protocol: expected one or several protocols, each once, found {list(words)}")
    if isinstance(config, Generation) and config.seed > LARGEST_SEED:  # `evaluate` takes it, too
        raise ValueError(f"{path}.seed: expected at most {LARGEST_SEED}, found {config.seed}")
    for item in methods:
        _check_numbers(item, f"{path}: method {item.name!r}")
        _check_source(item, f"{path}: method {item.name!r}")
    names = [item.name for _, item in rows(methods)]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{path}: expected a name of its own for every row, found {twice[0]!r} twice")
    return config


def rows(methods: Sequence[AnyMethod]) -> list[tuple[str, AnyMethod]]:
    """(group, method) of every row: a method of several steps becomes one with each, named `GROUP, N steps`."""
    found: list[tuple[str, AnyMethod]] = []
    for method in methods:
        if not isinstance(method.steps, tuple):
            found.append((method.name, method))
            continue
        for steps in method.steps:
            name = f"{method.name}, {plural(steps, 'step')}"
            found.append((method.name, replace(method, name=name, steps=steps)))
    return found


def protocols_of(config: Upsampling | Generation) -> tuple[str, ...]:
    """The words of the protocols."""
    return (config.protocol,) if isinstance(config.protocol, str) else config.protocol


def _one(steps: int | tuple[int, ...] | None) -> int | None:
    if isinstance(steps, tuple):
        raise ValueError(f"expected one number of steps, found {steps}; `rows` takes them apart")
    return steps


def _check_numbers(record: Any, where: str) -> None:
    for key, least in LEAST.items():
        value = vars(record).get(key)
        if value is None:
            continue
        numbers = value if isinstance(value, tuple) else (value,)
        if not numbers or min(numbers) < least or max(numbers) >= 2**62:
            raise ValueError(f"{where}.{key}: expected whole numbers of at least {least}, found {value!r:.60}")


def _check_source(method: Any, where: str) -> None:
    given = [key for key in SOURCES[type(method)] if getattr(method, key)]
    if len(given) != 1:
        raise ValueError(f"{where}: expected one of {', '.join(SOURCES[type(method)])}, "
                         f"found {' and '.join(given) or 'none'}")  # fmt: skip
    word = getattr(method, given[0])
    if given[0] == "interpolation" and word not in (*METHODS, *RESIZED):
        raise ValueError(f"{where}.interpolation: expected one of {', '.join((*METHODS, *RESIZED))}, found {word!r}")
    if given[0] != "model":
        model_only = ("method", "steps", "resamples", "sampler", *(() if given[0] == "noise" else ("count",)))
        if useless := [key for key in model_only if getattr(method, key, None) is not None]:
            raise ValueError(f"{where}.{useless[0]}: expected it with a model, found it with {given[0]}")
