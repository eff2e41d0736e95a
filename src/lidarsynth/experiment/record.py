"""What a model is and how it was made, as plain frozen records. Pure Python: reads in milliseconds, no torch."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from functools import lru_cache
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from lidarsynth.experiment.ranges import check_ranges, within

WEIGHTS, RECORD = "model.safetensors", "experiment.json"  # the files of a model's folder


@dataclass(frozen=True)
class Data:
    """From scans to x_0."""

    sensor: str | dict = "hdl-64e"  # a word of lidar.sensor.WORDS, or a sensor of one's own as a table
    projection: str = "spherical"  # spherical | unfolding | auto
    height: int = within(64, 1, 4096)  # rows of the image
    width: int = within(1024, 4, 65_536)  # columns of the image
    codec: str = "log"  # log | inverse | metric | log-63m (LiDARGen) | inverse-minmax (DUSty of 2021)
    reflectance: bool = True  # whether the network knows reflectance
    roll: bool = False  # augmentation: turn the scan by any number of columns
    mirror: bool = False  # augmentation: swap left and right
    mend: bool = True  # mixed pixels that a conditional network makes are put onto the surface beside them
    scale: float = within(0.0, 0, 0.99)  # augmentation of diffusion models: ranges times 1 - scale to 1 + scale
    mix: float = within(0.0, 0, 1)  # augmentation of completion: share of samples with a sector of another image
    even: float = within(0.0, 0, 1)  # of completion: share of KITTI's images drawn in `hdl-64e`, R2DM's even grid
    fixed: bool = False  # of a model of any sensor: images of that sensor whatever made the scan, as after `into`
    columns: int | None = within(None, 4, 65_536)  # columns to draw scans at, of which `width` are kept; None = width

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Model:
    """The network."""

    network: str = "efficient-unet"  # efficient-unet | conditional-unet (told the known pixels)
    base_channels: int = within(64, 1, 8192)
    temb_channels: int | None = within(None, 1, 65_536)  # None = 4 * base_channels
    channel_multipliers: tuple[int, ...] = within((1, 2, 4, 8), 1, 1024)
    num_residual_blocks: tuple[int, ...] = within((3, 3, 3, 3), 0, 64)
    gn_num_groups: int = within(8, 1, 8192)
    gn_eps: float = within(1e-6, 0, 1)
    attn_num_heads: int = within(8, 1, 1024)
    coords_encoding: str | None = "fourier_features"  # | spherical_harmonics | polar_coordinates | None
    ring: bool = True  # circular in width
    stem: tuple[int, int] = within((1, 1), 1, 64)  # patch of pixels that becomes channels, (1, 1) = R2DM
    candidates: bool = False  # conditional-unet: chooses among the nearest known values, not only corrects their mean
    around: bool = False  # and the nearest known value in any direction
    classes: int = within(0, 0, 1000)  # cascade: SemanticKITTI classes that it names for each pixel, 0 = none
    class_channels: int = within(32, 8, 8192)  # cascade: width of the network that names them
    inside_channels: int = within(0, 0, 8192)  # cascade: width of what names the insides of buildings, 0 = none
    indoors_channels: int = within(0, 0, 8192)  # cascade: width of what says which scans are of such, 0 = that network
    drawn_channels: int = within(0, 0, 8192)  # cascade: width of what names scans in the making, 0 = none
    noisiest: float = within(8.0, 8, 30)  # cascade: -log_snr of the noise that its coarse network draws grids from
    guide_channels: int = within(0, 0, 8192)  # cascade: width of the network that guides the coarse one, 0 = none
    column_channels: int = within(0, 0, 8192)  # cascade: width of the transformer that draws grids, 0 = none
    between_channels: int = within(0, 0, 8192)  # cascade: width of what draws the columns between those, 0 = none
    beam_channels: int = within(0, 0, 8192)  # cascade: width of what draws the beams between those, 0 = none
    judge_channels: int = within(0, 0, 8192)  # cascade: width of what chooses among drawn grids, in eights, 0 = none
    judge_openness: tuple[float, ...] = within((), -1e4, 1e4)  # cascade: what its odds owe to six numbers of openness
    likeliest: bool = False  # cascade: a fill of its own for the image of least error; samples are by the other
    likeliest_blocks: tuple[int, ...] = within((1, 1, 2, 2), 1, 64)  # cascade: of that fill, at each level
    own_classes: bool = False  # cascade with a base: its network of classes goes on too, and is kept with it
    observer_channels: int = within(0, 0, 8192)  # cascade: width of what says what is seen of surfaces, 0 = none
    dropout: float = within(0.0, 0, 0.999)

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Diffusion:
    """Noise schedule, what the network says, and how it is judged."""

    schedule: str = "cosine"  # a word of diffusion.schedule.SCHEDULES
    kind: str = "eps"  # eps | x_0 | v | velocity | score
    clip: bool = True  # clamp x_0_hat to [-1, 1]
    loss: str = "l2"  # l1 | l2 | huber
    gamma: float | None = within(5.0, 0)  # min-SNR; 1e9 = R2DM's off: 1, snr, snr / (snr + 1); None = no weight
    floor: float = within(0.0, 0)  # least min-SNR weight of a sample
    mean_weight: bool = True  # every sample gets the batch's mean weight, as in R2DM's program

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Score:
    """Denoising score matching and annealed Langevin steps; defaults are LiDARGen's, sigmas those of data in [0, 1]."""

    levels: int = within(232, 1, 100_000)  # noise levels, falling geometrically
    sigma_max: float = within(50.0, 0)
    sigma_min: float = within(0.01, 0)
    steps: int = within(5, 1, 100_000)  # Langevin steps at each level
    rate: float = within(0.062, 0)  # share of the way to x_0_hat in a step: step_lr / sigma_min^2

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Upsampling:
    """Networks that put beams between known ones: LiDAR-SR, ILN and LIIF. Lengths are metres."""

    factor: tuple[int, int] = within((4, 1), 1, 64)  # rows and columns of the image per known row and column
    first: int = within(0, 0, 4096)  # the first known row from the top, as in beams:4:FIRST
    spread: bool = False  # LiDAR-SR's rows reach from the first known row to the last (official weights)
    norm: float = within(100.0, 1e-6)  # the range that is 1
    max_range: float = within(80.0, 0)  # farther is no return
    min_range: float = within(0.0, 0)  # nearer is shown as 0, which is no return with `keras`, and is no answer
    noise: float = within(0.0, 0)  # standard deviation of what training adds to ranges
    keras: bool = False  # LiDAR-SR's original program: no return is 0 and not 1, dropout of single values
    passes: int = within(50, 1, 100_000)  # of LiDAR-SR under Monte-Carlo dropout
    threshold: float = within(
        0.03, -1
    )  # LiDAR-SR drops pixels with a standard deviation above this share of their mean
    depth: int = within(1, 0, 64)  # layers of ILN's transformer
    unfold: bool = False  # LIIF is told the features of 3x3 pixels
    ensemble: bool = True  # LIIF asks four neighbours, not one
    queries: int = within(16_384, 1)  # pixels of a scan that a step of ILN or LIIF learns from

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Adversarial:
    """A GAN and how it is trained; defaults are those of the DUSty v2 program (WACV 2023), the same for all three."""

    latent_channels: int = within(512, 1, 8192)  # of z ~ N(0, I)
    style_channels: int = within(512, 1, 8192)  # of dusty-v2; the styles of the others are z
    max_channels: int = within(512, 1, 8192)  # at the coarsest map; model.base_channels are those of the finest
    discriminator_channels: int | None = within(None, 1, 8192)  # at its finest map; None = model.base_channels
    temperature: float = within(1.0, 1e-6)  # of the Gumbel-sigmoid that drops rays
    iros21: bool = False  # layers of the first release of vanilla GAN and DUSty v1: tanh, mirrored blur
    image_mask: bool = False  # dusty-v1 drops by a second mask, of one draw for all of an image: DUSty-II
    empty_below: float = within(0.0, 0, 1)  # code in [0, 1] up to which a pixel is empty
    r1_weight: float = within(1.0, 0)
    r1_every: int = within(16, 1)  # steps
    path_length_weight: float = within(0.0, 0)  # 0 = off
    path_length_every: int = within(4, 1)  # steps
    augmentation_target: float | None = within(0.6, -2, 2)  # mean sign of real images' logits; None = no augmentation
    augmentation_images: int = within(500_000, 1)  # in which its probability can rise from 0 to 1
    augmentation_every: int = within(4, 1)  # steps between its updates
    warmup_images: int = within(200_000, 0)  # in which pixels are dropped before the discriminator, at first half

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Segmentation:
    """A class for every pixel: RangeNet; `model.base_channels` is its width, 32 in the published networks."""

    layers: int = within(53, 1, 1000)  # 21 | 53
    columns: int | None = within(None, 1, 65_536)  # of a training image, cut out anywhere; None = all
    drop: float = within(0.0, 0, 1)  # augmentation: the largest share of an image's points that is dropped

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Confidence:
    """How sure a trained cascade's new points are: the logarithm of the odds, linear in what the network shows.

    Fitted after the training, on streets it has not seen (`systems.cascade.confidence`). Each is monotone by its sign.
    """

    spread: float = within(0.0, -1000, 0)  # of the candidates among which it chose
    angle: float = within(0.0, -1000, 0)  # to the nearest known return
    answer: float = within(0.0, 0, 1000)  # how likely the ray returns at all
    rows: float = within(0.0, -1000, 0)  # steps in range to the pixels above and below
    columns: float = within(0.0, -1000, 0)  # and to the left and right
    range: float = within(0.0, -1000, 0)
    constant: float = within(0.0, -1000, 1000)
    far: float = within(0.0, -1000, 0)  # by how much the angle is beyond that of a narrow hole

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Training:
    """The optimiser and its budget; defaults are R2DM's."""

    steps: int = within(300_000, 0)
    batch_size: int = within(8, 1, 1_048_576)
    learning_rate: float = within(1e-4, 0, 1e30)
    betas: tuple[float, float] = within((0.9, 0.99), 0, 0.999999)
    warmup: int = within(10_000, 0)  # steps of linear warm-up
    decay: str = "cosine"  # of the rate after that: cosine (half of one, to 0) | constant | inverse | halving
    clip_norm: float | None = within(1.0, 1e-9)  # None = gradients as they are; 0 would learn nothing
    ema_decay: float = within(0.995, 0, 1)
    ema_every: int = within(10, 1)  # steps
    ema_start: int = within(10_000, 0)  # steps of plain copying
    ema_half_life: int = within(10_000, 1)  # images; of GANs, in the place of the three above
    generation_share: float = within(1.0, 0, 1)  # share of a batch without known pixels; 1 for unconditional networks
    upsampling_share: float = within(0.0, 0, 1)  # of the others, knows every fourth beam, begins at pure noise
    metres_weight: float = within(0.1, 0)  # of completion's error in metres, beside that in code
    seed: int = within(0, 0)

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Card:
    """Where weights come from; shown by `lidarsynth info`."""

    licence: str = ""
    data: str = ""  # what was learned from
    history: tuple[str, ...] = ()  # runs: steps, hardware, time
    results: tuple[str, ...] = ()  # measured numbers with their command
    sensor: str = ""  # whose scans alone were seen last
    synthetic: bool = False  # whether these were streets, or insides of buildings, that nobody recorded
    steps: int = within(0, 0)  # of `training.steps`, that the last run has done; 0: not told

    def __post_init__(self):
        check_ranges(self)


