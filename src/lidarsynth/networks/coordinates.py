"""Encodings of the ray angles that tell the network where a pixel looks (R2DM section III-B, table II)."""

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn


def default_angles(resolution: tuple[int, int]) -> Tensor:
    """Angles (1,2,H,W) in radians, elevation first, of a bare network: pixel edges over a half and a whole turn.

    Training replaces them with the sensor's ray angles, and a checkpoint carries those.
    """
    height, width = resolution
    elevation = (0.5 - torch.arange(height) / height) * math.pi
    azimuth = (1 - torch.arange(width) / width) * 2 * math.pi - math.pi
    return torch.stack(torch.meshgrid(elevation, azimuth, indexing="ij"))[None]


def patch_angles(coords: Tensor, stem: tuple[int, int]) -> Tensor:
    """Mean angles of each `stem = (sh, sw)` patch: (1,2,H,W) -> (1,2,H/sh,W/sw), in radians.

    The azimuth is averaged around the patch's first pixel, so that a patch may straddle the seam at +-pi.
    """
    if stem == (1, 1):
        return coords
    patches = coords.unflatten(3, (-1, stem[1])).unflatten(2, (-1, stem[0]))  # (1,2,h,sh,w,sw)
    first = patches[:, :, :, :1, :, :1]
    turn = 2 * math.pi
    offset = torch.remainder(patches - first + math.pi, turn) - math.pi
    return (first + offset.mean((3, 5), keepdim=True))[:, :, :, 0, :, 0]


class NoEncoding(nn.Module):
    """Nothing, (1,2,H,W) -> (1,0,H,W): R2DM configuration F, which does not know where a pixel looks."""

    channels = 0

    def forward(self, coords: Tensor) -> Tensor:
        return coords[:, :0]


class PolarCoordinates(nn.Module):
    """The two angles themselves, (1,2,H,W) -> (1,2,H,W): R2DM configurations A-E."""

    channels = 2

    def forward(self, coords: Tensor) -> Tensor:
        return coords


class FourierFeatures(nn.Module):
    """Sines, then cosines, of the angles times 1, 2, 4, ...: (1,2,H,W) -> (1,2L,H,W), L = log2 H + log2 W rounded up.

    R2DM configuration H. The frequencies and phases are buffers because the official checkpoints hold them.
    """

    freqs: Tensor
    phase: Tensor

    def __init__(self, resolution: tuple[int, int]):
        super().__init__()
        rows, columns = (2.0 ** torch.arange(math.ceil(math.log2(size))) for size in resolution)
        freqs = torch.block_diag(rows[:, None], columns[:, None])
        self.register_buffer("freqs", freqs[:, :, None, None])  # (L,2,1,1)
        self.register_buffer("phase", torch.zeros(len(freqs)))
        self.channels = 2 * len(freqs)

    def forward(self, coords: Tensor) -> Tensor:
        elevation, azimuth = self.freqs.unbind(1)
        # elementwise, not as a 1x1 convolution: autocast would round angles of hundreds of turns to half precision
        arguments = elevation * coords[:, :1] + azimuth * coords[:, 1:] + self.phase[:, None, None]
        return torch.cat([arguments.sin(), arguments.cos()], dim=1)


class SphericalHarmonics(nn.Module):
    """Real orthonormal spherical harmonics of degrees 0 to 4, (1,2,H,W) -> (1,25,H,W): R2DM configuration G.

    Without the Condon-Shortley sign; channel l*l + l + m. The direction is (cos cos, -sin cos, sin): its y is
    opposite to that of the point cloud.
    """

    channels = 25

    def forward(self, coords: Tensor) -> Tensor:
        elevation, azimuth = coords[:, 0], coords[:, 1]
        x = azimuth.cos() * elevation.cos()
        y = -azimuth.sin() * elevation.cos()
        z = elevation.sin()
        low = [torch.full_like(x, 0.5 * math.sqrt(1 / math.pi)), *_degree_1(x, y, z), *_degree_2(x, y, z)]
        return torch.stack([*low, *_degree_3(x, y, z), *_degree_4(x, y, z)], dim=1)


def _degree_1(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    return [math.sqrt(3 / (4 * math.pi)) * value for value in (y, z, x)]


def _degree_2(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    cross = math.sqrt(15 / (4 * math.pi))
    return [
        cross * x * y,
        cross * y * z,
        math.sqrt(5 / (16 * math.pi)) * (3 * z**2 - 1),
        cross * x * z,
        cross / 2 * (x**2 - y**2),
    ]


def _degree_3(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    m1, m2, m3 = (math.sqrt(n / (d * math.pi)) for n, d in ((21, 32), (105, 16), (35, 32)))
    return [
        m3 * y * (3 * x**2 - y**2),
        2 * m2 * x * y * z,
        m1 * y * (5 * z**2 - 1),
        math.sqrt(7 / (16 * math.pi)) * z * (5 * z**2 - 3),
        m1 * x * (5 * z**2 - 1),
        m2 * z * (x**2 - y**2),
        m3 * x * (x**2 - 3 * y**2),
    ]


def _degree_4(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    m1, m2, m3, m4 = (0.75 * math.sqrt(n / math.pi) for n in (2.5, 5, 17.5, 35))
    return [
        m4 * x * y * (x**2 - y**2),
        m3 * y * z * (3 * x**2 - y**2),
        m2 * x * y * (7 * z**2 - 1),
        m1 * y * z * (7 * z**2 - 3),
        3 / 16 * math.sqrt(1 / math.pi) * (35 * z**4 - 30 * z**2 + 3),
        m1 * x * z * (7 * z**2 - 3),
        m2 / 2 * (x**2 - y**2) * (7 * z**2 - 1),
        m3 * x * z * (x**2 - 3 * y**2),
        m4 / 4 * (x**2 * (x**2 - 3 * y**2) - y**2 * (3 * x**2 - y**2)),
    ]


Encoding = NoEncoding | PolarCoordinates | FourierFeatures | SphericalHarmonics

ENCODINGS: dict[str | None, Callable[[tuple[int, int]], Encoding]] = {
    "fourier_features": FourierFeatures,
    "spherical_harmonics": lambda resolution: SphericalHarmonics(),
    "polar_coordinates": lambda resolution: PolarCoordinates(),
    None: lambda resolution: NoEncoding(),
}


def coordinate_encoding(name: str | None, resolution: tuple[int, int]) -> Encoding:
    """The encoding called `name` for an (H, W) grid (None is a name too); its `channels` is what it gives.

    Raises ValueError for a name that is not in `ENCODINGS`.
    """
    if name not in ENCODINGS:
        raise ValueError(f"coords_encoding must be one of {list(ENCODINGS)}, got {name!r}")
    return ENCODINGS[name](resolution)
