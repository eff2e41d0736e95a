"""From first hits to what the laser reports: passes through glass, signal, drop-outs, noise, quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarsynth.streets.hdl64e import Lasers, dipped
from lidarsynth.streets.materials import NUMBER, TABLE
from lidarsynth.streets.raycast import AnyCaster
from lidarsynth.streets.surfaces import Met, surfaces
from lidarsynth.streets.world import World

# Reflectance reported for a signal: nothing when dim, then steep, flat about 0.3, so that the shares of all reported
# values become those of real scans.
RESPONSE = (
    (
        0.026,
        0.030,
        0.044,
        0.056,
        0.071,
        0.103,
        0.128,
        0.150,
        0.186,
        0.217,
        0.262,
        0.311,
        0.366,
        0.432,
        0.513,
        0.66,
        0.8,
    ),
    (
        0.000,
        0.035,
        0.060,
        0.100,
        0.150,
        0.200,
        0.250,
        0.280,
        0.310,
        0.340,
        0.380,
        0.420,
        0.470,
        0.530,
        0.600,
        0.80,
        0.99,
    ),
)
REPORTED = np.round(np.interp(np.arange(801) / 1000, *RESPONSE), 2).astype(np.float32)  # by signal in thousandths
GRAZING = (0.13, 0.17)  # signal lost per natural logarithm of cos(incidence) below the second number
FADE = (0.15, 0.11, 20.0)  # signal lost: a x + b x^2, x = ln(distance / 20 m) where positive
VANISH = -0.14  # signal at which half of the returns vanish
VANISH_WIDTH = 0.014
GLASS = np.uint8(NUMBER["glass"])  # the material that lets beams pass
LOSSY = TABLE[:, 4] > 0  # materials from which a beam may not return at all
PAST = np.float32(0.05)  # metres behind a pane from which a beam goes on
DOUBT = 0.2  # more than VANISH_WIDTH * ln(1e6)
NOISE = (0.0012, 0.004, 0.014)  # metres: standard deviation per metre, least, most
ROUGH = {"grass": 0.035, "gravel": 0.015, "leaves": 0.08, "stone": 0.02, "bark": 0.02}  # metres along the beam


@dataclass(frozen=True)
class Optics:
    """How well a sensor sees. The defaults are those of the sensor that the streets were fitted to.

    loss, dip, shift  per beam, or () for none: signal lost; signal lost at 4 to 6 m; metres read too far
    noise             factor of the range noise
    strength          signal above that sensor's: more of it, fewer drop-outs
    gamma, scale      reported reflectance = scale * reflectance ** gamma, at most 1
    fade              factor of the signal lost with distance
    rough             factor of the roughness of leaves, grass, gravel, stone and bark
    surfaces          per material (signal, spread, grain) as this laser's colour sees it, or () for `materials.TABLE`
    """

    loss: tuple[float, ...] = ()
    dip: tuple[float, ...] = ()
    shift: tuple[float, ...] = ()
    noise: float = 1.0
    strength: float = 0.0
    gamma: float = 1.0
    scale: float = 1.0
    fade: float = 1.0
    rough: float = 1.0
    surfaces: tuple[tuple[float, float, float], ...] = ()

    @property
    def table(self) -> np.ndarray:
        """(materials, 6) float32: `materials.TABLE` as this sensor sees it."""
        if not self.surfaces:
            return TABLE
        return np.concatenate([np.array(self.surfaces, np.float32), TABLE[:, 3:]], 1)

    def reported(self, reflectance: np.ndarray) -> np.ndarray:
        """Reflectance (N,) in [0, 1] as this sensor reports it."""
        if self.gamma == 1 and self.scale == 1:
            return reflectance
        return np.minimum(np.float32(self.scale) * reflectance ** np.float32(self.gamma), np.float32(1))


OPTICS = Optics()


@dataclass(frozen=True)
class Returns:
    """What N beams brought back: distance (N,) float32 m along the ray, 0 for none; reflectance and label (N,).

    face, first (N,) int32: the triangle of the return, whether it was noticed or not, and the one that the beam met
    first, which may be a pane before it; -1 for none. surface (N,) float32 m, surface_label (N,): exactly where that
    one is, infinite for none, and its class.
    """

    distance: np.ndarray
    reflectance: np.ndarray
    label: np.ndarray
    face: np.ndarray
    first: np.ndarray
    surface: np.ndarray
    surface_label: np.ndarray


def sense(
    world: World,
    caster: AnyCaster,
    origins: np.ndarray,
    rays: np.ndarray,
    lasers: Lasers,
    rng: np.random.Generator,
    max_range: float,
    eye: Optics = OPTICS,
    times: np.ndarray | None = None,
) -> Returns:
    """Sends N rays and reports their returns.

    origins, rays (N, 3) float32 world frame; times (N,) seconds, where something moves. The number of
    random draws depends on N only, so a ray that just misses on another machine changes no other ray.
    """
    count = len(rays)
    chance = rng.random((2, count), dtype=np.float32)
    noise = rng.standard_normal((3, count), dtype=np.float32)
    met = Met(origins, rays, *caster.cast(origins, rays, times))
    where = _through(world, met.face, lasers.number, chance[0])
    beyond = _beyond(caster, met, where, None if times is None else times[where])
    (material, label, tint, depth), behind = surfaces(world, met, beyond)
    face, distance, cosine = met[2:]
    deeper, missed = depth / np.maximum(cosine, 0.12), np.flatnonzero(face < 0)
    first, surface, surface_label = face.copy(), distance + deeper, label.copy()
    surface[missed], surface_label[missed] = np.inf, 0
    if len(where):
        pane = distance.take(where) + PAST
        for mine, theirs in ((face, beyond.face), (distance, pane + beyond.distance), (cosine, beyond.cosine),
                             (material, behind.material), (label, behind.label), (tint, behind.tint),
                             (deeper, behind.depth / np.maximum(beyond.cosine, 0.12))):  # fmt: skip
            mine[where] = theirs
    made_of = material.astype(np.intp)
    optics = [column.take(made_of, mode="wrap") for column in eye.table.T[:4]]
    strength = _signal(optics, tint, cosine, distance, lasers, eye.fade)
    signal = strength - lasers.dip * dipped(distance)
    gone, lossy = face < 0, np.flatnonzero(LOSSY.take(made_of, mode="wrap"))
    steady = _steady(first.take(lossy), lasers.number.take(lossy))
    gone[lossy] |= 0.7 * steady + 0.3 * chance[0].take(lossy) > 1 - TABLE[:, 4].take(made_of.take(lossy))
    faint = np.flatnonzero(strength < VANISH - eye.strength + DOUBT)  # the others return for sure
    gone[faint] |= strength.take(faint) + _doubt(chance[1].take(faint)) < VANISH - eye.strength
    distance = (
        distance + deeper + noise[0] * np.float32(eye.noise) * _spread(made_of, distance, eye.rough) + lasers.shift
    )
    gone |= ~(distance < max_range)
    reflectance = eye.reported(_read(signal, optics[2], noise[1:]))
    lost = np.flatnonzero(gone)
    distance[lost], reflectance[lost], label[lost] = 0, 0, 0
    return Returns(distance, reflectance, label, face, first, surface, surface_label)


def _signal(
    optics: list[np.ndarray], tint: np.ndarray, cosine: np.ndarray, distance: np.ndarray, lasers: Lasers, fade: float
) -> np.ndarray:
    """(N,) signal before its noise: material, incidence, distance, the laser's own loss. optics: columns of TABLE."""
    slant = np.log(np.maximum(cosine, 0.01))
    signal = optics[0] + tint * optics[1] + optics[3] * slant
    signal += GRAZING[0] * np.minimum(slant - np.float32(np.log(GRAZING[1])), 0)
    dimmed = np.flatnonzero(distance > FADE[2])
    far = np.log(np.maximum(np.minimum(distance.take(dimmed), 999) / FADE[2], 1))
    signal[dimmed] -= np.float32(fade) * far * (FADE[0] + FADE[1] * far)
    return signal - lasers.loss


