"""Convolutions over occupied voxels only, in plain torch: hash of voxels, gather, matmul, scatter; forward only.

Equal to torchsparse 1.4 and 2.0, order of the kernel's offsets, of coarser voxels and of corners included. A voxel is a
row (x, y, z, batch) of whole numbers in units of the finest voxel, also at coarser strides, where x, y, z are multiples
of the stride.
"""

from __future__ import annotations

from functools import cached_property
from itertools import product

import torch
from torch import Tensor, nn

# Offsets of a 3 x 3 x 3 kernel: x fastest, then y, z slowest; number 13 is the centre, number 26 - k is the opposite.
OFFSETS_3 = tuple((x, y, z) for z, y, x in product((-1, 0, 1), repeat=3))
# Offsets of a 2 x 2 x 2 kernel, and the corners around a point: z fastest, x slowest.
OFFSETS_2 = tuple(product((0, 1), repeat=3))
CENTRE = 13
Pairs = list[tuple[int, Tensor, Tensor]]  # number of the offset, rows of the inputs, rows of the outputs


class Level:
    """The occupied voxels at one stride, and what lies next to what; each map is made once and kept.

    coordinates  (N, 4) int64: x, y, z, batch; no row twice
    stride       all x, y, z are multiples of it, a power of two

    Raises ValueError for another shape, no voxel, a voxel that comes twice, or a grid of more than 2^62 cells.
    """

    def __init__(self, coordinates: Tensor, stride: int = 1):
        if coordinates.ndim != 2 or coordinates.shape[1] != 4 or not len(coordinates):
            raise ValueError(f"expected voxels (N, 4) as x, y, z, batch, at least one, got {tuple(coordinates.shape)}")
        self.coordinates, self.stride = coordinates.long(), stride
        bits = stride.bit_length() - 1  # shifts floor, and are several times faster than divisions
        self._bits = torch.tensor([bits, bits, bits, 0], device=coordinates.device)
        cells = self._cells(self.coordinates)
        self._least = cells.amin(0) - 1  # a free cell on every side, so that a neighbour never wraps into the next row
        self._sizes = (cells.amax(0) - self._least + 2).tolist()
        if self._sizes[0] * self._sizes[1] * self._sizes[2] * self._sizes[3] > 1 << 62:
            raise ValueError(f"expected voxels of a grid with at most 2^62 cells, found {self._sizes}")
        self._keys, self._order = self._key(cells).sort()
        if len(self._keys) > 1 and (self._keys[1:] == self._keys[:-1]).any():
            raise ValueError("expected every voxel once, found one twice")

    def __len__(self) -> int:
        return len(self.coordinates)

    def _cells(self, coordinates: Tensor) -> Tensor:
        return coordinates >> self._bits

    def _key(self, cells: Tensor) -> Tensor:
        """(N,) one number per cell that rises with batch, then x, y and z: a hash without collisions."""
        x, y, z, batch = (cells - self._least).unbind(1)
        return ((batch * self._sizes[0] + x) * self._sizes[1] + y) * self._sizes[2] + z

    def find(self, coordinates: Tensor) -> Tensor:
        """(M,) int64: the row of each of the voxels (M, 4), -1 where it is not occupied."""
        cells = self._cells(coordinates)
        most = self._least + cells.new_tensor(self._sizes)
        inside = ((cells >= self._least) & (cells < most) & (cells << self._bits == coordinates)).all(1)
        key = torch.where(inside, self._key(cells), -1)
        place = torch.searchsorted(self._keys, key).clamp(max=len(self._keys) - 1)
        return torch.where(self._keys[place] == key, self._order[place], -1)

    @cached_property
    def neighbours(self) -> Pairs:
        """Rows of voxels that are neighbours by the first half of OFFSETS_3's opposite pairs, the centre left out.

        (k, inputs, outputs): outputs + OFFSETS_3[k] * stride = inputs; swapped, the same rows are the pairs of 26 - k.
        """
        padded = torch.cat([self._keys, self._keys.new_full((3,), -1)])
        pairs: Pairs = []
        # voxels that differ in z only follow each other, so one search finds all three of a column
        for x, y in ((0, 0), (1, -1), (1, 0), (1, 1), (0, 1)):
            below = self._keys + (x * self._sizes[1] + y) * self._sizes[2] - 1
            place = torch.searchsorted(self._keys, below)
            for z in (-1, 0, 1):
                met = padded[place] == below + (z + 1)
                if (x, y, z) > (0, 0, 0):
                    rows = met.nonzero()[:, 0]
                    pairs.append((OFFSETS_3.index((x, y, z)), self._order[place[rows]], self._order[rows]))
                place = place + met
        return pairs

    @cached_property
    def parents(self) -> tuple[Level, Pairs]:
        """The level of twice the stride, ordered by batch, x, y, z; and for each of OFFSETS_2 (k, rows, parents' rows).

        A voxel's parent is floor(c / 2t) * 2t, and k says where in it the voxel lies.
        """
        twice = self._bits + self._bits.new_tensor([1, 1, 1, 0])
        own = self.coordinates >> twice << twice
        _, parent = torch.unique(self._key(self._cells(own)), return_inverse=True)
        coarse = own.new_empty(int(parent.max()) + 1, 4)
        coarse[parent] = own
        x, y, z, _ = self._cells(self.coordinates - own).unbind(1)
        number = 4 * x + 2 * y + z
        rows = [(number == k).nonzero()[:, 0] for k in range(8)]
        return Level(coarse, 2 * self.stride), [(k, own_rows, parent[own_rows]) for k, own_rows in enumerate(rows)]


