"""Rain and fog on a turn, after published models: attenuation, scatter before the target, returns lost.

Rain: LISA (Kilic et al., arXiv 2107.07004): Marshall-Palmer drops, the strongest of those in a beam against the target.
Fog: Hahner et al., ICCV 2021: the echo of the fog itself against that of the target.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.turn import Turn, local_points

DIVERGENCE = 3e-3  # rad, of the beam (LISA)
SMALLEST = 0.05  # mm, diameter of a drop (LISA)
WATER = 1.328  # refractive index (LISA)
LEAST = 0.9  # power of a target that is just seen at the longest range, times that range squared (LISA)
ACCURACY = 0.09  # m, range resolution (LISA)
PULSE = 20e-9  # s, half-power width of the pulse (Hahner et al.)
LIGHT = 299_792_458.0  # m/s
TARGET = 1e-6 / np.pi  # differential reflectivity of the reference target (Hahner et al.)
DIM = 0.02  # reflectance that a return of reflectance 0 is taken for


@dataclass(frozen=True)
class Weather:
    """rain: mm/h, 0 for none. fog: m of meteorological optical range (how far one sees), 0 for none."""

    rain: float = 0.0
    fog: float = 0.0

    def __post_init__(self):
        if not (0 <= self.rain <= 200 and (self.fog == 0 or 5 <= self.fog <= 10_000)):
            raise ValueError(f"expected rain of 0 to 200 mm/h and fog of 5 to 10000 m of sight, or 0 for none, found "
                             f"{self.rain} and {self.fog}")  # fmt: skip

    def on(self, turn: Turn, sensor: Sensor, rng: np.random.Generator) -> Turn:
        """The turn in this weather; returns of the weather itself have label 0 and face -1."""
        turn = in_fog(turn, sensor, self.fog, rng) if self.fog else turn
        return in_rain(turn, sensor, self.rain, rng) if self.rain else turn


CLEAR = Weather()


def rain_extinction(rate: float) -> float:
    """1/m lost by rain of `rate` mm/h: pi/4 1e-6 integral of D^2 Q N(D) dD, Q = 2, N(D) = 8000 exp(-L D) /m^3/mm."""
    return np.pi * 8000 * 1e-6 / _slope(rate) ** 3


def _slope(rate: float) -> float:
    """1/mm, L of Marshall and Palmer (1948)."""
    return 4.1 * rate**-0.21


def fog_extinction(sight: float) -> float:
    """1/m lost by fog in which one sees `sight` m: ln 20 / MOR."""
    return float(np.log(20) / sight)


def in_rain(turn: Turn, sensor: Sensor, rate: float, rng: np.random.Generator) -> Turn:
    """LISA: a drop that echoes stronger than the target takes its place; what is too weak is lost."""
    alpha, shape = rain_extinction(rate), turn.distance.shape
    hit, distance = turn.distance > 0, turn.distance
    power = _power(turn, sensor, rng)
    power, limit = power * np.exp(-2 * alpha * distance), LEAST / sensor.max_range**2
    echo, place = strongest_drop(rate, sensor.min_range, rng, shape)
    lost = hit & (power < limit)
    scattered = (echo > np.maximum(power, limit)) & ((place < distance) | ~hit | lost)
    scattered &= hit | (turn.face < 0)  # not where the carrier blocks the beam
    spread = ACCURACY / np.sqrt(2 * np.maximum(power, limit) / limit)
    moved = np.where(hit & ~lost, distance + rng.standard_normal(shape) * spread, 0)
    dimmed = np.where(lost, 0, turn.reflectance * np.exp(-2 * alpha * distance))
    bright = np.minimum(echo * place**2, 1)
    return _reported(turn, sensor, np.where(scattered, place, moved), np.where(scattered, bright, dimmed), scattered)


def in_fog(turn: Turn, sensor: Sensor, sight: float, rng: np.random.Generator) -> Turn:
    """Hahner et al.: i_hard = i exp(-2 alpha R), i_soft = i R^2 I_max beta / beta_0; the stronger is reported.

    Beams without a target stay without, as in their model. What LISA's threshold finds too weak is lost.
    """
    alpha, beta = fog_extinction(sight), 0.046 / sight
    distance, shape = turn.distance, turn.distance.shape
    hit = distance > 0
    peak, place = fog_echo(alpha, np.minimum(distance, 200))
    hard = turn.reflectance * np.exp(-2 * alpha * distance)
    level = np.maximum(turn.reflectance, DIM)
    soft = level * distance**2 * peak * beta / TARGET
    faint = _power(turn, sensor, rng) * np.exp(-2 * alpha * distance) < LEAST / sensor.max_range**2
    scattered = hit & (soft > level * np.exp(-2 * alpha * distance))
    near = place * (1 + 0.1 * rng.uniform(-1, 1, shape))
    moved = np.where(scattered, near, np.where(hit & ~faint, distance, 0))
    return _reported(turn, sensor, moved, np.where(scattered, np.minimum(soft, 1), hard), scattered)


def _power(turn: Turn, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(H, W) reflectance / range^2; what the clear turn did see had at least what can be seen, by an unknown margin."""
    margin = np.exp(0.5 * np.abs(rng.standard_normal(turn.distance.shape)))
    floor = margin * LEAST * (turn.distance / sensor.max_range) ** 2
    return np.maximum(np.maximum(turn.reflectance, DIM), floor) / np.maximum(turn.distance, 0.1) ** 2


