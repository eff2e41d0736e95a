"""One call for the three GAN generators: of Vanilla GAN, DUSty v1 and DUSty v2, the last with the angles it renders."""

import torch
from torch import Tensor, nn

from lidarsynth.networks.gan import dcgan as gan
from lidarsynth.networks.gan import dusty2
from lidarsynth.networks.gan.raydrop import GeneratedImages


class ScanGenerator(nn.Module):
    """Latents (B,Z) ~ N(0,I) -> inverse depth images (B,1,H,W) of one sensor.

    `angles` (1,2,H,W), radians with the elevation first, is what DUSty v2 renders; None for the other two. They are a
    buffer, so that saved weights keep the angles that they were trained with.
    """

    angles: Tensor | None

    def __init__(self, generator: gan.Generator | dusty2.Generator, angles: Tensor | None = None):
        super().__init__()
        self.generator = generator
        self.register_buffer("angles", angles)

    @property
    def latent_channels(self) -> int:
        """Z."""
        if isinstance(self.generator, gan.Generator):
            return self.generator.w_avg.shape[1]
        return self.generator.mapping_network[1][0].module.in_features  # type: ignore[index,union-attr,return-value]

    @property
    def raydrop(self) -> bool:
        """Whether rays are dropped, for which `uniform` is needed."""
        return self.generator.measurement_model is not None

    def forward(
        self,
        z: Tensor,  # (B,Z)
        uniform: Tensor,  # noise in [0,1) of the ray-drop, broadcasts to (B,1,H,W), or, to train DUSty-II, (B,2,H,W)
        psi: float = 1.0,  # truncation, in evaluation mode
        shift: Tensor | None = None,  # (B,) in [0,1) turns: DUSty v2's augmentation of coordinates, in training
    ) -> GeneratedImages:
        """Images from latents; in training mode running means are updated."""
        if isinstance(self.generator, gan.Generator):
            return self.generator(z, uniform, psi)
        assert self.angles is not None
        return self.generator(z, self.angles, uniform, psi, shift)

    def styles(self, z: Tensor) -> Tensor:
        """Latents (B,Z) -> styles: (B,D), of Vanilla GAN and DUSty v1 the latents themselves."""
        return z if isinstance(self.generator, gan.Generator) else self.generator.mapping_network(z)

    def styles_of_layers(self, z: Tensor) -> Tensor:
        """Latents (B,Z) -> a style for every layer (B,L,D) of DUSty v2, all equal; `styles` of the other two."""
        return self.of_layers(self.styles(z))

    def of_layers(self, w: Tensor) -> Tensor:
        """Styles (B,D) -> W+, the same for every layer (B,L,D), of DUSty v2; as they are of the other two."""
        if isinstance(self.generator, gan.Generator):
            return w
        return w[:, None].repeat(1, self.generator.synthesis_network.num_styles, 1)

    def synthesize(self, w: Tensor, uniform: Tensor, shift: Tensor | None = None) -> GeneratedImages:
        """Images from styles of `styles` or `styles_of_layers`; no running mean of styles is updated."""
        if isinstance(self.generator, gan.Generator):
            return self.generator.synthesize(w, uniform)
        assert self.angles is not None
        return self.generator.synthesize(w, self.angles, uniform, shift)

    def mean_style(self, rng: torch.Generator, count: int = 10_000) -> Tensor:
        """(1,D): the mean of the styles of `count` latents, where an inversion of DUSty v2 starts."""
        z = torch.randn(count, self.latent_channels, generator=rng)
        device = self.generator.w_avg.device
        return self.styles(z.to(device)).mean(0, keepdim=True)
