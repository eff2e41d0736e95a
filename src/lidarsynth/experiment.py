"""What a model is and how it was made, as plain frozen records. Pure Python: reads in milliseconds, no torch."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Data:
    """From scans to x_0."""

    sensor: str | dict = "hdl-64e"  # a word of lidar.sensor.SENSORS, or a sensor of one's own as a table
    projection: str = "spherical"  # spherical | unfolding | auto
    height: int = 64  # rows of the image
    width: int = 1024  # columns of the image
    codec: str = "log"  # log | inverse | metric
    roll: bool = False  # augmentation: turn the scan by any number of columns
    mirror: bool = False  # augmentation: swap left and right


@dataclass(frozen=True)
class Model:
    """The network."""

    network: str = "efficient-unet"  # efficient-unet | conditional-unet (told the known pixels)
    base_channels: int = 64
    temb_channels: int | None = None  # None = 4 * base_channels
    channel_multipliers: tuple[int, ...] = (1, 2, 4, 8)
    num_residual_blocks: tuple[int, ...] = (3, 3, 3, 3)
    gn_num_groups: int = 8
    gn_eps: float = 1e-6
    attn_num_heads: int = 8
    coords_encoding: str | None = "fourier_features"  # | spherical_harmonics | polar_coordinates | None
    ring: bool = True  # circular in width
    stem: tuple[int, int] = (1, 1)  # patch of pixels that becomes channels, (1, 1) = R2DM
    dropout: float = 0.0


@dataclass(frozen=True)
class Diffusion:
    """Noise schedule, what the network says, and how it is judged."""

    schedule: str = "cosine"  # a word of diffusion.schedule.SCHEDULES
    kind: str = "eps"  # eps | x_0 | v | velocity | score
    clip: bool = True  # clamp x_0_hat to [-1, 1]
    loss: str = "l2"  # l1 | l2 | huber
    gamma: float | None = 5.0  # min-SNR; None = unweighted
    floor: float = 0.0  # least min-SNR weight of a sample
    mean_weight: bool = True  # every sample gets the batch's mean weight, as in R2DM's program


@dataclass(frozen=True)
class Training:
    """The optimiser and its budget; defaults are R2DM's."""

    steps: int = 300_000
    batch_size: int = 8
    learning_rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.99)
    warmup: int = 10_000  # steps of linear warm-up
    decay: str = "cosine"  # of the rate after that: cosine (half of one, to 0) | constant
    clip_norm: float = 1.0
    ema_decay: float = 0.995
    ema_every: int = 10  # steps
    ema_start: int = 10_000  # steps of plain copying
    generation_share: float = 1.0  # share of a batch trained without known pixels; 1 for unconditional networks
    seed: int = 0


@dataclass(frozen=True)
class Card:
    """Where weights come from; shown by `lidarsynth info`."""

    licence: str = ""
    data: str = ""  # what was learned from
    history: tuple[str, ...] = ()  # runs: steps, hardware, time
    results: tuple[str, ...] = ()  # measured numbers with their command


@dataclass(frozen=True)
class Experiment:
    """One model, from data to training, as `experiment.json` keeps it beside the weights."""

    name: str
    data: Data = field(default_factory=Data)
    model: Model = field(default_factory=Model)
    diffusion: Diffusion = field(default_factory=Diffusion)
    training: Training = field(default_factory=Training)
    card: Card = field(default_factory=Card)

    def to_dict(self) -> dict:
        """Plain tables, lists and numbers, the inverse of `from_dict`; without the groups that are None."""
        return {key: value for key, value in asdict(self).items() if value is not None}


def from_dict(values: Any, source: str = "experiment", record: type = Experiment) -> Any:
    """An Experiment (or the `record` of it) from plain tables, tolerating absent fields and no unknown ones.

    Raises ValueError that names the field, what was expected and what was found.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source}: expected a table of {[f.name for f in fields(record)]}, found {values!r:.60}")
    hints = get_type_hints(record)
    if unknown := values.keys() - hints.keys():
        raise ValueError(f"{source}: expected the fields {sorted(hints)}, found {sorted(unknown)}")
    needed = {f.name for f in fields(record) if f.default is MISSING and f.default_factory is MISSING}
    if missing := needed - values.keys():
        raise ValueError(f"{source}: expected the field {', '.join(sorted(missing))}, found {sorted(values)}")
    return record(**{key: _value(v, hints[key], f"{source}.{key}") for key, v in values.items()})


def _value(value: Any, hint: Any, source: str) -> Any:
    """A value as the field's hint wants it: tables become records, lists tuples. Raises ValueError by field."""
    records = [choice for choice in (hint, *get_args(hint)) if is_dataclass(choice)]
    if records and not (value is None and type(None) in get_args(hint)):
        return from_dict(value, source, records[0])  # type: ignore[arg-type]
    value = tuple(value) if isinstance(value, list) else value
    if not any(_fits(value, choice) for choice in (get_args(hint) if isinstance(hint, UnionType) else (hint,))):
        name = hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)
        raise ValueError(f"{source}: expected {name}, found {value!r:.60}")
    return value


def _fits(value: Any, hint: Any) -> bool:
    """Whether value is of a plain type, or a tuple such as tuple[int, ...] or tuple[float, float]."""
    if get_origin(hint) is not tuple:
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        return number if hint is float else type(value) is hint
    inner = get_args(hint)
    if not isinstance(value, tuple) or (inner[-1] is not Ellipsis and len(value) != len(inner)):
        return False
    return all(_fits(v, inner[0]) for v in value)


def with_fields(experiment: Experiment, changes: dict[str, Any]) -> Experiment:
    """The experiment with `group.field` values replaced, e.g. {"training.steps": 1000}. Raises ValueError by name."""
    for path, value in changes.items():
        group, _, name = path.partition(".")
        part = getattr(experiment, group, None) if group in {f.name for f in fields(experiment)} else None
        if not is_dataclass(part) or name not in {f.name for f in fields(part)}:
            raise ValueError(f"expected an experiment field such as training.steps, found {path!r}")
        value = _value(value, get_type_hints(type(part))[name], path)
        experiment = replace(experiment, **{group: replace(part, **{name: value})})  # type: ignore[type-var]
    return experiment