def _read(signal: np.ndarray, spread: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Reflectance (...) of signals whose speckle spreads so much; noise (2, ...) unit Gaussians.

    Speckle is multiplicative and its tails are longer than a Gaussian's; what reads 0 reads 0 all over.
    """
    grain = spread * np.clip(signal / 0.3, 0.1, 2) * noise[0] * (0.5 + 0.85 * np.abs(noise[1]))
    step = np.clip((signal + grain) * 1000, 0, len(REPORTED) - 1).astype(np.intp)
    return REPORTED.take(step, mode="wrap")


def speckled(reflectance: np.ndarray, spread: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Reflectance (...) float32 as it is read with the speckle of its material, given as it is on average.

    spread  (...) `grain` of the materials, `materials.TABLE[:, 2]`; noise (2, ...) unit Gaussians
    """
    signals = (0.0, *RESPONSE[0][1:])
    return _read(np.interp(reflectance, RESPONSE[1], signals).astype(np.float32), spread, noise)


def flat_ground(material: str, distance: np.ndarray, height: float, lasers: Lasers) -> np.ndarray:
    """Reflectance (N,) on average that N lasers read of flat ground, metres away (N,), seen from a height in metres."""
    cosine = np.minimum(height / np.maximum(distance, 1e-3), 1).astype(np.float32)
    optics, tint = list(TABLE[NUMBER[material], :4, None]), np.zeros(1, np.float32)
    signal = _signal(optics, tint, cosine, distance, lasers, OPTICS.fade) - lasers.dip * dipped(distance)
    return np.interp(signal, *RESPONSE).astype(np.float32)


def _doubt(chance: np.ndarray) -> np.ndarray:
    """(N,) signal by which the limit at which a return vanishes is missed, DOUBT at most: logistic in the chance."""
    return VANISH_WIDTH * np.log(np.maximum(chance, 1e-6) / np.maximum(1 - chance, 1e-6))


def _steady(face: np.ndarray, number: np.ndarray) -> np.ndarray:
    """(N,) in [0, 1): a chance that one laser on one face keeps, so that panes drop out in stripes, not in grains."""
    mixed = (face >> 1).astype(np.uint32) * np.uint32(2654435761) + (number >> 1) * np.uint32(1779033703)
    return (mixed >> np.uint32(16)).astype(np.float32) * np.float32(2**-16)


def range_noise(distance: np.ndarray) -> np.ndarray:
    """(N,) metres, standard deviation of the sensor's range at distances (N,) in metres, on a smooth surface."""
    return np.clip(distance * np.float32(NOISE[0]), *NOISE[1:])


def _spread(material: np.ndarray, distance: np.ndarray, factor: float) -> np.ndarray:
    """(N,) metres, standard deviation of the range: the sensor's noise and the surface's roughness."""
    table = np.zeros(len(TABLE), np.float32)
    for name, rough in ROUGH.items():
        table[NUMBER[name]] = rough * factor
    spread, uneven = range_noise(distance), np.flatnonzero((table > 0).take(material, mode="wrap"))
    spread[uneven] = np.hypot(table.take(material.take(uneven)), spread.take(uneven))
    return spread


def _through(world: World, face: np.ndarray, number: np.ndarray, luck: np.ndarray) -> np.ndarray:
    """Numbers of the beams that pass through what they met; luck (N,) in [0, 1)."""
    pane = np.flatnonzero((world.material.take(face, mode="wrap") == GLASS) & (face >= 0))
    steady = _steady(face.take(pane), number.take(pane))
    return pane.compress(0.8 * steady + 0.2 * luck.take(pane) < TABLE[GLASS, 5])


def _beyond(caster: AnyCaster, met: Met, where: np.ndarray, times: np.ndarray | None) -> Met:
    """What the beams of the numbers `where` meet behind what they met; a second pane ends the beam."""
    rays, step = met.rays.T.take(where, axis=1).T, met.distance.take(where) + PAST
    origins = met.origins.T.take(where, axis=1).T + rays * step[:, None]
    if not len(where):
        return Met(origins, rays, met.face[:0], step, step)
    return Met(origins, rays, *caster.cast(origins, rays, times))
