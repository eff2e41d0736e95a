"""Tensors by name: from files and checkpoints, and into a network, with clear errors."""

from __future__ import annotations

import warnings
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lidarsynth.networks.finite import not_finite

SPREAD = 1 << 28  # bytes that a repeated number may claim
DRAWS = {Tensor.uniform_, Tensor.normal_, nn.init.uniform_, nn.init.normal_, nn.init.kaiming_uniform_}


class Undrawn(TorchFunctionMode):
    """`with Undrawn():` modules are built without drawing weights: for those that a file then gives, all of them."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in DRAWS:
            return args[0] if args else kwargs["tensor"]
        return func(*args, **kwargs)


def read_pickle(file: str | Path | BinaryIO, where: str, advice: str = "") -> Any:
    """What torch.save wrote, old formats too, read with `weights_only`, on the CPU: tensors and plain containers.

    where  names the file in errors. Raises ValueError for anything else: damaged files, and pickled classes, which it
    names; `advice`, such as CONVERT, follows them.
    """
    try:
        with warnings.catch_warnings():  # of torch, about old formats and sparse tensors: three lines for one
            warnings.simplefilter("ignore")
            content = torch.load(file, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ValueError(f"{where}: expected weights, found {error.strerror or error}") from None
    except Exception as error:  # a damaged pickle raises whatever it likes
        if classes := _classes_of(file):
            raise ValueError(f"{where}: expected tensors, found a damaged or unsafe file: a pickle of "
                             f"{', '.join(classes)[:120]}, which is not loaded{advice}") from None  # fmt: skip
        reason = str(error).rpartition("WeightsUnpickler error:")[2].strip().partition("\n")[0]
        raise ValueError(f"{where}: expected weights, found a damaged or unsafe file ({reason:.120})") from None
    return plain(content, where)


def saved_shape(path: Path) -> tuple[int, ...]:
    """Of a file in which torch.save put one tensor, without its numbers; () of any other, and where the tensor claims
    more numbers than the file has bytes."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            content = torch.load(path, map_location="meta", weights_only=True)
    except Exception:  # `read_pickle` says what is wrong
        return ()
    return tuple(content.shape) if isinstance(content, Tensor) and content.numel() <= path.stat().st_size else ()


def as_array(given: Any) -> Any:
    """A tensor's numbers as an array, floating ones as float32, from any device; anything else as it is.

    Raises ValueError for a tensor that holds no plain numbers.
    """
    if not isinstance(given, Tensor):
        return given
    if given.is_meta or given.is_quantized or given.is_nested or given.layout != torch.strided:
        raise ValueError(f"expected a tensor of plain numbers, found one of {given.layout} on {given.device}, "
                         f"{given.dtype}")  # fmt: skip
    given = given.detach().cpu()
    return (given.float() if given.is_floating_point() else given).numpy()


def plain(content: Any, where: str) -> Any:
    """The same tables and lists with every tensor detached. Raises ValueError for tensors that hold no plain numbers.

    A crafted file may hold sparse, quantised, complex or nested tensors, and such of the device "meta", without values.
    """
    if isinstance(content, Tensor):
        ordinary = content.layout == torch.strided and content.device.type == "cpu"
        if not ordinary or content.is_quantized or content.is_complex() or content.is_nested or _spread(content):
            raise ValueError(f"{where}: expected tensors of plain numbers, found one of {content.layout} on "
                             f"{content.device}, {content.dtype}")  # fmt: skip
        return content.detach()
    if type(content) in (dict, OrderedDict):
        return {key: plain(value, where) for key, value in content.items()}
    if type(content) in (list, tuple):
        return type(content)(plain(value, where) for value in content)
    return content


def _spread(tensor: Tensor) -> bool:
    """Whether it claims far more numbers than its file holds, as one number repeated a billion times does."""
    claimed = tensor.numel() * tensor.element_size()
    return claimed > max(tensor.untyped_storage().nbytes(), SPREAD)


CONVERT = (  # loading it for good runs what it names, so not here and not at the user's desk
    '; if you trust its origin, convert it once in a container without network: python -c "import torch; '
    "torch.save(torch.load('model.ckpt', map_location='cpu', weights_only=False)['state_dict'], 'tensors.ckpt')\""
)


