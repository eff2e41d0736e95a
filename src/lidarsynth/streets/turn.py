"""One turn of a sensor through a world: from the carrier's poses to every beam's return."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets import hdl64e
from lidarsynth.streets.raycast import AnyCaster
from lidarsynth.streets.sensor_model import Optics, sense
from lidarsynth.streets.world import World

LEANING = 5.0  # degrees of a tilt, at which boxes upright in the sensor's frame lack a twentieth of their points


@dataclass(frozen=True)
class Turn:
    """What the H x W beams of one turn brought back, rows from the highest beam, columns from behind clockwise.

    rays, points (H, W, 3) float32: the beams' directions and where they ended, metres, in the sensor frame of the
    moment each was sent, (0, 0, 0) for none; distance (H, W) float32 m along the ray, 0 for none; reflectance, label
    (H, W); face, first (H, W) int32: the triangle of the return and the one met first, maybe a pane, -1 for none;
    surface (H, W) float32 m, surface_label: where exactly that one is within the sensor's limits, 0 for none; class.
    """

    rays: np.ndarray
    points: np.ndarray
    distance: np.ndarray
    reflectance: np.ndarray
    label: np.ndarray
    face: np.ndarray
    first: np.ndarray
    surface: np.ndarray
    surface_label: np.ndarray


def shoot(
    world: World,
    caster: AnyCaster,
    sensor: Sensor,
    optics: Optics,
    rng: np.random.Generator,
    poses: np.ndarray,
    times: np.ndarray | None = None,
) -> Turn:
    """Sends every beam of a turn that nothing on the carrier blocks.

    poses (1, 6) or, for a carrier that moves, (W, 6): x, y, z, yaw, pitch, roll of the vehicle for each column
    times (W,) seconds at which the columns are measured, for casters of things that move; None where nothing does
    """
    rays = _jittered(sensor, rng)
    view = _view(sensor)
    origins, directions = world_rays(sensor, rays, view.seen, attitudes(sensor, poses))
    lasers = hdl64e.lasers(sensor, optics.loss, optics.dip, optics.shift)
    when = None if times is None else np.broadcast_to(times, view.seen.shape)[view.seen]
    found = sense(world, caster, origins, directions, lasers, rng, sensor.max_range, optics, when)
    lost = np.flatnonzero(~(found.distance >= sensor.min_range))
    reported = [_whole(view, v, lost) for v in (found.distance, found.reflectance, found.label)]
    faces = [_whole(view, values, empty=-1) for values in (found.face, found.first)]
    beyond = np.flatnonzero(~((found.surface >= sensor.min_range) & (found.surface < sensor.max_range)))
    surface = [_whole(view, v, beyond) for v in (found.surface, found.surface_label)]
    return Turn(rays, local_points(rays, reported[0], sensor), *reported, *faces, *surface)


class _View(NamedTuple):
    """seen (H, W) bool: which rays leave the carrier; number (H, W): how many before each do; blocked (n,): the others,
    as numbers of pixels."""

    seen: np.ndarray
    number: np.ndarray
    blocked: np.ndarray


@lru_cache(maxsize=4)
def _view(sensor: Sensor) -> _View:
    seen = ~hdl64e.hidden(sensor)
    number = np.cumsum(seen.reshape(-1)) - 1
    return _View(seen, np.maximum(number, 0).reshape(seen.shape), np.flatnonzero(~seen))


def _whole(view: _View, values: np.ndarray, without: np.ndarray | None = None, empty: int = 0) -> np.ndarray:
    """(H, W) image of the values (N,) of the rays that are seen; 0 for the rays of the numbers `without`."""
    if without is not None:
        values[without] = 0
    if not len(view.blocked):
        return values.reshape(view.seen.shape)
    image = values.take(view.number, mode="wrap")
    image.reshape(-1)[view.blocked] = empty
    return image


def perfect(turn: Turn, sensor: Sensor) -> Turn:
    """The turn as a simulator casts it: each beam reports exactly what it meets first, panes too, reflectance 0."""
    points, dark = local_points(turn.rays, turn.surface, sensor), np.zeros_like(turn.reflectance)
    face = np.where(turn.surface > 0, turn.first, -1)
    return replace(turn, points=points, distance=turn.surface, reflectance=dark, label=turn.surface_label, face=face)


def world_rays(
    sensor: Sensor, rays: np.ndarray, seen: np.ndarray, frames: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (N, 3) float32 in the world frame of the rays (H, W, 3) that are `seen` (H, W) bool.

    frames  of `attitudes`, one for all columns or one for each
    x, y and z lie apart in memory: what follows takes them one by one.
    """
    start = np.zeros((sensor.height, 3), np.float32)
    start[:, 2] = sensor.mount
    if sensor.offsets:
        start[:, 2] += np.asarray(sensor.offsets, np.float32)
    turns, places = frames
    if len(turns) == 1:
        turn, place = turns[0], places[0]
        ends = np.cumsum(seen.sum(axis=1)).tolist()
        origins = np.empty((3, ends[-1]), np.float32)
        for mine, a, b in zip(start @ turn.T + place, [0, *ends], ends, strict=False):
            origins[:, a:b] = mine[:, None]
        apart = np.moveaxis(rays, -1, 0).reshape(3, -1)
        if len(apart.T) > ends[-1]:
            number = np.flatnonzero(seen)
            apart = np.stack([along.take(number, mode="wrap") for along in apart])
        return origins.T, (turn @ apart).T
    origins = np.einsum("hj,wij->hwi", start, turns) + places
    return origins[seen].T.copy().T, np.einsum("hwj,wij->hwi", rays, turns)[seen].T.copy().T


