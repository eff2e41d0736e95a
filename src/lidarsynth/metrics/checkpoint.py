"""Published weights of the feature networks: tensors by name from a file, and into a module, with clear errors."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import torch
from torch import Tensor, nn


def read_state(file: str | Path | BinaryIO, where: str) -> dict[str, Tensor]:
    """Tensors by name of a state_dict that torch.save wrote, old formats too, read with `weights_only`, on the CPU.

    where  names the file in errors. Raises ValueError for anything else, damaged files and pickled code included.
    """
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ValueError(f"{where}: expected weights, found {error.strerror or error}") from None
    except Exception as error:  # a damaged pickle raises whatever it likes
        reason = str(error).rpartition("WeightsUnpickler error:")[2].strip().partition("\n")[0]
        raise ValueError(f"{where}: expected weights, found a damaged or unsafe file ({reason:.120})") from None
    if not isinstance(state, dict) or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()):
        raise ValueError(f"{where}: expected tensors by name, found {type(state).__name__}")
    return state


def load_state(module: nn.Module, state: dict[str, Tensor], where: str) -> None:
    """Put tensors into a module; counters of batch normalisation may be absent.

    where  names the file in errors. Raises ValueError, naming the first, when names or shapes do not fit.
    """
    own = module.state_dict()
    expected = {key: tuple(value.shape) for key, value in own.items()}
    counters = {key for key in own if key.endswith("num_batches_tracked")}
    found = {key: tuple(value.shape) for key, value in state.items()}
    wrong = [key for key in {**expected, **found} if expected.get(key) != found.get(key)]
    wrong = [key for key in wrong if key in found or key not in counters]
    if wrong:
        key = wrong[0]
        raise ValueError(f"{where}: expected {key} {expected.get(key, 'not to be there')}, found "
                         f"{found.get(key, 'none')}; {len(wrong)} tensors do not fit")  # fmt: skip
    module.load_state_dict({**{key: own[key] for key in counters}, **state})