def levels_of(coordinates: Tensor, count: int) -> list[Level]:
    """The levels of strides 1, 2, 4, ... of voxels (N, 4). Raises ValueError as `Level` does."""
    levels = [Level(coordinates)]
    while len(levels) < count:
        levels.append(levels[-1].parents[0])
    return levels


def convolve(features: Tensor, level: Level, kernel: Tensor, bias: Tensor | None = None) -> Tensor:
    """(N, C') of features (N, C) at a level's voxels; kernel (27, C, C'): sum over k of in[q + offset_k] @ kernel[k].

    A kernel (C, C') of one cell is a matrix product. `bias` (C',) is added.
    """
    bias = kernel.new_zeros(kernel.shape[-1]) if bias is None else bias
    if kernel.ndim == 2:
        return torch.addmm(bias, features, kernel)
    result = torch.addmm(bias, features, kernel[CENTRE])
    for k, inputs, outputs in level.neighbours:
        result.index_add_(0, outputs, features.index_select(0, inputs) @ kernel[k])
        result.index_add_(0, inputs, features.index_select(0, outputs) @ kernel[26 - k])
    return result


def shrink(features: Tensor, level: Level, kernel: Tensor, bias: Tensor | None = None) -> Tensor:
    """(M, C') at twice the stride, of features (N, C) at `level`; kernel (8, C, C'), size 2, stride 2."""
    coarse, parents = level.parents
    bias = kernel.new_zeros(kernel.shape[-1]) if bias is None else bias
    result = bias.repeat(len(coarse), 1)
    for k, rows, parent in parents:
        result.index_add_(0, parent, features.index_select(0, rows) @ kernel[k])
    return result


def grow(features: Tensor, level: Level, kernel: Tensor, bias: Tensor | None = None) -> Tensor:
    """(N, C') at `level`, of features (M, C) at twice its stride: the transpose of `shrink`, kernel (8, C, C')."""
    bias = kernel.new_zeros(kernel.shape[-1]) if bias is None else bias
    result = features.new_empty(len(level), kernel.shape[2])
    for k, rows, parent in level.parents[1]:
        result[rows] = torch.addmm(bias, features.index_select(0, parent), kernel[k])
    return result


def with_norm(kernel: Tensor, norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """A kernel (..., C, C') and a bias (C',) that do at once what the kernel and then `norm` do in evaluation mode."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return kernel * scale, norm.bias - norm.running_mean * scale


class Kernel(nn.Module):
    """Weights of one convolution without bias, under the published name `kernel`: (27 or 8, C, C'), or (C, C')."""

    def __init__(self, cells: int, inputs: int, outputs: int):
        super().__init__()
        shape = (inputs, outputs) if cells == 1 else (cells, inputs, outputs)
        self.kernel = nn.Parameter(torch.empty(shape), requires_grad=False)
        nn.init.normal_(self.kernel, std=(cells * inputs) ** -0.5)
