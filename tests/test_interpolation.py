"""Interpolation: closed forms, a pixel-by-pixel second implementation, and the published resizers."""

import numpy as np
import pytest
import torch
from torch import Tensor

import lidarsynth as ls
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.networks.interpolation import (
    METHODS,
    fill_in,
    interpolate,
    nearest_along_axes,
    nearest_around,
    resize_rows,
    sample_queries,
)
from lidarsynth.systems.interpolation.model import interpolated


def rows_mask(shape: tuple[int, int, int, int], *rows: int) -> Tensor:
    mask = torch.zeros(shape)
    mask[:, :, list(rows)] = 1
    return mask


def random_case(density: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    known = torch.randn(2, 2, 8, 16, generator=generator)
    return known, (torch.rand(2, 2, 8, 16, generator=generator) < density).float()


def cross_by_hand(known: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """One pass of `fill_in` over one channel (H,W), pixel by pixel."""
    height, width = known.shape
    filled, seen = known * mask, mask.clone()
    for i, j in (1 - mask).nonzero().tolist():
        values = weights = 0.0
        for di, dj, steps in ((-1, 0, i), (1, 0, height - 1 - i), (0, -1, width), (0, 1, width)):
            for step in range(1, steps + 1):
                row, column = i + di * step, (j + dj * step) % width
                if mask[row, column]:
                    values += known[row, column].item() / step
                    weights += 1 / step
                    break
        if weights:
            filled[i, j], seen[i, j] = values / weights, 1
    return filled, seen


@pytest.mark.parametrize("density", [0.0, 0.02, 0.2, 1.0])
def test_fill_in_equals_the_definition(density):
    known, mask = random_case(density)
    filled = fill_in(known, mask)
    for b, c in ((0, 0), (0, 1), (1, 0), (1, 1)):
        expected, seen = cross_by_hand(known[b, c], mask[b, c])
        if mask[b, c].any() and not seen.all():
            expected, _ = cross_by_hand(expected, seen)
        torch.testing.assert_close(filled[b, c], expected)


@pytest.mark.parametrize("fill", [fill_in, lambda known, mask: interpolate(known, mask, "bilinear")])
def test_known_rows_are_interpolated_linearly_and_repeated_at_the_ends(fill):
    slope = torch.arange(12.0)[:, None] * torch.linspace(1, 2, 8)
    filled = fill(slope.expand(2, 2, 12, 8), rows_mask((2, 2, 12, 8), 1, 5, 7))
    expected = torch.arange(12.0).clamp(1, 7)[:, None] * torch.linspace(1, 2, 8)
    torch.testing.assert_close(filled, expected.expand(2, 2, 12, 8))


def test_one_known_pixel_fills_its_channel_only():
    known, mask = torch.full((1, 2, 8, 16), 0.7), torch.zeros(1, 2, 8, 16)
    mask[0, 0, 3, 5] = 1
    for filled in (fill_in(known, mask), *(interpolate(known, mask, method) for method in METHODS)):
        torch.testing.assert_close(filled[0, 0], torch.full((8, 16), 0.7))
        torch.testing.assert_close(filled[0, 1], torch.zeros(8, 16))


@pytest.mark.parametrize("method", METHODS)
def test_known_pixels_stay_and_unknown_values_do_not_matter(method):
    for known, mask in (random_case(0.3), (torch.randn(2, 2, 8, 16), rows_mask((2, 2, 8, 16), 0, 3, 4))):
        poisoned = torch.where(mask == 1, known, torch.nan)
        for result in (interpolate(poisoned, mask, method), fill_in(poisoned, mask)):
            assert torch.equal(result[mask == 1], known[mask == 1])
            assert result.isfinite().all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("density", [0.05, 0.4])
def test_the_width_is_a_ring(method, density):
    known, mask = random_case(density, seed=3)
    expected = interpolate(known, mask, method).roll(5, 3)
    torch.testing.assert_close(interpolate(known.roll(5, 3), mask.roll(5, 3), method), expected)


@pytest.mark.parametrize("density", [0.01, 0.1, 0.5])
def test_nearest_is_at_the_euclidean_distance(density):
    # the value of a known pixel is its place, so that the result tells which one was taken
    _, mask = random_case(density, seed=1)
    place = torch.arange(8.0 * 16).view(8, 16).expand_as(mask)
    taken = interpolate(place, mask, "nearest").long()
    rows, columns = torch.arange(8)[:, None], torch.arange(16)
    for b, c in ((0, 0), (0, 1), (1, 0), (1, 1)):
        known = mask[b, c].nonzero()
        if len(known) == 0:
            continue
        dx = (columns[:, None] - known[:, 1]).remainder(16)
        squared = (rows[..., None] - known[:, 0]) ** 2 + torch.minimum(dx, 16 - dx)[None] ** 2
        found_dx = (columns - taken[b, c] % 16).remainder(16)
        found = (rows - taken[b, c] // 16) ** 2 + torch.minimum(found_dx, 16 - found_dx) ** 2
        torch.testing.assert_close(found, squared.min(-1).values)
        assert mask[b, c].flatten()[taken[b, c].flatten()].all()


@pytest.mark.parametrize("radius", [1, 2, 3, 16])
def test_nearest_around_looks_no_farther_than_its_radius(radius):
    known, mask = random_case(0.1, seed=2)
    mask = mask.bool()
    mask[1, 1] = False
    values, found = nearest_around(known, mask, radius)
    torch.testing.assert_close(values, interpolate(known, mask, "nearest") * found)
    steps = range(-radius, radius + 1)
    near = [
        mask.roll(dx, 3).roll(dy, 2) & _rows_left(mask, dy)
        for dx in steps
        for dy in steps
        if dx**2 + dy**2 <= radius**2
    ]
    assert torch.equal(found, torch.stack(near).any(0))


def _rows_left(mask: torch.Tensor, dy: int) -> torch.Tensor:
    """Bool: pixels into which a shift by dy rows does not wrap."""
    row = torch.arange(mask.shape[2])[:, None] - dy
    return ((row >= 0) & (row < mask.shape[2])).expand_as(mask)


def test_bicubic_has_the_weights_of_keys_kernel_half_way():
    values = torch.tensor([0.0, 1.0, 4.0, 9.0])  # rows 0, 2, 4, 6
    known = torch.zeros(1, 1, 8, 4)
    known[0, 0, ::2] = values[:, None]
    result = interpolate(known, rows_mask((1, 1, 8, 4), 0, 2, 4, 6), "bicubic")
    weights = torch.tensor([-0.09375, 0.59375, 0.59375, -0.09375])  # a = -3/4 at 1/2
    torch.testing.assert_close(result[0, 0, 3], (weights * values).sum().expand(4))
    torch.testing.assert_close(result[0, 0, ::2], values[:, None].expand(4, 4))


def test_bicubic_is_torch_bicubic_at_true_alignment():
    """Rows 0, 4, ... sampled where torch's half-pixel grid puts them."""
    x = torch.randn(1, 2, 8, 6, generator=torch.Generator().manual_seed(0))
    place = torch.arange(32) / 4
    grid = torch.cartesian_prod((2 * torch.arange(6) + 1) / 6 - 1, (2 * place + 1) / 8 - 1).view(1, 6, 32, 2)
    options = {"mode": "bicubic", "padding_mode": "border", "align_corners": False}
    expected = torch.nn.functional.grid_sample(x, grid.transpose(1, 2), **options)
    mask = rows_mask((1, 2, 32, 6), *range(0, 32, 4))
    known = torch.zeros(1, 2, 32, 6)
    known[:, :, ::4] = x
    torch.testing.assert_close(interpolate(known, mask, "bicubic"), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("method", METHODS)
def test_resize_rows_equals_opencv_and_torch(fixture_tensors, method):
    expected = fixture_tensors("iln_interpolation")
    truth = expected["lidargen.range_m"]
    resized = resize_rows(truth[:, :, ::4], 64, method)
    torch.testing.assert_close(resized, expected[f"lidargen.{method}"], atol=1e-4, rtol=0)
    torch.testing.assert_close(resized, expected[f"torch_interpolate.{method}"], atol=1e-4, rtol=0)
    torch.testing.assert_close((resized - truth).abs().mean(), expected[f"lidargen.{method}.mae"].squeeze())


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("grid", ["grid_64x64", "grid_40x100"])
def test_sample_queries_equals_iln(fixture_tensors, method, grid):
    expected = fixture_tensors("iln_interpolation")
    result = sample_queries(expected["input"], expected[f"{grid}.queries"], method)
    torch.testing.assert_close(result, expected[f"{grid}.{method}"].transpose(1, 2), atol=1e-5, rtol=0)


@pytest.mark.parametrize("method", METHODS)
def test_resized_beams_are_a_baseline_of_their_own(method):
    """Nearest ones as blocks of four rows; and only of every k-th beam from the first."""
    sensor = ls.get_sensor("vlp-16").resized(width=8)
    metres = np.arange(1, 129, dtype=np.float32).reshape(16, 8)
    image = RangeImage(metres, metres / 200, np.ones((16, 8), bool), sensor)
    known = np.zeros((16, 8), bool)
    known[::4] = True
    filled = interpolated(image.keep(known), known, f"resized-{method}")
    pixels = torch.from_numpy(metres[::4])[None, None]
    np.testing.assert_array_equal(filled.range, resize_rows(pixels, 16, method)[0, 0].clamp(min=0).numpy())
    if method == "nearest":
        np.testing.assert_array_equal(filled.range, metres[::4].repeat(4, 0))
    with pytest.raises(ValueError, match=r"resized-\w+: expected every k-th beam from the first one"):
        interpolated(image.keep(known), np.roll(known, 1, 0), f"resized-{method}")


def test_errors_say_both_sides():
    x = torch.zeros(1, 2, 8, 16)
    with pytest.raises(ValueError, match=r"both be \(B, C, H, W\), got \(1, 2, 8, 16\) and \(1, 1, 8, 16\)"):
        fill_in(x, x[:, :1])
    with pytest.raises(ValueError, match=r"method must be one of .* got 'cubic'"):
        interpolate(x, x, "cubic")


def test_the_nearest_known_pixels_along_both_axes():
    generator = torch.Generator().manual_seed(5)
    known = torch.rand(1, 1, 5, 7, generator=generator)
    mask = torch.rand(1, 1, 5, 7, generator=generator) < 0.3
    values, found = nearest_along_axes(known, mask)
    for row in range(5):
        for column in range(7):
            around = [(column + step) % 7 for step in range(7)]
            ways = ([(row, c) for c in [column, *around[:0:-1]]], [(row, c) for c in around],
                    [(r, column) for r in range(row, -1, -1)], [(r, column) for r in range(row, 5)])  # fmt: skip
            for way, path in enumerate(ways):
                hits = [float(known[0, 0, r, c]) for r, c in path if mask[0, 0, r, c]]
                assert bool(found[way, 0, 0, row, column]) == bool(hits)
                assert float(values[way, 0, 0, row, column]) == (hits[0] if hits else 0.0)
