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
    codec: str = "log"  # log | inverse | metric | log-63m (LiDARGen) | inverse-minmax (DUSty of 2021)
    reflectance: bool = True  # whether the network knows reflectance
    roll: bool = False  # augmentation: turn the scan by any number of columns
    mirror: bool = False  # augmentation: swap left and right
    mend: bool = True  # mixed pixels that a conditional network makes are put onto the surface beside them
    scale: float = 0.0  # augmentation of diffusion models: ranges times 1 - scale to 1 + scale
    mix: float = 0.0  # augmentation of completion: share of samples with a sector of another image of the cache


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
    candidates: bool = False  # conditional-unet: chooses among the nearest known values, not only corrects their mean
    around: bool = False  # and the nearest known value in any direction
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
class Score:
    """Denoising score matching and annealed Langevin steps; defaults are LiDARGen's, sigmas those of data in [0, 1]."""

    levels: int = 232  # noise levels, falling geometrically
    sigma_max: float = 50.0
    sigma_min: float = 0.01
    steps: int = 5  # Langevin steps at each level
    rate: float = 0.062  # share of the way to x_0_hat in a step: step_lr / sigma_min^2


@dataclass(frozen=True)
class Upsampling:
    """Networks that put beams between known ones: LiDAR-SR, ILN and LIIF. Lengths are metres."""

    factor: tuple[int, int] = (4, 1)  # rows and columns of the image per known row and column
    first: int = 0  # the first known row from the top, as in beams:4:FIRST
    spread: bool = False  # LiDAR-SR's rows reach from the first known row to the last (official weights)
    norm: float = 100.0  # the range that is 1
    max_range: float = 80.0  # farther is no return
    noise: float = 0.0  # standard deviation of what training adds to ranges
    keras: bool = False  # LiDAR-SR's original program: no return is 0 and not 1, dropout of single values
    passes: int = 50  # of LiDAR-SR under Monte-Carlo dropout
    threshold: float = 0.03  # LiDAR-SR drops pixels whose standard deviation is more than this share of their mean
    depth: int = 1  # layers of ILN's transformer
    queries: int = 16_384  # pixels of a scan that a step of ILN or LIIF learns from


@dataclass(frozen=True)
class Adversarial:
    """A GAN and how it is trained; defaults are those of the DUSty v2 program (WACV 2023), the same for all three."""

    latent_channels: int = 512  # of z ~ N(0, I)
    style_channels: int = 512  # of dusty-v2; the styles of the others are z
    max_channels: int = 512  # at the coarsest map; model.base_channels are those of the finest
    discriminator_channels: int | None = None  # at its finest map; None = model.base_channels
    temperature: float = 1.0  # of the Gumbel-sigmoid that drops rays
    iros21: bool = False  # layers of the first release of vanilla GAN and DUSty v1: tanh, mirrored blur
    empty_below: float = 0.0  # code in [0, 1] up to which a pixel is empty
    r1_weight: float = 1.0
    r1_every: int = 16  # steps
    path_length_weight: float = 0.0  # 0 = off
    path_length_every: int = 4  # steps
    augmentation_target: float | None = 0.6  # mean sign of the logits of real images; None = no augmentation
    augmentation_images: int = 500_000  # in which its probability can rise from 0 to 1
    augmentation_every: int = 4  # steps between its updates
    warmup_images: int = 200_000  # in which pixels are dropped before the discriminator, half of them at first


@dataclass(frozen=True)
class Segmentation:
    """A class for every pixel: RangeNet; `model.base_channels` is its width, 32 in the published networks."""

    layers: int = 53  # 21 | 53
    columns: int | None = None  # of a training image, cut out anywhere; None = all
    drop: float = 0.0  # augmentation: the largest share of an image's points that is dropped


@dataclass(frozen=True)
class Training:
    """The optimiser and its budget; defaults are R2DM's."""

    steps: int = 300_000
    batch_size: int = 8
    learning_rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.99)
    warmup: int = 10_000  # steps of linear warm-up
    decay: str = "cosine"  # of the rate after that: cosine (half of one, to 0) | constant | inverse | halving
    clip_norm: float | None = 1.0  # None = gradients as they are
    ema_decay: float = 0.995
    ema_every: int = 10  # steps
    ema_start: int = 10_000  # steps of plain copying
    ema_half_life: int = 10_000  # images; of GANs, in the place of the three above
    generation_share: float = 1.0  # share of a batch trained without known pixels; 1 for unconditional networks
    upsampling_share: float = 0.0  # of the others, the share that knows every fourth beam and begins at pure noise
    metres_weight: float = 0.1  # of completion's error in metres, beside that in code
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
    score: Score | None = None  # of networks trained by score matching
    upsampling: Upsampling | None = None  # of networks that put beams between known ones
    adversarial: Adversarial | None = None  # of GANs
    segmentation: Segmentation | None = None  # of networks that classify pixels

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
