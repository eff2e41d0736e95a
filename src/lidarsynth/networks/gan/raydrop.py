"""The measurement model of DUSty: each ray returns with a learnt probability (Nakashima & Kurazume, IROS 2021)."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class GeneratedImages:
    """What a GAN's generator returns; maps are (B,1,H,W), inverse depth in [-1,1] nominally, -1 = no return."""

    image: Tensor  # with ray-drop, where the network has it
    image_orig: Tensor  # before ray-drop
    w: Tensor  # styles (B,D), after truncation
    raydrop_logit: Tensor | None = None  # sigmoid of it = probability that the pixel is kept; (B,2,H,W) of DUSty-II
    raydrop_mask: Tensor | None = None  # 1 = kept, 0 = dropped, by both maps of DUSty-II; the relaxed sample's gradient


def relaxed_bernoulli(logit: Tensor, uniform: Tensor, temperature: float = 1.0) -> Tensor:
    """Samples 0 or 1 with P(1) = sigmoid(logit), differentiable by the straight-through Gumbel-sigmoid estimator.

    `uniform` in [0,1) broadcasts against `logit`: one map for a whole batch gives all its images the same noise.
    DUSty section III-C.
    """
    tiny = torch.finfo(torch.float32).eps  # in half precision 1 - tiny would be 1
    p = torch.sigmoid(logit.float()).clamp(tiny, 1 - tiny)
    u = uniform.clamp(tiny, 1 - tiny)
    soft = torch.sigmoid((u.log() - (1 - u).log() + p.log() - (1 - p).log()) / temperature)
    hard = (soft > 0.5).to(soft.dtype)
    return (hard - soft).detach() + soft


class RayDrop(nn.Module):
    """Sets dropped pixels to `raydrop_const`: image and logit (B,1,H,W), uniform noise -> (image, mask).

    DUSty-II has two logits (B,2,H,W) and as many masks, and keeps what both keep. Of the second mask, the image's, the
    noise of training is one value for each image, `uniform[:, 1]`, and there is none in evaluation mode, where it keeps
    what is likelier kept than not. Raises ValueError if training lacks it.
    """

    raydrop_const: Tensor

    def __init__(self, const: float = -1.0, temperature: float = 1.0):
        super().__init__()
        self.temperature = temperature
        self.register_buffer("raydrop_const", torch.tensor(const))

    def forward(self, image: Tensor, logit: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        if logit.shape[1] == 2:
            pixels = relaxed_bernoulli(logit[:, :1], uniform[:, :1], self.temperature)
            mask = torch.cat([pixels, self._image(logit[:, 1:], uniform)], dim=1).to(image.dtype)
            kept = mask[:, :1] * mask[:, 1:]
        else:
            kept = mask = relaxed_bernoulli(logit, uniform, self.temperature).to(image.dtype)
        return torch.lerp(image, self.raydrop_const.to(image.dtype), 1 - kept), mask

    def _image(self, logit: Tensor, uniform: Tensor) -> Tensor:
        """The second mask (B,1,H,W) of DUSty-II."""
        if not self.training:
            return (logit > 0).to(logit.dtype)
        if uniform.shape[1] != 2:
            raise ValueError(f"uniform must have noise of pixels and of images, (B, 2, H, W), to train DUSty-II, got "
                             f"{tuple(uniform.shape)}")  # fmt: skip
        return relaxed_bernoulli(logit, uniform[:, 1:], self.temperature)


def measured(model: RayDrop | None, maps: dict[str, Tensor], uniform: Tensor | None, w: Tensor) -> GeneratedImages:
    """The generator's maps `image` and `raydrop_logit` through the ray-drop model, or untouched where it is None.

    Raises ValueError if the model needs uniform noise and none was given.
    """
    image = maps["image"]
    if model is None:
        return GeneratedImages(image, image, w)
    if uniform is None:
        raise ValueError(
            "uniform must be a tensor that broadcasts to (B, 1, H, W) for a generator with ray-drop, got None"
        )
    logit = maps["raydrop_logit"]
    dropped, mask = model(image, logit, uniform)
    return GeneratedImages(dropped, image, w, logit, mask)
