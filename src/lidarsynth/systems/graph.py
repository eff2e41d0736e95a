"""`Graph`: what an exported file of a model holds, whatever its kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor, nn


@dataclass(frozen=True)
class Graph:
    """A module with example inputs.

    does     what one run of it is, in words
    module   tensors in, a tuple of tensors out
    inputs   by name, of one scan
    outputs  their names
    says     what each input and output is, by name: units and ranges
    open_columns  whether inputs of any number of columns fit, in multiples of `multiple`
    """

    does: str
    module: nn.Module
    inputs: Mapping[str, Tensor]
    outputs: tuple[str, ...]
    says: Mapping[str, str] = field(default_factory=dict)
    open_columns: bool = False
    multiple: int = 1
