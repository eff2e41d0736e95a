"""Official checkpoints of the systems that the paper compares with: tensors by name, and into a network.

Arguments are what torch.load(..., weights_only=True) returned. Every error is a ValueError that says what was expected
and what was found; the caller puts the file's name before it.
"""

from torch import Tensor, nn


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


def fill(network: nn.Module, weights: dict[str, Tensor]) -> None:
    """Put tensors into a network. Raises ValueError, naming the first, when names or shapes do not fit."""
    expected = {key: tuple(value.shape) for key, value in network.state_dict().items()}
    found = {key: tuple(value.shape) for key, value in weights.items()}
    wrong = [key for key in {**expected, **found} if expected.get(key) != found.get(key)]
    if wrong:
        key = wrong[0]
        raise ValueError(
            f"expected {key} {expected.get(key, 'not to be there')} for {type(network).__name__}, "
            f"found {found.get(key, 'none')}; {len(wrong)} tensors do not fit"
        )
    network.load_state_dict(weights)
