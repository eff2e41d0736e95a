"""From first hits to what the laser reports: passes through glass, signal, drop-outs, noise, quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.data.synthetic import facades
from lidarsynth.data.synthetic.materials import NUMBER, TABLE
from lidarsynth.data.synthetic.raycast import Caster
from lidarsynth.data.synthetic.world import FRONT, GROUND, SLAB, World

# Reflectance reported for a signal: steep when dim, flat about 0.3, as KITTI's calibrated intensities are.
RESPONSE = ((-0.02, 0.0, 0.12, 0.2, 0.3, 0.45, 0.7, 1.0), (0.0, 0.02, 0.25, 0.31, 0.37, 0.52, 0.75, 0.99))
FADE = 0.06  # signal lost per natural logarithm of received power
FADE_FROM = 0.0017  # power (cos / m^2) from which it fades: a road 10 m away
VANISH = -0.055  # signal at which half of the returns vanish
VANISH_WIDTH = 0.022
RANGE_NOISE = 0.018  # metres
ROUGH = {"grass": 0.05, "gravel": 0.02, "leaves": 0.03}  # metres, standard deviation of the surface along the beam


@dataclass(frozen=True)
class Returns:
    """What N beams brought back. distance (N,) float32 m along the ray, 0 for none; reflectance (N,); label (N,) uint8."""

    distance: np.ndarray
    reflectance: np.ndarray
    label: np.ndarray


def sense(
    world: World,
    caster: Caster,
    origins: np.ndarray,
    rays: np.ndarray,
    ring_loss: np.ndarray,
    rng: np.random.Generator,
    max_range: float,
) -> Returns:
    """Sends N rays and reports their returns.

    origins, rays (N, 3) float32 world frame; ring_loss (N,) float32 signal each ray's laser loses. The number of random
    draws depends on N only, so a ray that just misses on another machine changes no other ray.
    """
    count = len(rays)
    chance = rng.random((3, count), dtype=np.float32)
    noise = rng.standard_normal((2, count), dtype=np.float32)
    face, distance, cosine = caster.cast(origins, rays)
    material, label, tint, depth = _surface(world, face, origins, rays, distance)
    through = chance[0] < TABLE[material, 5]
    through &= face >= 0
    if through.any():
        far = _behind(world, caster, origins[through], rays[through], distance[through])
        for mine, theirs in zip((face, distance, cosine, material, label, tint, depth), far, strict=True):
            mine[through] = theirs
    signal, grain, gloss, loss = _optics(material, tint, cosine)
    power = np.log(np.maximum(cosine, 0.01) / np.clip(distance, 0.5, 999) ** 2 / FADE_FROM)
    signal = signal + FADE * np.minimum(power, 0) + gloss * np.log(np.maximum(cosine, 0.02)) - ring_loss
    lost = 1 / (1 + np.exp(np.clip((signal + 0.5 * ring_loss - VANISH) / VANISH_WIDTH, -30, 30)))
    gone = (chance[1] < lost) | (chance[2] < loss) | (face < 0)
    distance = distance + depth / np.maximum(cosine, 0.2) + noise[0] * _spread(material)
    gone |= ~(distance < max_range)
    reflectance = np.interp(signal + grain * noise[1], *RESPONSE)
    reflectance = np.round(reflectance.astype(np.float32) * 100) / np.float32(100)
    zero = np.float32(0)
    return Returns(np.where(gone, zero, distance), np.where(gone, zero, reflectance), np.where(gone, 0, label))


def _spread(material: np.ndarray) -> np.ndarray:
    table = np.full(len(TABLE), RANGE_NOISE, np.float32)
    for name, rough in ROUGH.items():
        table[NUMBER[name]] = np.hypot(RANGE_NOISE, rough)
    return table[material]


def _optics(material: np.ndarray, tint: np.ndarray, cosine: np.ndarray) -> tuple[np.ndarray, ...]:
    row = TABLE[material]
    return row[:, 0] + tint * row[:, 1], row[:, 2], row[:, 3], row[:, 4]


def _surface(world: World, face: np.ndarray, origins: np.ndarray, rays: np.ndarray, distance: np.ndarray) -> tuple:
    """Material, label, tint and depth behind the face of N hits; misses get the last triangle's."""
    kind, material, label = world.kind[face], world.material[face], world.label[face]
    tint, depth = world.tint[face], np.zeros(len(face), np.float32)
    hit = face >= 0
    low = np.flatnonzero(hit & ((kind == GROUND) | (kind == SLAB)) & (material != NUMBER["kerb"]))
    spot = origins[low] + rays[low] * distance[low, None]
    material[low], label[low], wear = world.ground.surface(spot[:, 0], spot[:, 1], kind[low] == SLAB)
    tint[low] = wear / TABLE[material[low], 1]
    wall = np.flatnonzero(hit & (kind == FRONT))
    spot = origins[wall] + rays[wall] * distance[wall, None]
    material[wall], depth[wall] = facades.shade(spot, world.fronts[world.front[face[wall]]])
    return material, label, tint, depth


def _behind(world: World, caster: Caster, origins: np.ndarray, rays: np.ndarray, distance: np.ndarray) -> tuple:
    """The hits behind glass, as `_surface` and the caster give them; a second pane ends the beam."""
    step = distance + np.float32(0.05)
    start = origins + rays * step[:, None]
    face, more, cosine = caster.cast(start, rays)
    material, label, tint, depth = _surface(world, face, start, rays, more)
    return face, step + more, cosine, material, label, tint, depth
