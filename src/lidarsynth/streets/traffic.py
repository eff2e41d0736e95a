"""Who drives behind whom: the Intelligent Driver Model (Treiber, Hennecke and Helbing, Phys. Rev. E 62, 2000)."""

from __future__ import annotations

import numpy as np

STEP = 0.05  # seconds between two states
HEADWAY = 1.2  # s, kept to the one in front
GAP = 2.0  # m, kept when standing
ACCELERATION, BRAKING = 1.2, 2.0  # m/s^2, comfortable
HARDEST = 8.0  # m/s^2, what brakes can do


def acceleration(speed: np.ndarray, wished: np.ndarray, gap: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """(N,) m/s^2 of N drivers (eq. 1 and 2 with exponent 4).

    speed, wished (N,) m/s; gap (N,) m to the bumper in front, infinite for none; closing (N,) m/s, own speed minus that
    of the one in front
    """
    safe = GAP + np.maximum(speed * HEADWAY + speed * closing / (2 * np.sqrt(ACCELERATION * BRAKING)), 0)
    pull = 1 - (speed / wished) ** 4 - (safe / np.maximum(gap, 0.1)) ** 2
    return np.clip(ACCELERATION * pull, -HARDEST, None)


def follow(place: np.ndarray, length: np.ndarray, wished: np.ndarray, seconds: float) -> np.ndarray:
    """(steps + 1, N) metres along one lane, every STEP seconds, of N vehicles that follow each other.

    place (N,) m of their middles at the start; length (N,) m; wished (N,) m/s, the speed each would like
    They begin at nine tenths of their speed, or slower where they would be too close to the one in front.
    """
    order = np.argsort(place, kind="stable")
    s, size, wished = place[order].astype(float), length[order], wished[order]
    half = (size + np.roll(size, -1)) / 2
    speed = 0.9 * wished
    first = _gaps(s, half)
    speed = np.minimum(speed, np.maximum(first - GAP, 0) / HEADWAY)
    track = [s.copy()]
    for _ in range(int(np.ceil(seconds / STEP))):
        closing = speed - np.append(speed[1:], 0.0)
        gain = acceleration(speed, wished, _gaps(s, half), closing)
        later = np.maximum(speed + gain * STEP, 0)
        s = s + (speed + later) / 2 * STEP
        speed = later
        track.append(s.copy())
    whole = np.empty((len(track), len(place)))
    whole[:, order] = np.stack(track) if len(place) else np.zeros((len(track), 0))
    return whole


def _gaps(s: np.ndarray, half: np.ndarray) -> np.ndarray:
    """(N,) m from bumper to bumper, of vehicles in order; the first of the lane has nobody in front."""
    return np.append(np.diff(s) - half[:-1], np.inf) if len(s) else s