def some_rays(
    sensor: Sensor, rays: np.ndarray, row: np.ndarray, column: np.ndarray, frames: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """As `world_rays`, of the N rays at (row, column)."""
    turns, places = (part[column] if len(part) > 1 else part for part in frames)
    start = np.zeros((len(row), 1), np.float32) + np.float32(sensor.mount)
    if sensor.offsets:
        start += np.asarray(sensor.offsets, np.float32)[row, None]
    turned = np.einsum("nj,nij->ni", rays[row, column], np.broadcast_to(turns, (len(row), 3, 3)))
    return start * turns[:, :, 2] + places, turned


def local_points(rays: np.ndarray, distance: np.ndarray, sensor: Sensor) -> np.ndarray:
    """(H, W, 3) float32 points in the sensor frame, zero where nothing returned."""
    points = np.moveaxis(rays, -1, 0) * distance
    if sensor.offsets:
        points[2] += np.asarray(sensor.offsets, np.float32)[:, None]
        points[2][~(distance > 0)] = 0
    return np.moveaxis(points, 0, -1)


@lru_cache(maxsize=4)
def _directions(sensor: Sensor) -> np.ndarray:
    """(3, H, W) float32: x, y and z of the sensor's rays."""
    return np.ascontiguousarray(np.moveaxis(sensor.directions(), -1, 0))


def _jittered(sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """(H, W, 3) float32 rays, a view of (3, H, W): the sensor's, turned by a third of a column at most, each ring with
    its own phase."""
    phase = rng.random((sensor.height, 1), np.float32) / 2 - 0.25
    shake = rng.random((sensor.height, sensor.width), np.float32)
    angle = (phase + 0.16 * shake - 0.08) * np.float32(2 * np.pi / sensor.width)
    rays = _directions(sensor).copy()
    x, y, _ = _directions(sensor)
    rays[0] -= angle * y  # small angles: the length stays 1 within 1e-6
    rays[1] += angle * x
    return np.moveaxis(rays, 0, -1)


def attitudes(sensor: Sensor, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3) of the sensor and places (N, 3) of its vehicle, float32, from the vehicle's poses (N, 6)."""
    pairs = _pose(np.moveaxis(poses, -1, 0)) if len(poses) > 1 else [part[None] for part in _pose(poses[0])]
    turns, places = pairs
    if any(sensor.tilt):
        turns = turns @ _pose(np.array([0, 0, 0, 0, *np.radians(sensor.tilt)]))[0]
    return turns, places


def sensor_pose(sensor: Sensor, pose: np.ndarray) -> np.ndarray:
    """(4, 4) float64 matrix from the sensor frame to the world, of a vehicle's pose x, y, z, yaw, pitch, roll."""
    x, y, z, yaw, pitch, roll = pose
    tilt = _turn(0.0, *np.radians(sensor.tilt)) if any(sensor.tilt) else np.eye(3)
    matrix = np.eye(4)
    matrix[:3, :3] = _turn(yaw, pitch, roll) @ tilt
    matrix[:3, 3] = np.array([x, y, z]) + matrix[:3, 2] * sensor.mount
    return matrix


def told_of_tilt(sensor: Sensor) -> str:
    """What is to be known of boxes of a sensor that is tilted against its vehicle by LEANING or more, else nothing."""
    lean = float(np.degrees(np.arccos(np.prod(np.cos(np.radians(sensor.tilt))))))
    told = f"{sensor.name} is tilted by {lean:.0f} degrees, and boxes, upright in its frame, lack points of theirs"
    return told if lean >= LEANING else ""


def _pose(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and place (3,) float32 of a pose (6,), or of N from (6, N): x, y, z, yaw, pitch, roll."""
    x, y, z, yaw, pitch, roll = pose
    return _turn(yaw, pitch, roll).astype(np.float32), np.stack([x, y, z], axis=-1).astype(np.float32)


def _turn(yaw: np.ndarray | float, pitch: np.ndarray | float, roll: np.ndarray | float) -> np.ndarray:
    """(..., 3, 3) rotation by roll (left side up), then pitch (nose up), then yaw, in radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    one, zero = c * 0 + 1, c * 0
    about_z = _matrix([[c, -s, zero], [s, c, zero], [zero, zero, one]])
    about_y = _matrix([[cp, zero, -sp], [zero, one, zero], [sp, zero, cp]])
    about_x = _matrix([[one, zero, zero], [zero, cr, -sr], [zero, sr, cr]])
    return about_z @ about_y @ about_x


def _matrix(rows: list) -> np.ndarray:
    """(..., 3, 3) from three rows of three numbers or arrays (...)."""
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))
