"""The surfaces of a generated grid, flat, upright, of one reflectance where they nearly are: else noise makes waves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.semantic_kitti import CLASS_NUMBER
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.column_neighbours import Grid
from lidarsynth.systems.cascade.images import texture

# Rounds; the share of the range within which a return is of its neighbours' surface, between what was drawn between
# columns that are straight already, and from beam to beam, where the foot of a wall is no slope; all chosen by street-2
# (docs/generation.md). A step between beams that is less than GROUND of flat ground's is none of the ground.
ROUNDS, NEAR, FINE, CORNER, GROUND = 4, 0.04, 0.0035, 0.03, 0.3
# The same from beam to beam on the ground, within LOW of flat ground's nearness, where a kerb of 12 cm is 7 % of the
# range; and between what was drawn between beams that are straight already, on the ground and elsewhere, where so many
# degrees hold three beams: farther apart, surfaces differ by more than what is drawn errs.
LOW, KERB, BUMP, DENT, CLOSE = 0.2, 0.006, 0.008, 0.004, (2.0, 1.0)
# A return at an edge is farther from one neighbour than this share of its nearness, and a third as far from the other.
EDGE, ONE_SIDED = 0.03, 1 / 3
# Of `evened`: differences of reflectance that are speckle, on the ground and elsewhere; of the range code, on flat
# ground and to the neighbours along a ring.
ALIKE, FLAT, BESIDE = (0.04, 0.08), 0.02, 0.1
PAVED = [CLASS_NUMBER[name] for name in ("road", "parking", "sidewalk")]


def straightened(metres: Tensor, rows: np.ndarray, sensor: Sensor, edges: bool = False) -> Tensor:
    """(B, R, C) metres of these rows, 0 for no return, straight along rings, between beams, and upright on walls.

    Each return goes half of the way to where its two neighbours would have it, all of this where that is near, less and
    less up to twice as far. On a plane, 1 / horizontal distance is straight along a ring, and from beam to beam against
    the tangent of the elevation.

    edges  those along a ring stay, else what stands before a wall melts into it, as do kerbs: for grids of little noise
    """
    cosine, height = _directions(metres, rows, sensor)
    inverse = _nearness(metres, cosine)
    for _ in range(ROUNDS):
        inverse = _along_ring(inverse, NEAR, edges)
        near = torch.where(_of_ground(inverse, height, sensor.mount), KERB, CORNER) if edges else CORNER
        inverse = _across_rings(inverse, height, near)
    away = torch.where(metres > 0, 1 / inverse.clamp_min(1e-6), 0)
    return upright(away, height) / cosine


def along_rings(metres: Tensor, chosen: Tensor | None = None) -> Tensor:
    """Metres (B, R, C), 0 for no return, `straightened` along rings alone, for what was drawn between columns that are
    straight already; of `chosen` (B, R, C) bool alone, None = all."""
    returned = metres > 0
    inverse = returned / metres.clamp_min(0.1)
    for _ in range(ROUNDS):
        nearer = _along_ring(inverse, FINE)
        inverse = nearer if chosen is None else torch.where(chosen, nearer, inverse)
    return torch.where(returned, 1 / inverse.clamp_min(1e-6), 0)


def paved(image: RangeImage) -> RangeImage:
    """A sample in the making (H, W), metres, with labels, `along_rings` where both neighbours on the ring are of the
    same paved class: what a fill draws waves there by a third of a sensor's noise. Kerbs stay."""
    assert image.label is not None
    label = texture(image.label)
    inside = np.isin(label, PAVED) & (label == np.roll(label, 1, 1)) & (label == np.roll(label, -1, 1))
    metres = torch.from_numpy((image.range * image.mask).astype(np.float32))
    return replace(image, range=along_rings(metres[None], torch.from_numpy(inside)[None])[0].numpy())


def across_rings(metres: Tensor, rows: np.ndarray, sensor: Sensor) -> Tensor:
    """Metres (B, R, C) of these rows, 0 for no return, straight from beam to beam where rings are close together, for
    what was drawn between beams that are straight already: else each ring goes its own way.

    First humps and holes of one ring on the ground go, which streets hardly have: each return is as high as the median
    of it and those above and below. Kerbs stay. Then what is left, thousandths of the range, goes as in `straightened`.
    """
    cosine, height = _directions(metres, rows, sensor)
    degrees = np.asarray(sensor.elevations)[rows]
    low, high = (torch.from_numpy(np.pad(degrees[:-2] - degrees[2:] < three, 1))[:, None].to(metres.device)
                 for three in CLOSE)  # fmt: skip
    inverse = _nearness(metres, cosine)
    ground = _of_ground(inverse, height, sensor.mount)
    lower = inverse / (-height).clamp_min(1e-3)
    median = torch.stack([lower[:, :-2], lower[:, 1:-1], lower[:, 2:]]).median(0).values * (-height[:, 1:-1])
    level = (low & ground)[:, 1:-1] & ground[:, :-2] & ground[:, 2:]
    inner = torch.where(level, median, inverse[:, 1:-1])
    inverse = torch.cat([inverse[:, :1], inner, inverse[:, -1:]], 1)
    for _ in range(ROUNDS):
        ground = _of_ground(inverse, height, sensor.mount)
        near = torch.where(ground & low, BUMP, torch.where(~ground & high, DENT, 1e-6))
        inverse = _across_rings(inverse, height, near)
    return torch.where(metres > 0, 1 / (inverse.clamp_min(1e-6) * cosine), 0)


