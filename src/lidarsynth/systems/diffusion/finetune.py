"""Weights of one experiment as the start of another: other sensors and resolutions, told known pixels or not."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor, nn

from lidarsynth.experiment.record import Experiment
from lidarsynth.networks.tensors import load_weights

# Fields of the model that do not change what weights mean; residual blocks more than the weights have begin as identity
FREE = ("model.network", "model.ring", "model.dropout", "model.candidates", "model.around", "model.num_residual_blocks")
MEANING = ("data.codec", "diffusion.kind", "diffusion.schedule")  # fields outside the model that do
FIRST = "in_conv.weight"
LAST = "out_conv."
REFINENET = "refinenet"  # has nothing in common with the others, which differ by what they are told
CHANNELS = 2  # range and reflectance


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """Copy trained `weights` (of experiment `source`, called `name`) into the fresh `network` of `experiment`.

    The sensor may differ: ray angles stay those of `experiment`. The resolution may differ: new frequencies of the
    position encoding start at zero. A network that is not told the known pixels may become one that is, and back: their
    channels start at zero. Everything else must be equal. Raises ValueError that lists the fields that differ.
    """
    words = [e.model.network for e in (experiment, source)]
    if words[0] != words[1] and REFINENET in words:
        raise ValueError(f"{name}: expected weights of {words[0]}, found those of {words[1]}, another network")
    different = differences(experiment, source)
    if different:
        wanted = "--set " + " ".join(f"{field}={_word(theirs)}" for field, _, theirs in different)
        found = ", ".join(f"{field}={_word(ours)}" for field, ours, _ in different)
        raise ValueError(f"{name}: expected an experiment like that of the weights ({wanted}), found {found}")
    own, theirs = network.state_dict(), _bare(weights.state_dict())
    start = {}
    for key in dict(network.named_parameters()):
        bare = _bare_name(key)
        if bare == FIRST:
            start[key] = _first_layer(_bare(own), theirs, image_channels(experiment), image_channels(source))
        elif bare in theirs and bare.startswith(LAST):
            start[key] = _last_layer(own[key], theirs[bare])
        elif bare in theirs:
            start[key] = theirs[bare]
        elif ".residual_blocks." in bare:
            start[key] = own[key]
    load_weights(network, {**dict(network.named_buffers()), **start}, name)


def image_channels(experiment: Experiment) -> int:
    """How many channels of the first layer come from images: x_t first, then known, mask and interpolation."""
    model = experiment.model
    return model.stem[0] * model.stem[1] * CHANNELS * (4 if model.network == "conditional-unet" else 1)


def differences(experiment: Experiment, source: Experiment) -> list[tuple[str, Any, Any]]:
    """(field, ours, theirs) of the fields that give weights another meaning or shape."""
    fields = [f"model.{key}" for key in asdict(experiment.model)] + list(MEANING)
    pairs = [(field, _value(experiment, field), _value(source, field)) for field in fields if field not in FREE]
    blocks = "model.num_residual_blocks"
    if any(ours < theirs for ours, theirs in zip(_value(experiment, blocks), _value(source, blocks), strict=True)):
        pairs.append((blocks, _value(experiment, blocks), _value(source, blocks)))
    return [(field, ours, theirs) for field, ours, theirs in pairs if ours != theirs]


def _value(experiment: Experiment, field: str) -> Any:
    group, _, key = field.partition(".")
    return getattr(getattr(experiment, group), key)


def _word(value: Any) -> str:
    return "null" if value is None else str(list(value) if isinstance(value, tuple) else value).replace(" ", "")


def _bare_name(key: str) -> str:
    """The parameter's name in a bare U-Net."""
    return key.removeprefix("unet.")


def _bare(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    return {_bare_name(key): tensor for key, tensor in weights.items()}


def _first_layer(own: dict[str, Tensor], theirs: dict[str, Tensor], image: int, old_image: int) -> Tensor:
    """The first convolution (C0, in, 3, 3): the channels both have from `theirs`, zero for the others."""
    weight, old = torch.zeros_like(own[FIRST]), theirs[FIRST].float()
    shared = min(image, old_image)
    weight[:, :shared] = old[:, :shared]
    places = {meaning: old_image + i for i, meaning in enumerate(_encoding(theirs, old.shape[1] - old_image))}
    for i, meaning in enumerate(_encoding(own, weight.shape[1] - image)):
        if meaning in places:
            weight[:, image + i] = old[:, places[meaning]]
    return weight


def _last_layer(own: Tensor, theirs: Tensor) -> Tensor:
    """Weights or bias (out, ...) of the last convolution: what both have from `theirs`, zero for other channels."""
    last, shared = torch.zeros_like(own), min(len(own), len(theirs))
    last[:shared] = theirs[:shared].float()
    return last


def _encoding(weights: dict[str, Tensor], count: int) -> list[tuple]:
    """What each of the `count` channels of the position encoding is, the same words for the same meaning."""
    freqs = weights.get("coords_encoding.freqs")
    if freqs is None:
        return [(i,) for i in range(count)]
    return [(wave, *row) for wave in ("sin", "cos") for row in freqs.flatten(1).tolist()]