def _reported(turn: Turn, sensor: Sensor, distance: np.ndarray, reflectance: np.ndarray, scattered: np.ndarray) -> Turn:
    seen = (distance >= sensor.min_range) & (distance < sensor.max_range)
    distance = np.where(seen, distance, 0).astype(np.float32)
    reflectance = np.round(np.where(seen, reflectance, 0), 2).astype(np.float32)
    label = np.where(seen & ~scattered, turn.label, 0).astype(turn.label.dtype)
    face = np.where(scattered, -1, turn.face).astype(np.int32)
    points = local_points(turn.rays, distance, sensor)
    return replace(turn, points=points, distance=distance, reflectance=reflectance, label=label, face=face)


@lru_cache(maxsize=4)
def _fog_table(alpha: float) -> tuple[np.ndarray, np.ndarray]:
    """Peak of the fog's echo (per C_A P_0 beta) and where it is, for targets at 0, 0.1 ... 200 m."""
    far = np.arange(0, 200.1, 0.1)
    t = np.linspace(0, 2 * PULSE, 81)
    pulse = np.sin(np.pi * t / (2 * PULSE)) ** 2 * (t[1] - t[0])
    r = far[:, None] - LIGHT * t / 2  # where light that arrives with R's came from
    overlap = np.clip((r - 0.9) / 0.1, 0, 1)  # xi(R): the receiver sees nothing nearer than 0.9 m
    echo = (pulse * np.exp(-2 * alpha * r) / np.maximum(r, 0.5) ** 2 * overlap).sum(axis=1)
    best = np.maximum.accumulate(echo)
    first = np.maximum.accumulate(np.where(echo >= best, np.arange(len(far)), 0))
    return best, np.maximum(far[first], 0.1)


def fog_echo(alpha: float, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The fog's strongest echo before a target at `distance` m (any shape), and the range at which it is reported."""
    peak, place = _fog_table(alpha)
    index = np.clip((np.asarray(distance) * 10).astype(int), 0, len(peak) - 1)
    return peak[index], place[index]


@lru_cache(maxsize=4)
def _drop_table(rate: float, nearest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """powers (P,) falling; drops per beam that echo stronger (P,); ranges (R,); for each power, their share up to r.

    A drop of diameter D at r echoes F exp(-2 alpha r) (D / (r tan(divergence)))^2 / r^2; 8000 exp(-L D) dD of them are
    in a cubic metre, and the beam's cross-section is pi (r tan(divergence) / 2)^2.
    """
    slope, alpha = _slope(rate), rain_extinction(rate)
    fresnel, tangent = ((WATER - 1) / (WATER + 1)) ** 2, np.tan(DIVERGENCE)
    r = np.geomspace(nearest, 60, 240)
    widths = np.gradient(r)
    powers = np.geomspace(1e-1, 1e-8, 280)
    mirror = fresnel * np.exp(-2 * alpha * r) / r**2  # of a drop as wide as the beam
    size = 1e3 * r * tangent * np.sqrt(np.minimum(powers[:, None] / mirror, 1))  # mm
    able = powers[:, None] <= mirror
    area = np.pi * (r * tangent / 2) ** 2 * widths
    count = (able * area * 8000 / slope * np.exp(-slope * np.maximum(size, SMALLEST))).sum(axis=1)
    density = able * area * 8000 * np.exp(-slope * np.maximum(size, SMALLEST)) * size * (size >= SMALLEST) + 1e-300
    share = np.cumsum(density, axis=1)
    return powers, count, r, share / share[:, -1:]


def strongest_drop(
    rate: float, nearest: float, rng: np.random.Generator, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Echo (as reflectance / range^2) and range in m of the strongest drop in each beam, 0 where there is none.

    The drops that echo stronger than p are Poisson in number, so the strongest is below p with chance exp(-count(p)).
    """
    powers, count, r, share = _drop_table(rate, max(nearest, 0.5))
    wanted = -np.log(np.maximum(rng.random(shape), 1e-12))
    index = np.searchsorted(count, wanted)
    there = index < len(powers)
    index = np.minimum(index, len(powers) - 1)
    draw = rng.random(shape)
    flat = share.ravel() + np.repeat(np.arange(len(powers)), len(r))  # rows one after another, each 0 to 1
    place = np.searchsorted(flat, index + draw) - index * len(r)
    return np.where(there, powers[index], 0), r[np.clip(place, 0, len(r) - 1)]