@dataclass(frozen=True)
class Experiment:
    """One model, from data to training, as `experiment.json` keeps it beside the weights."""

    name: str
    data: Data = field(default_factory=Data)
    model: Model = field(default_factory=Model)
    diffusion: Diffusion = field(default_factory=Diffusion)
    training: Training = field(default_factory=Training)
    base: str = ""  # cascade: shipped weights that it shares all but `likeliest` and `observer` with, "" = none
    card: Card = field(default_factory=Card)
    score: Score | None = None  # of networks trained by score matching
    upsampling: Upsampling | None = None  # of networks that put beams between known ones
    adversarial: Adversarial | None = None  # of GANs
    segmentation: Segmentation | None = None  # of networks that classify pixels
    confidence: Confidence | None = None  # of cascades that were asked after the training

    def to_dict(self) -> dict:
        """Plain tables, lists and numbers, the inverse of `from_dict`; without the groups that are None."""
        return {key: value for key, value in asdict(self).items() if value is not None}


def from_dict(values: Any, source: str = "experiment", record: type = Experiment) -> Any:
    """An Experiment (or the `record` of it) from plain tables, tolerating absent fields and no unknown ones.

    Raises ValueError that names the field, what was expected and what was found.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{source}: expected a table of {[f.name for f in fields(record)]}, found {values!r:.60}")
    hints = _hints(record)
    if unknown := values.keys() - hints.keys():
        raise ValueError(f"{source}: expected the fields {sorted(hints)}, found {sorted(unknown)}")
    needed = {f.name for f in fields(record) if f.default is MISSING and f.default_factory is MISSING}
    if missing := needed - values.keys():
        raise ValueError(f"{source}: expected the field {', '.join(sorted(missing))}, found {sorted(values)}")
    found = {key: _value(v, hints[key], f"{source}.{key}") for key, v in values.items()}
    try:
        return record(**found)
    except ValueError as error:  # of a range
        raise ValueError(f"{source}.{error}") from None


_hints = lru_cache(get_type_hints)  # of a record, which takes a millisecond


def _value(value: Any, hint: Any, source: str) -> Any:
    """A value as the field's hint wants it: tables become records, lists tuples. Raises ValueError by field."""
    records = [choice for choice in (hint, *get_args(hint)) if is_dataclass(choice)]
    if records and not (value is None and type(None) in get_args(hint)):
        return from_dict(value, source, records[0])  # type: ignore[arg-type]
    value = tuple(value) if isinstance(value, list) else value
    if not any(_fits(value, choice) for choice in (get_args(hint) if isinstance(hint, UnionType) else (hint,))):
        name = hint.__name__ if isinstance(hint, type) and not get_args(hint) else str(hint)
        form = "; it is written as a list, [1, 2]" if name.startswith("tuple") and isinstance(value, str) else ""
        raise ValueError(f"{source}: expected {name}, found {value!r:.60}{form}")
    if get_origin(hint) is tuple and get_args(hint)[0] is float:
        return tuple(map(float, value))  # [0, 0.99]: torch takes no other betas
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
        value = _value(value, _hints(type(part))[name], path)
        try:
            experiment = replace(experiment, **{group: replace(part, **{name: value})})  # type: ignore[type-var]
        except ValueError as error:  # of a range
            raise ValueError(f"{group}.{error}") from None
    return experiment
