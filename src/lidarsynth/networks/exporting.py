"""Whether a network is being written down as a graph, in which what is found out on the way cannot choose the way."""

from __future__ import annotations

import torch

# torch 2.6 has the more general question alone, which is true of what `torch.compile` reads as well.
is_exporting = getattr(torch.compiler, "is_exporting", torch.compiler.is_compiling)
