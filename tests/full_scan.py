"""A scan that carries everything a scan may carry, and what it means for two scans to be the same."""

from __future__ import annotations

import numpy as np

from lidarsynth.lidar.scan import Scan

N = 640


def full_scan() -> Scan:
    """Ten rings from the top, with everything a scan may carry."""
    rng = np.random.default_rng(0)
    ring = np.arange(N) % 10
    azimuth, distance = rng.uniform(-np.pi, np.pi, N), rng.uniform(2, 60, N)
    elevation = np.radians(5 - 2 * ring)
    xyz = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    return Scan(
        (xyz * distance[:, None]).astype(np.float32),
        rng.random(N).astype(np.float32),
        ring=ring,
        time=1.6e9 + np.sort(rng.uniform(0, 0.1, N)),
        label=rng.integers(0, 20, N),
    )


def same(found: Scan, expected: Scan, fields: tuple[str, ...] = ("xyz", "reflectance", "ring", "time", "label")):
    """Bit for bit, type and all for what the contract names float32."""
    for name in fields:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)
    assert found.xyz.dtype == found.reflectance.dtype == np.float32
