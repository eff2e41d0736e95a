"""How a sensor reports reflectance, where nobody has measured it: found out from the scan itself.

Virtual sensors of training report scale * reflectance ** gamma, and some beams less than others (`streets.Optics`);
others report the energy that came back, which fades with distance. Of a recorded scan all this is estimated from its
known pixels, so that a network sees it as the streets it has learned, and what it answers is said in the sensor's own
terms. Measured in docs/completion.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.fill_unet import NOISES, Filled, FillUNet, Known
from lidarsynth.networks.interpolation import interpolate
from lidarsynth.networks.rays import Rays, padded
from lidarsynth.streets import hdl64e
from lidarsynth.systems.cascade.known import known_of

STREETS = (0.200, 0.290, 0.349)  # quartiles of what streets reflect, zeros aside, as `hdl-64e-kitti` reports it
GAMMAS = (0.4, 2.5)
LEAST, NARROWEST = 0.002, 0.05  # reflectance; natural logarithm between the quartiles
UNIT = 0.69  # natural logarithm of how far a scan's median may be off KITTI's; 111 of its own are within 0.19
ENOUGH = 50  # returns
SECTORS, FEW = 12, 12  # of a turn, in which beams are compared; returns of both beams in one
SHARES = tuple(k / 10 for k in range(11))  # of the mean of what is known around
PARTS, WIDTH, SEAM = 8, 64, 16  # parts of the turn in which they are tried, columns of each, and of its ends not judged
# Where nothing can be tried, or beams are measured: less errs by 1 % less there, but classes are read worse
# (docs/completion.md).
USUAL = 0.5
ALIKE = 0.15  # natural logarithm of ranges that differ as on one surface
BINS, MOST = 12, 2.0  # of ranges, of as many returns each; the largest exponent, of energy that spreads on a sphere
NEAR = (0.1, 2.0, 4.0, 6.0, 8.0, 10.0)  # metres, from which on what fades does
BRIGHT = 0.99  # share of the known returns that are less than 1 when they are unfaded
# How steeply the logarithm of the medians falls, by the spread within a range, where a scan fades a little, and surely.
# Streets and real training scans fall less, reported with any gamma, and so do insides with few exceptions.
LITTLE, SURELY = 1.3, 1.8


class Response(NamedTuple):
    """scale * reported ** gamma, in [0, 1], plus how dim a beam is, is what even beams of the streets' sensor report.

    scale, gamma  positive; dimness (H,), in reflectance, or () for what the sensor itself says; the defaults change
    nothing. plain: share of 0 to 1 that the mean of what is known around, calm, has in the most likely reflectance,
    beside the network's. straight: then, in what is reported, the share of the line between the nearest known returns.
    fades: from `near` metres on what is reported falls as metres ** -fades; all before is of what is `unfaded`, by
    that and by `level`.
    """

    scale: float = 1.0
    gamma: float = 1.0
    dimness: tuple[float, ...] = ()
    plain: float = 0.0
    straight: float = 0.0
    fades: float = 0.0
    near: float = NEAR[0]
    level: float = 1.0

    def unfaded(self, image: RangeImage) -> RangeImage:
        """The image with reflectances that do not fade with distance, 1 at most."""
        if not self.fades:
            return image
        return replace(image, reflectance=np.minimum(image.reflectance * self._lost(image.range), np.float32(1)))

    def faded(self, unfaded: np.ndarray, metres: np.ndarray) -> np.ndarray:
        """Reflectances of `unfaded` as they are reported of `metres`, both of any shape; 1 at most."""
        return np.minimum(unfaded / self._lost(metres), np.float32(1)) if self.fades else unfaded

    def _lost(self, metres: np.ndarray) -> np.ndarray:
        """By how much less than unfaded reflectance is at `metres`, of any shape."""
        return np.float32(self.level) * np.maximum(metres, np.float32(self.near)) ** np.float32(self.fades)

    def even(self, reported: np.ndarray) -> np.ndarray:
        """Reflectance in [0, 1] of any shape as the streets' sensor would report it, but for the beams' dimness."""
        if (self.scale, self.gamma) == (1, 1):
            return reported
        return np.minimum(np.float32(self.scale) * reported ** np.float32(self.gamma), np.float32(1))

    def reported(self, even: np.ndarray) -> np.ndarray:
        """The inverse of `even`, of any shape, at most 1."""
        if (self.scale, self.gamma) == (1, 1):
            return even
        return np.minimum((even / np.float32(self.scale)) ** np.float32(1 / self.gamma), np.float32(1))

    def mixed(self, filled: Filled) -> Tensor:
        """(B, 1, H, W) the most likely reflectance, as the streets' sensor would report it."""
        if not self.plain:
            return filled.reflectance
        assert filled.plain is not None
        return torch.lerp(filled.reflectance, filled.plain, self.plain)

    def straightened(self, reported: np.ndarray, image: RangeImage, known: np.ndarray) -> np.ndarray:
        """(H, W) the most likely reflectance, as reported, with its share of the line between known returns; all
        that is reported unfaded."""
        if not self.straight:
            return reported
        return (1 - np.float32(self.straight)) * reported + np.float32(self.straight) * line(image, known)

    def told(self, rays: Rays) -> Rays:
        """The rays (B, 1, H', W'), with the beams' dimness."""
        if not self.dimness:
            return rays
        dim = torch.zeros_like(rays.dimness)
        dim[:, :, : len(self.dimness), 0] = torch.tensor(self.dimness)
        return rays._replace(dimness=dim)

    def unevenness(self, sensor: Sensor) -> np.ndarray:
        """(H, 1) float32: how much less than the mean beam each one reads."""
        return np.array(self.dimness, np.float32)[:, None] if self.dimness else hdl64e.unevenness(sensor)


