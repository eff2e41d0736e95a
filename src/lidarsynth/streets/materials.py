"""What the street is made of: how bright each surface looks to the laser, how much it varies, how it drops returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Material(NamedTuple):
    """One kind of surface. `signal` is the sensor's raw scale, before its response curve (`sensor_model.RESPONSE`)."""

    signal: float  # mean signal of the material at 10 m, head on
    spread: float  # standard deviation between objects
    grain: float  # standard deviation between neighbouring returns of one object
    gloss: float  # how fast the signal falls at grazing incidence: signal += gloss * ln(cos)
    loss: float = 0.0  # share of beams that return nothing whatever the distance
    passes: float = 0.0  # share of beams that go through and hit what is behind


# fmt: off
MATERIALS: dict[str, Material] = {
    "road":     Material(0.208, 0.020, 0.030, 0.00),
    "marking":  Material(0.400, 0.080, 0.060, 0.00),
    "parking":  Material(0.240, 0.030, 0.033, 0.00),
    "sidewalk": Material(0.265, 0.030, 0.035, 0.00),
    "kerb":     Material(0.260, 0.040, 0.050, 0.00),
    "gravel":   Material(0.210, 0.030, 0.060, 0.00),
    "grass":    Material(0.290, 0.030, 0.060, 0.00),
    "rail":     Material(0.000, 0.020, 0.040, 0.00),
    "plaster":  Material(0.395, 0.120, 0.050, 0.02),
    "stone":    Material(0.300, 0.090, 0.080, 0.02),
    "window":   Material(0.020, 0.080, 0.060, 0.02, loss=0.06),
    "room":     Material(0.140, 0.100, 0.080, 0.02),
    "void":     Material(0.000, 0.000, 0.000, 0.00, loss=2.0),
    "door":     Material(0.200, 0.110, 0.050, 0.02),
    "wall":     Material(0.310, 0.090, 0.070, 0.02),
    "fence":    Material(0.180, 0.100, 0.080, 0.02),
    "leaves":   Material(0.290, 0.060, 0.110, 0.00),
    "bark":     Material(0.200, 0.060, 0.080, 0.02),
    "pole":     Material(0.190, 0.130, 0.100, 0.02),
    "sign":     Material(1.050, 0.150, 0.050, 0.00),
    "sign back": Material(0.200, 0.120, 0.050, 0.02),
    "paint":    Material(0.135, 0.150, 0.090, 0.09),
    "glass":    Material(0.020, 0.060, 0.060, 0.10, loss=0.60, passes=0.28),
    "dark":     Material(0.030, 0.040, 0.060, 0.02, loss=0.10),
    "lamp":     Material(0.600, 0.200, 0.150, 0.02),
    "plate":    Material(1.000, 0.120, 0.080, 0.00),
    "tyre":     Material(0.130, 0.060, 0.110, 0.02),
    "canvas":   Material(0.300, 0.120, 0.060, 0.02),
    "cloth":    Material(0.230, 0.110, 0.080, 0.01),
    "skin":     Material(0.300, 0.040, 0.060, 0.01),
}
# fmt: on

NUMBER = {name: i for i, name in enumerate(MATERIALS)}
TABLE = np.array(list(MATERIALS.values()), np.float32)
