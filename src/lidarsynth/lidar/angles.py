"""From angles of rays to directions."""

from __future__ import annotations

import numpy as np


def unit_vectors(angles: np.ndarray) -> np.ndarray:
    """(H, W, 3) unit vectors (cos e cos a, cos e sin a, sin e), in their type, of elevations e and azimuths a (2, H, W)
    in radians."""
    elevation, azimuth = angles
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