AS_STREETS = Response()


def response_of(image: RangeImage, known: np.ndarray, tuned: bool = False) -> Response:
    """By the known returns of an image, known (H, W) bool.

    `AS_STREETS`, which changes nothing, for a sensor whose beams are measured, and for fewer than 50 returns. A scan of
    `hdl-64e-kitti` that reports twice or half of what KITTI's does is taken for another unit's, of unknown beams. A
    model that was `tuned` to scans of the sensor knows how they fade.
    """
    lit = known & image.mask & (image.reflectance > 0)
    if lit.sum() < ENOUGH:
        return AS_STREETS
    of_kitti = abs(np.log(max(np.median(image.reflectance[lit]), LEAST)) - np.log(STREETS[1])) < UNIT
    if image.sensor.dimness or (hdl64e.dimness(image.sensor) and of_kitti):
        return AS_STREETS
    fading = AS_STREETS if tuned else _fading(image.reflectance[lit], image.range[lit])
    unfaded = fading.unfaded(image).reflectance
    low, middle, high = np.log(np.maximum(np.quantile(unfaded[lit], (0.25, 0.5, 0.75)), LEAST))
    gamma = float(np.clip(np.log(STREETS[2] / STREETS[0]) / max(high - low, NARROWEST), *GAMMAS))
    response = fading._replace(scale=float(STREETS[1] / np.exp(gamma * middle)), gamma=gamma)
    dim = dimness_of(response.even(unfaded), image.range, known & image.mask)
    return response._replace(dimness=tuple(dim.tolist()))


def _fading(reflectance: np.ndarray, metres: np.ndarray) -> Response:
    """How reflectances (N,) above 0 of returns at metres (N,) fade with the distance; not where they fall no more than
    surfaces do that are farther: by medians of bins of ranges, of as many returns each."""
    if len(metres) < BINS * ENOUGH:
        return AS_STREETS
    order = np.argsort(metres, kind="stable")
    far, light = np.log(np.maximum(metres[order], 0.1)), np.log(reflectance[order])
    bins = np.array_split(np.arange(len(order)), BINS)
    low, middle, high = np.array([np.quantile(light[part], (0.25, 0.5, 0.75)) for part in bins]).T
    medians, fits = np.array([np.median(far[part]) for part in bins]), []
    for near in (near for near in NEAR if near == NEAR[0] or np.log(near) < np.median(far)):
        away = np.maximum(medians, np.log(near))
        away -= away.mean()
        slope = -(away @ middle) / max(away @ away, 0.1)
        fits.append((np.var(middle + slope * away), slope, near))
    _, slope, near = min(fits)
    shown = slope / max(np.median(high - low), NARROWEST)
    fades = float(np.clip(slope, 0, MOST) * np.clip((shown - LITTLE) / (SURELY - LITTLE), 0, 1))
    if not fades:
        return AS_STREETS
    fading = Response(fades=fades, near=near)
    brightest = np.quantile(reflectance * fading._lost(metres), BRIGHT)
    return fading._replace(level=float(1 / brightest))


