"""The first release of the vanilla GAN, DUSty-I and DUSty-II (IROS 2021): its names and noise, in terms of ours.

Build `gan.Generator(..., bounded=True)`, of DUSty-II with `image_mask`; and
`gan.Discriminator(..., vertical="reflect")`.
"""

import re
from collections.abc import Mapping

import torch
from torch import Tensor

_HEADS = {"depth": "image", "confidence": "raydrop_logit"}


def generator_weights(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """State dict of the release's G or G_ema -> that of `gan.Generator`; the release has no mean style, it is 0.

    Raises ValueError for keys that are not of the release.
    """
    weights: dict[str, Tensor] = {}
    for key, value in state.items():
        if key == "drop_const":
            weights["measurement_model.raydrop_const"] = value
        else:
            weights[f"synthesis_network.{_layer(key.removeprefix('backbone.'))}"] = value
    first = weights.get("synthesis_network.0.1.module.weight")
    if first is None:
        raise ValueError(
            f"expected the weights of the IROS 2021 generator, found {len(state)} keys without its first layer"
        )
    return {**weights, "w_avg": first.new_zeros(1, len(first))}


def masks(state: Mapping[str, Tensor]) -> int:
    """How many masks a generator of `generator_weights` has: none, of pixels (DUSty-I), of images too (DUSty-II).

    Raises ValueError for more.
    """
    bias = state.get("synthesis_network.4.heads.raydrop_logit.1.module.bias")
    if bias is None:
        return 0
    if tuple(bias.shape) not in ((1,), (2,)):
        raise ValueError(f"expected 1 ray-drop logit per pixel (DUSty-I) or 2 (DUSty-II), found {tuple(bias.shape)}")
    return len(bias)


def _layer(key: str) -> str:
    if match := re.fullmatch(r"0\.([01])\.(module\.weight|bias)", key):
        return f"0.{int(match[1]) + 1}.{match[2]}"  # the first block starts without padding
    if match := re.fullmatch(r"4\.heads\.(depth|confidence)\.(.+)", key):
        return f"4.heads.{_HEADS[match[1]]}.{match[2]}"
    if re.fullmatch(r"[123]\.(1\.module\.weight|2\.bias)", key):
        return key
    raise ValueError(f"expected a key of the IROS 2021 generator, found {key!r}")


def discriminator_weights(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """State dict of the release's D -> that of `gan.Discriminator`: its blur filters are images of three pixels."""
    return {key: value.flatten() if key.endswith("kernel") else value for key, value in state.items()}


def uniform_noise(first: Tensor, second: Tensor) -> Tensor:
    """Two uniforms in [0,1), any shape -> the one whose logit is the release's logistic noise."""
    tiny = 1e-10
    return torch.sigmoid(-torch.log((first + tiny).log() / (second + tiny).log() + tiny))
