"""The 3-D box of every road user around the sensor, with how many points it got and how much of it is hidden."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.boxes import Box
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.streets.actors import MARGIN
from lidarsynth.streets.drive import Moment
from lidarsynth.streets.moving import Bodies, half_turn
from lidarsynth.streets.turn import Turn, attitudes, some_rays
from lidarsynth.streets.world import World


def boxes_of(
    world: World,
    bodies: Bodies,
    moment: Moment,
    sensor: Sensor,
    turn: Turn,
    numbers: np.ndarray,
    poses: np.ndarray,
    late: np.ndarray | None,
    to_world: np.ndarray,
    as_seen: bool = False,
) -> list[Box]:
    """Boxes of all actors whose middle is within the sensor's range, or that a return is labelled with.

    numbers   (H, W) instance of each return, 0 for none
    poses     (1 or W, 6) of the carrier by column; late (W,) s after the stamp, None where nothing moves
    to_world  (4, 4) sensor to world at the stamp
    as_seen   each stands where its points were met, not where it is at the stamp
    """
    actors = bodies.actors
    middles = moment.place + _about(actors.middle, moment.yaw)
    here = (middles - to_world[:3, 3]) @ to_world[:3, :3]
    points = np.bincount(numbers.ravel(), minlength=len(actors) + 1)
    near = np.linalg.norm(here, axis=1) < sensor.max_range
    near = np.flatnonzero(moment.present & (near | (points[1:] > 0)))
    first = np.where(turn.first >= 0, world.thing[turn.first], -1)
    hits = np.bincount(first.ravel() + 1, minlength=len(world.things) + 1)
    behind = numbers[(numbers > 0) & (first != np.append(-1, actors.thing)[numbers])]  # seen through panes of others
    through = np.bincount(behind, minlength=len(actors) + 1)
    found, frames = [], attitudes(sensor, poses)
    after = _lateness(numbers, late, here) if as_seen and late is not None else None
    now = moment if after is None else moment.later(after)
    shown_at = now.place + _about(actors.middle, now.yaw)
    centres = (shown_at - to_world[:3, 3]) @ to_world[:3, :3]
    for actor in near.tolist():
        met = hits[actors.thing[actor] + 1] + through[actor + 1]
        hidden = _hidden(bodies, actor, moment, sensor, turn, first, frames, late, here[actor]) if met else 0
        alone = met + hidden - through[actor + 1]
        front = np.array([np.cos(now.yaw[actor]), np.sin(now.yaw[actor]), 0]) @ to_world[:3, :3]
        shown = met / alone if alone else 0.0
        found.append(Box(
            str(actors.kind[actor]), int(actor) + 1, _three(centres[actor]), _three(actors.size[actor] + 2 * MARGIN),
            float(np.arctan2(front[1], front[0])), _three(moment.velocity[actor] @ to_world[:3, :3]),
            _three(shown_at[actor]), float(np.arctan2(np.sin(now.yaw[actor]), np.cos(now.yaw[actor]))),
            _three(moment.velocity[actor]), int(points[actor + 1]), float(np.clip(1 - shown, 0, 1)),
            None if after is None else float(after[actor]), float(moment.spin[actor]),
        ))  # fmt: skip
    return found


def _lateness(numbers: np.ndarray, late: np.ndarray, here: np.ndarray) -> np.ndarray:
    """(A,) s after the stamp at which each actor was met: the median of its returns, or when the beams passed by.

    numbers (H, W) as in `boxes_of`; late (W,) s; here (A, 3) m, its middle in the sensor frame at the stamp. The median
    is of one end of the turn for those that both ends meet, where a mean would be of neither.
    """
    column = (np.pi - np.arctan2(here[:, 1], here[:, 0])) * len(late) / (2 * np.pi)
    after = late[column.astype(int) % len(late)]
    row, column = np.nonzero(numbers)
    met = numbers[row, column] - 1
    for actor in np.unique(met).tolist():
        after[actor] = np.quantile(late[column[met == actor]], 0.5, method="lower")
    return after


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _about(vectors: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """(A, 3) vectors turned about z by yaw (A,)."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def _hidden(
    bodies: Bodies,
    actor: int,
    moment: Moment,
    sensor: Sensor,
    turn: Turn,
    first: np.ndarray,
    frames: tuple[np.ndarray, np.ndarray],
    late: np.ndarray | None,
    here: np.ndarray,
) -> int:
    """How many beams would meet the actor if nothing else were there, beside those that meet it first.

    first (H, W): the thing that each beam meets. Only beams that end before the actor or within its reach can be among
    them; the others passed it by.
    """
    speed = float(np.linalg.norm(moment.velocity[actor]))
    slack = 0.0 if late is None else 1.0 + half_turn(late) * speed
    reach = bodies.reach[actor] + slack
    tall = bodies.actors.size[actor, 2] / 2 + slack
    columns, rows = _columns(sensor, here, reach), np.flatnonzero(_rows(sensor, here, reach, tall))
    part = np.ix_(rows, columns)
    ended = (turn.first[part] >= 0) & (turn.surface[part] < np.linalg.norm(here) + reach)
    ended &= first[part] != bodies.actors.thing[actor]
    if not ended.any():
        return 0
    row, column = (of[index] for of, index in zip((rows, columns), np.nonzero(ended), strict=True))
    origins, rays = some_rays(sensor, turn.rays, row, column, frames)
    place, yaw = moment.place[actor], moment.yaw[actor]
    if late is not None:
        after = late[column]
        place, yaw = place + after[:, None] * moment.velocity[actor], yaw + after * moment.spin[actor]
    return bodies.met(actor, place, yaw, origins, rays)


def _columns(sensor: Sensor, here: np.ndarray, radius: float) -> np.ndarray:
    """Columns of the image in which something of that radius (m) at `here` (sensor frame) may be."""
    away = np.hypot(here[0], here[1])
    half = np.pi if away <= radius else np.arcsin(radius / away) + 4 * np.pi / sensor.width
    middle = (np.pi - np.arctan2(here[1], here[0])) * sensor.width / (2 * np.pi)
    spread = min(half * sensor.width / (2 * np.pi), sensor.width / 2 - 1)
    return np.unique(np.arange(int(middle - spread), int(middle + spread) + 2) % sensor.width)


def _rows(sensor: Sensor, here: np.ndarray, radius: float, tall: float) -> np.ndarray:
    """(H,) bool: beams that may meet something of that radius and half height (m) at `here` (sensor frame).

    Both frames may be tilted against each other by six degrees.
    """
    away, half = float(np.hypot(here[0], here[1])), tall + 0.05 + 0.1 * radius
    if away <= radius:
        return np.ones(sensor.height, bool)
    slopes = [np.arctan2(here[2] + z, d) for z in (-half, half) for d in (away - radius, away + radius)]
    beams = np.radians(sensor.elevations)
    return (beams > min(slopes) - 0.03) & (beams < max(slopes) + 0.03)
