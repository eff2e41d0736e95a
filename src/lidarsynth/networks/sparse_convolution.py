"""Convolutions over occupied voxels only, in plain torch: hash of voxels, gather, matmul, scatter; forward only.

Equal to torchsparse 1.4 and 2.0, order of the kernel's offsets, of coarser voxels and of corners included. A voxel is a
row (x, y, z, batch) of whole numbers in units of the finest voxel, also at coarser strides, where x, y, z are multiples
of the stride.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

# Offsets of a 3 x 3 x 3 kernel: x fastest, then y, z slowest; number 13 is the centre, number 26 - k is the opposite.
OFFSETS_3 = tuple((x, y, z) for z, y, x in product((-1, 0, 1), repeat=3))
# Offsets of a 2 x 2 x 2 kernel, and the corners around a point: z fastest, x slowest.
OFFSETS_2 = tuple(product((0, 1), repeat=3))
CENTRE = 13
Pairs = list[tuple[int, Tensor, Tensor]]  # number of the offset, rows of the inputs, rows of the outputs


class Sums(NamedTuple):
    """Which rows of a table of products are added up to row i of a result: order[starts[i] : starts[i + 1]]."""

    order: Tensor
    starts: Tensor

    def of(self, products: Tensor) -> Tensor:
        """(rows, C) of the products (n, C); three times faster than to add one offset's products after another's."""
        return embedding_bag(self.order, products, self.starts, mode="sum", include_last_offset=True)


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
        self._room: dict[str, Tensor] = {}
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
    def neighbours(self) -> tuple[list[tuple[int, Tensor]], Sums]:
        """(k, rows) of the voxels that are a neighbour by OFFSETS_3[k] of some voxel, and what sums their products.

        The products are those of all voxels with the kernel's centre, and then those of the rows in their order.
        """
        rows: list[tuple[int, Tensor]] = []
        results = [torch.arange(len(self), device=self._keys.device)]
        for k, inputs, outputs in self._pairs():
            rows += [(k, inputs), (26 - k, outputs)]  # the same pairs, seen from the other side
            results += [outputs, inputs]
        result = torch.cat(results)
        starts = result.new_zeros(len(self) + 1)
        torch.cumsum(torch.bincount(result, minlength=len(self)), 0, out=starts[1:])
        return rows, Sums(torch.argsort(result, stable=True), starts)

    def _pairs(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        """(k, inputs, outputs) of one of each two opposite offsets: outputs + OFFSETS_3[k] * stride = inputs."""
        padded = torch.cat([self._keys, self._keys.new_full((3,), -1)])
        # voxels that differ in z only follow each other, so one search finds all three of a column
        for x, y in ((0, 0), (1, -1), (1, 0), (1, 1), (0, 1)):
            below = self._keys + (x * self._sizes[1] + y) * self._sizes[2] - 1
            place = torch.searchsorted(self._keys, below)
            for z in (-1, 0, 1):
                met = padded[place] == below + (z + 1)
                if (x, y, z) > (0, 0, 0):
                    found = met.nonzero()[:, 0]
                    yield OFFSETS_3.index((x, y, z)), self._order[place[found]], self._order[found]
                place = place + met

    def room(self, kind: str, rows: int, columns: int, like: Tensor) -> Tensor:
        """(rows, columns) of any content; the next call of the same kind gives the same memory again.

        For what is dropped at once: fresh memory costs about as much time as what is done in it.
        """
        kept = self._room.get(kind)
        if kept is None or kept.numel() < rows * columns or kept.dtype != like.dtype:
            kept = self._room[kind] = like.new_empty(rows * columns)
        return kept[: rows * columns].view(rows, columns)

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
    rows, sums = level.neighbours
    products = level.room("products", len(sums.order), kernel.shape[2], features)
    counts = [of_offset.numel() for _, of_offset in rows]
    inputs = level.room("inputs", max(counts, default=0), features.shape[1], features)
    matrices, parts = kernel.unbind(), products.split([len(level), *counts])
    torch.addmm(bias, features, matrices[CENTRE], out=parts[0])
    for (k, of_offset), count, part in zip(rows, counts, parts[1:], strict=True):
        torch.index_select(features, 0, of_offset, out=inputs[:count])
        torch.mm(inputs[:count], matrices[k], out=part)
    return sums.of(products)


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


def with_norm(kernel: Tensor, norm: nn.BatchNorm1d, bias: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
    """A kernel (..., C, C') and a bias (C',) that do at once what `kernel`, `bias` and then `norm` do in evaluation."""
    assert norm.running_mean is not None and norm.running_var is not None
    scale = norm.weight / torch.sqrt(norm.running_var + norm.eps)
    return kernel * scale, norm.bias + (bias - norm.running_mean) * scale


class Kernel(nn.Module):
    """Weights of one convolution without bias, under the published name `kernel`: (27 or 8, C, C'), or (C, C').

    Zeros, for they are read and never trained.
    """

    def __init__(self, cells: int, inputs: int, outputs: int):
        super().__init__()
        shape = (inputs, outputs) if cells == 1 else (cells, inputs, outputs)
        self.kernel = nn.Parameter(torch.zeros(shape), requires_grad=False)
