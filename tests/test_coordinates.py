"""Coordinate encodings: parity, orthonormality, and averages across the seam."""

import math

import pytest
import torch
from oracle import assert_close

from lidarsynth.networks.coordinates import ENCODINGS, coordinate_encoding, default_angles, patch_angles

SIZES = [(16, 64), (24, 32)]


@pytest.fixture
def expected(fixture_tensors):
    return fixture_tensors("r2dm/coords")


@pytest.mark.parametrize("size", SIZES)
def test_encodings_equal_the_reference(expected, size):
    name = f"{size[0]}x{size[1]}"
    angles = expected[f"{name}.ray_angles"]
    torch.testing.assert_close(default_angles(size), expected[f"{name}.default_polar_coords"], atol=1e-6, rtol=0)
    assert coordinate_encoding("polar_coordinates", size)(angles) is angles
    harmonics = coordinate_encoding("spherical_harmonics", size)(angles)
    assert_close(harmonics, expected[f"{name}.spherical_harmonics"], atol=1e-5, rtol=0)
    fourier = coordinate_encoding("fourier_features", size)
    torch.testing.assert_close(fourier.freqs, expected[f"{name}.fourier_freqs"], atol=0, rtol=0)
    assert_close(fourier(angles), expected[f"{name}.fourier"], atol=1e-4, rtol=0)


def test_spherical_harmonics_are_orthonormal():
    """Products integrate to the identity over the sphere (Gauss-Legendre would do; a fine grid is as good)."""
    rows, columns = 400, 64
    elevation = ((torch.arange(rows, dtype=torch.float64) + 0.5) / rows - 0.5) * math.pi
    azimuth = torch.arange(columns, dtype=torch.float64) / columns * 2 * math.pi
    angles = torch.stack(torch.meshgrid(elevation, azimuth, indexing="ij"))[None]
    values = coordinate_encoding("spherical_harmonics", (rows, columns))(angles)[0].flatten(1)
    area = (elevation.cos() * math.pi / rows * 2 * math.pi / columns)[:, None].expand(rows, columns).flatten()
    gram = (values * area) @ values.T
    torch.testing.assert_close(gram, torch.eye(25, dtype=torch.float64), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ENCODINGS)
def test_channels_are_what_the_encoding_gives(name):
    encoding = coordinate_encoding(name, (24, 32))
    assert encoding(default_angles((24, 32))).shape == (1, encoding.channels, 24, 32)


def test_fourier_channels_at_the_sizes_of_the_paper():
    assert coordinate_encoding("fourier_features", (64, 1024)).channels == 32
    assert coordinate_encoding("fourier_features", (64, 512)).channels == 30
    assert coordinate_encoding("fourier_features", (40, 200)).channels == 28  # log2 rounded up: 6 + 8


def test_patch_angles_are_the_centres_of_the_patches():
    coords = default_angles((16, 64))
    assert patch_angles(coords, (1, 1)) is coords
    patches = patch_angles(coords, (2, 4))
    torch.testing.assert_close(patches, torch.nn.functional.avg_pool2d(coords, (2, 4)))


def test_patch_angles_average_across_the_seam():
    coords = default_angles((16, 64)).roll(2, 3)  # the seam now lies in the middle of the first patch
    patches = patch_angles(coords, (2, 4))
    step = 2 * math.pi / 64
    expected = torch.tensor(-math.pi + step / 2)
    torch.testing.assert_close(patches[0, 1, :, 0].sin(), expected.sin().expand(8), atol=1e-5, rtol=0)
    torch.testing.assert_close(patches[0, 1, :, 0].cos(), expected.cos().expand(8), atol=1e-5, rtol=0)


def test_an_unknown_encoding_is_refused():
    with pytest.raises(ValueError, match=r"fourier_features.*got 'fourier'"):
        coordinate_encoding("fourier", (16, 64))


def test_autocast_does_not_round_the_fourier_angles():
    encoding, angles = coordinate_encoding("fourier_features", (64, 1024)), default_angles((64, 1024))
    expected = encoding(angles)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(encoding(angles), expected)