def evened(grid: Grid, rays: Tensor) -> Tensor:
    """Reflectances (B, R, C) of a grid, told rays (B, 8, R, C), each nearer to those of its neighbours on the same
    surface, so that its speckle is not taken for that of its surroundings.

    On the ground, where kerbs and lanes differ by little, only what is nearly alike is of one surface.
    """
    flat = (grid.code - rays[:, 1] / 2).abs() < FLAT
    near = torch.where(flat, ALIKE[0], ALIKE[1])
    height = torch.arange(grid.code.shape[1], device=grid.code.device)[:, None]
    shade, count = grid.shade * grid.returned, grid.code.shape[1]
    for _ in range(ROUNDS):
        total, weights = shade, torch.ones_like(shade)
        for rows, columns in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            other, code, back = (part.roll((rows, columns), (1, 2)) for part in (shade, grid.code, grid.returned))
            same = back & grid.returned & (height - rows >= 0) & (height - rows < count)
            if columns:
                same &= (code - grid.code).abs() < BESIDE
            weight = same * torch.exp(-(((other - shade) / near) ** 2))
            total, weights = total + weight * other, weights + weight
        shade = total / weights
    return shade


def _along_ring(inverse: Tensor, near: float, edges: bool = True) -> Tensor:
    """Nearness, 0 for no return, nearer to the line between two neighbours on the ring; with `edges`, but there."""
    left, right = inverse.roll(1, 2), inverse.roll(-1, 2)
    if not edges:
        return _nearer(inverse, left, right, 0.5, near)
    away = torch.stack([(left - inverse).abs(), (right - inverse).abs()])
    edge = (away.amax(0) > EDGE * inverse) & (away.amin(0) < ONE_SIDED * away.amax(0))
    return torch.where(edge, inverse, _nearer(inverse, left, right, 0.5, near))


def _across_rings(inverse: Tensor, height: Tensor, near: Tensor | float) -> Tensor:
    """`_nearness` (B, R, C), nearer to the plane of the beams above and below; `height` (1, R, 1) are the tangents of
    the elevations, `near` is a number or one of each (B, R, C)."""
    above = (height[:, :-2] - height[:, 1:-1]) / (height[:, :-2] - height[:, 2:])
    near = near[:, 1:-1] if isinstance(near, Tensor) else near
    inner = _nearer(inverse[:, 1:-1], inverse[:, :-2], inverse[:, 2:], above, near)
    return torch.cat([inverse[:, :1], inner, inverse[:, -1:]], 1)


def _of_ground(inverse: Tensor, height: Tensor, mount: float) -> Tensor:
    """(B, R, C) bool: whether `_nearness` is about that of flat ground, so many metres below the sensor."""
    return (height < -0.01) & ((inverse * mount / (-height).clamp_min(1e-3) - 1).abs() < LOW)


def _nearness(metres: Tensor, cosine: Tensor) -> Tensor:
    """(B, R, C) 1 / horizontal distance, 0 for no return."""
    return (metres > 0) / (metres.clamp_min(0.1) * cosine)


def _directions(metres: Tensor, rows: np.ndarray, sensor: Sensor) -> tuple[Tensor, Tensor]:
    """(1, R, 1) cosines of the elevations, at least 0.001 where a beam looks straight up, and their tangents."""
    elevation = metres.new_tensor(np.radians(np.asarray(sensor.elevations)[rows]))[None, :, None]
    return elevation.cos().clamp_min(1e-3), elevation.tan()


def _nearer(inverse: Tensor, one: Tensor, other: Tensor, share: Tensor | float, near: Tensor | float) -> Tensor:
    """Nearness, nearer to the line between two neighbours, of which `share` is the other's; 0 is no return."""
    away = (one * (1 - share) + other * share - inverse) * ((inverse > 0) & (one > 0) & (other > 0))
    return inverse + 0.5 * away * _same(away / inverse.clamp_min(1e-6), near)


def upright(away: Tensor, height: Tensor) -> Tensor:
    """Horizontal distances (B, R, C), nearer to those of the beams above and below that meet the same wall."""
    ground = (height[:, 1:] / height[:, :-1]).clamp_min(1e-6).log().abs()  # between beams that both look down
    near = torch.where(height[:, :-1] < 0, (GROUND * ground).clamp(1e-6, NEAR), NEAR)
    returned, log = away > 0, away.clamp_min(1e-6).log()
    both = returned[:, 1:] & returned[:, :-1]
    none = torch.zeros_like(log[:, :1])
    for _ in range(ROUNDS):
        step = log[:, 1:] - log[:, :-1]
        weight = both * _same(step, near)
        down, up = (torch.cat(part, 1) for part in ((weight * step, none), (none, -weight * step)))
        total = sum(torch.cat(part, 1) for part in ((weight, none), (none, weight)))
        log = log + (down + up) / (1 + total)
    return torch.where(returned, log.exp(), 0)


def _same(step: Tensor, near: Tensor | float) -> Tensor:
    """1 for steps up to `near`, less up to twice as many, 0 from there on."""
    return (2 - step.abs() / near).clamp(0, 1)