def tried(
    response: Response,
    fill: FillUNet,
    image: RangeImage,
    told: np.ndarray,
    reflectance: np.ndarray,
    rays: Rays,
    tuned: bool = False,
) -> Response:
    """The response with the shares of the mean, and of the line between returns, that suit the scan: every second known
    beam of some parts of the turn is hidden and filled, and those taken that err least.

    image unfaded; told (H, W) bool; reflectance (H, W), even, as the fill is told it; rays of the padded image. Of a
    sensor whose beams are measured, and where fewer than four beams return enough, the usual share; where no
    reflectance is known, and for a fill that was `tuned` to scans of the sensor, none.
    """
    returned = told & image.mask
    if tuned or not image.reflectance[returned].any():
        return response
    rows, size = np.flatnonzero(returned.sum(1) >= ENOUGH), padded(image.sensor)
    hidden = np.zeros_like(told)
    hidden[rows[1::2]] = True
    columns = _columns(size[1])
    inside = slice(SEAM, -SEAM if columns.shape[1] > 2 * SEAM else None)
    of_image = columns[:, inside] % told.shape[1]
    judged, truth = (part[:, of_image].transpose(1, 0, 2) for part in (returned & hidden, image.reflectance))
    if response == AS_STREETS or len(rows) < 4 or judged.sum() < ENOUGH:
        return response._replace(plain=USUAL)
    known = known_of(image.range[None], reflectance[None], (told & ~hidden)[None], True, size)
    device = next(fill.parameters()).device
    known = Known(*(_cut(part, columns).to(device) for part in known))
    rays = Rays(*(_cut(part, columns).to(device) for part in rays))
    with torch.inference_mode():
        filled = fill(known, rays, known.metres.new_zeros(len(columns), NOISES, size[0], columns.shape[1]))

    assert filled.plain is not None
    parts = (part[:, 0, : truth.shape[1], inside] for part in (filled.reflectance, filled.plain))
    answer, mean = (part.float().cpu().numpy()[judged] for part in parts)
    between = line(image, told & ~hidden)[:, of_image].transpose(1, 0, 2)[judged]
    errors = {}
    for share in SHARES:
        mixed = response.reported((answer + share * (mean - answer)).clip(0, 1))
        for straight in SHARES:
            errors[share, straight] = np.abs(mixed + straight * (between - mixed) - truth[judged]).mean()
    share, straight = min(errors, key=errors.__getitem__)
    return response._replace(plain=share, straight=straight)


def line(image: RangeImage, known: np.ndarray) -> np.ndarray:
    """(H, W) reflectance as reported, between the nearest known returns above, below and beside, known (H, W) bool."""
    returned = torch.from_numpy(known & image.mask)[None, None]
    return interpolate(torch.from_numpy(image.reflectance)[None, None], returned)[0, 0].numpy().clip(0, 1)


def _columns(turn: int) -> np.ndarray:
    """(PARTS, WIDTH) columns of parts of a turn, one of them ahead; fewer where the turn is too short."""
    count, width = max(1, min(PARTS, turn // WIDTH)), min(WIDTH, turn)
    first = np.arange(count) * turn // count + (turn - width) // 2
    return (first[:, None] + np.arange(width)) % turn


def _cut(part: torch.Tensor, columns: np.ndarray) -> torch.Tensor:
    """(P, 1, H, C) columns (P, C) of a turn (1, 1, H, W), or of what is alike in all columns, (1, 1, H, 1)."""
    if part.shape[3] == 1:
        return part.expand(len(columns), *part.shape[1:])
    return part[0, 0][:, torch.from_numpy(columns)].transpose(0, 1)[:, None].contiguous()


def dimness_of(reflectance: np.ndarray, metres: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """(H,) how much less each beam reads than it and its known neighbours above and below on average; all (H, W).

    In each sector of the turn by the median half of the differences where both beams meet something equally far; less
    of it, the less the sectors agree. 0 where less than three sectors say anything.
    """
    dim, rows = np.zeros(len(reflectance), np.float32), np.flatnonzero(returned.sum(1) >= ENOUGH)
    if len(rows) < 3:
        return dim
    steps = _steps(reflectance[rows], np.log(np.maximum(metres[rows], 0.1)), returned[rows])
    bend = (steps[1:] - steps[:-1]) / 3
    count = np.isfinite(bend).sum(1)
    total = np.maximum(count, 1)
    mean = np.nansum(bend, 1) / total
    doubt = np.nansum((bend - mean[:, None]) ** 2, 1) / (np.maximum(count - 1, 1) * total)
    dim[rows[1:-1]] = np.where(count >= 3, mean**3 / (mean**2 + doubt + 1e-9), 0)
    return dim


def _steps(reflectance: np.ndarray, height: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """(R - 1, SECTORS) by how much each row is brighter than the one above it; nan where too few pixels tell."""
    whole = reflectance.shape[1] // SECTORS * SECTORS
    both = returned[1:] & returned[:-1] & (np.abs(height[1:] - height[:-1]) < ALIKE)
    step = np.where(both, reflectance[1:] - reflectance[:-1], np.nan)[:, :whole].reshape(len(both), SECTORS, -1)
    step = np.sort(step, axis=2)  # nan is last
    count = np.isfinite(step).sum(2, keepdims=True)
    rank = np.arange(step.shape[2])
    middle = (rank >= count // 4) & (rank < count - count // 4)
    mean = np.where(middle, step, 0).sum(2) / np.maximum(middle.sum(2), 1)
    return np.where(count[..., 0] >= FEW, mean, np.nan)