def _classes_of(file: str | Path | BinaryIO) -> list[str]:
    """Names of the classes and functions that a zip checkpoint wants to import, without importing any; [] of others."""
    try:
        if not isinstance(file, str | Path):
            file.seek(0)
        return sorted(torch.serialization.get_unsafe_globals_in_checkpoint(file))
    except Exception:  # not of the zip format, or damaged
        return []


def read_state(file: str | Path | BinaryIO, where: str) -> dict[str, Tensor]:
    """Tensors by name of a state_dict that torch.save wrote, old formats too, read with `weights_only`, on the CPU.

    where  names the file in errors. Raises ValueError for anything else, damaged files and pickled code included.
    """
    state = read_pickle(file, where)
    if not isinstance(state, dict) or not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in state.items()):
        raise ValueError(f"{where}: expected tensors by name, found {type(state).__name__}")
    return state


def load_weights(network: nn.Module, weights: Mapping[str, Tensor], where: str = "", counters: bool = False) -> None:
    """Copy tensors into a network, of whatever floating type they are.

    where     names the file in errors
    counters  whether counters of batch normalisation may be absent, as older files have none

    Raises ValueError as `check_shapes`, and for NaN or infinity.
    """
    check_shapes(network, weights, where, counters)
    if name := not_finite(dict(weights)):
        raise ValueError(f"{_begin(where)}expected finite weights, found NaN or infinity in {name}")
    own = network.state_dict()
    spare = {key for key in own if key.endswith("num_batches_tracked")} - weights.keys()
    network.load_state_dict({**{key: own[key] for key in spare}, **weights})


def check_shapes(network: nn.Module, weights: Mapping[str, Tensor], where: str = "", counters: bool = True) -> None:
    """Raises ValueError, naming the first, when names or shapes do not fit; `counters` as in `load_weights`."""
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in weights.items()}
    wrong = [key for key in {**expected, **found} if expected.get(key) != found.get(key)]
    wrong = [key for key in wrong if key in found or not (counters and key.endswith("num_batches_tracked"))]
    if wrong:
        key = wrong[0]
        raise ValueError(
            f"{_begin(where)}expected {key} {expected.get(key, 'not to be there')}, found {found.get(key, 'none')}; "
            f"{len(wrong)} tensors do not fit {type(network).__name__}"
        )


def _begin(where: str) -> str:
    return f"{where}: " if where else ""


def tensors_of(part: object, expected: str, prefix: str = "") -> dict[str, Tensor]:
    """`part` as tensors by name, without the prefix; `expected` begins the error if it is anything else."""
    if not isinstance(part, dict):
        raise ValueError(f"{expected} with tensors by name, found a {type(part).__name__}")
    for key, value in part.items():
        if not isinstance(key, str) or not isinstance(value, Tensor):
            raise ValueError(f"{expected} with tensors by name, found {key!r:.60} {type(value).__name__}")
    return {key.removeprefix(prefix): value for key, value in part.items()}


def iln_tensors(checkpoint: object, name: str) -> dict[str, Tensor]:
    """Tensors of a checkpoint of ILN's repository, dict(epoch, model=dict(name, args, state_dict), ...).

    name  of the model there: "iln", "liif_lidar" or "lsr". Raises ValueError for another one or another structure.
    """
    expected = f"expected a checkpoint of {name!r} in the format of ILN's repository"
    model = checkpoint.get("model") if isinstance(checkpoint, dict) else None
    if not isinstance(model, dict) or not {"name", "state_dict"} <= model.keys():
        keys = f" with keys {list(checkpoint)[:4]}" if isinstance(checkpoint, dict) else ""
        raise ValueError(f"{expected}, found a {type(checkpoint).__name__}{keys}")
    if model["name"] != name:
        raise ValueError(f"{expected}, found one of {model['name']!r:.60}")
    return tensors_of(model["state_dict"], expected)


def iln_arguments(checkpoint: dict, defaults: dict[str, int | bool]) -> dict[str, int | bool]:
    """The network's arguments `model.args` of such a checkpoint over the published `defaults`.

    Raises ValueError for an argument that is not among these, or of another type.
    """
    args = checkpoint["model"].get("args") or {}
    known = isinstance(args, dict) and all(type(value) is type(defaults.get(key)) for key, value in args.items())
    if not known:
        raise ValueError(f"expected model.args of {', '.join(defaults)}, found {args!r:.80}")
    return {**defaults, **args}
