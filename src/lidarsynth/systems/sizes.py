"""Which widths, blocks and sizes of images networks can be built of: said by the fields of an experiment."""

from __future__ import annotations

from collections.abc import Mapping

from lidarsynth.experiment.record import Model, Upsampling
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.gan.dcgan import LEVELS as GAN_LEVELS

LEVELS = 4  # of R2DM's U-Net, which halves the image at three of them
GAN_STEP = 2**GAN_LEVELS  # rows and columns of an image for one at the coarsest map of a GAN, of DUSty v2's, too
SR_STEP = 16  # and of LiDAR-SR
REFINENET_LEAST = 8  # rows and columns that LiDARGen's network needs


def check_unet(model: Model) -> None:
    """Raises ValueError by the field for numbers that R2DM's U-Net cannot be built of."""
    for name in ("channel_multipliers", "num_residual_blocks"):
        values = getattr(model, name)
        if len(values) != LEVELS or min(values) < 1:
            raise ValueError(f"model.{name}: expected {LEVELS} numbers of at least 1, found {list(values)}")
    widths = [model.base_channels, *(model.base_channels * factor for factor in model.channel_multipliers)]
    if any(width % model.gn_num_groups for width in widths):
        raise ValueError(f"model.gn_num_groups must divide all level widths {widths}, got {model.gn_num_groups}")
    check_divisor("model.attn_num_heads", model.attn_num_heads, widths[-2:])
    if model.base_channels < 4 or model.base_channels % 2:
        raise ValueError(f"model.base_channels: expected an even number of at least 4, found {model.base_channels}")


def check_divisor(name: str, number: int, widths: list[int]) -> None:
    """Raises ValueError by `name` unless the number divides all widths of channels."""
    if any(width % number for width in widths):
        raise ValueError(f"{name}: expected a divisor of {', '.join(map(str, widths))} channels, found {number}")


def check_multiples(fields: Mapping[str, tuple[int, int]]) -> None:
    """Raises ValueError by the field for a number, 0 for none of it, that is no multiple of what it has to be."""
    for name, (number, step) in fields.items():
        if number % step:
            raise ValueError(f"{name}: expected a multiple of {step}, found {number}")


def check_stem(model: Model, sensor: Sensor) -> None:
    """Raises ValueError for an image that R2DM's U-Net cannot halve three times, once it is patches of its stem."""
    for name, size, stem in zip(("height", "width"), (sensor.height, sensor.width), model.stem, strict=True):
        step = 2 ** (LEVELS - 1) * stem
        if size % step:
            near = " or ".join(str(n) for n in (size // step * step, (size // step + 1) * step) if n)
            raise ValueError(f"data.{name} must be divisible by {step}, as model.stem is {list(model.stem)}: expected "
                             f"{near}, found {size}")  # fmt: skip


def check_refinenet(word: str, sensor: Sensor) -> None:
    """Raises ValueError for an image that LiDARGen's network cannot halve, or is too small for it."""
    sides = sensor.height, sensor.width
    if any(side % 2 for side in sides) or min(sides) < REFINENET_LEAST:
        raise ValueError(f"{word}: expected images of an even number of rows and columns, {REFINENET_LEAST} at least, "
                         f"found {sides[0]} x {sides[1]}")  # fmt: skip


def check_gan(word: str, sensor: Sensor) -> None:
    """Raises ValueError for an image that a GAN's generator cannot end with."""
    sides = sensor.height, sensor.width
    if any(side % GAN_STEP for side in sides) or min(sides) < 2 * GAN_STEP:
        raise ValueError(f"{word}: expected images whose sides are multiples of {GAN_STEP}, {2 * GAN_STEP} at least, "
                         f"found {sides[0]} x {sides[1]}")  # fmt: skip


def check_lidar_sr(group: Upsampling, sensor: Sensor) -> None:
    """Raises ValueError for a factor that LiDAR-SR does not grow by, and for an image that it cannot end with."""
    rows, columns = group.factor
    if any(factor & (factor - 1) for factor in group.factor) or rows < max(2, columns):
        raise ValueError("upsampling.factor: expected two powers of 2, the first at least 2 and the second at most the "
                         f"first, found {list(group.factor)}")  # fmt: skip
    sides = sensor.height, sensor.width
    steps = max(rows, SR_STEP), max(columns, SR_STEP)
    if any(side % step for side, step in zip(sides, steps, strict=True)):
        raise ValueError(f"lidar-sr: expected images of a multiple of {steps[0]} rows and of {steps[1]} columns, found "
                         f"{sides[0]} x {sides[1]}")  # fmt: skip
