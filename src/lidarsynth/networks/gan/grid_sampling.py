"""Bilinear sampling whose gradient has a gradient: torch's own has none, and R1 differentiates augmentation twice."""

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


def sample_bilinear(x: Tensor, grid: Tensor) -> Tensor:
    """(B,C,h,w) at grid (B,H,W,2), x before y in [-1,1] from edge to edge -> (B,C,H,W); zeros beyond the edges.

    Differentiable any number of times in `x`, in which it is linear; not in `grid`.
    """
    return _Sample.apply(x, grid)  # pyright: ignore[reportReturnType]


def _sample(x: Tensor, grid: Tensor) -> Tensor:
    return F.grid_sample(x, grid, mode="bilinear", padding_mode="zeros", align_corners=False)


class _Sample(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, grid: Tensor) -> Tensor:
        ctx.save_for_backward(grid)
        ctx.shape = x.shape
        return _sample(x, grid)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        (grid,) = ctx.saved_tensors
        return _Spread.apply(grad, grid, ctx.shape), None


class _Spread(torch.autograd.Function):
    """The transpose of `_Sample`."""

    @staticmethod
    def forward(ctx: Any, grad: Tensor, grid: Tensor, shape: torch.Size) -> Tensor:
        ctx.save_for_backward(grid)
        with torch.enable_grad():
            x = grad.new_zeros(shape).requires_grad_()
            return torch.autograd.grad(_sample(x, grid), x, grad)[0]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:
        (grid,) = ctx.saved_tensors
        return _Sample.apply(grad, grid), None, None
