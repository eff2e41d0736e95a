"""The denoiser: a network, a noise schedule and the meaning of the network's output, as one map (x_t, t) -> x_0_hat.

Every kind of prediction is a mixture p x_0 + q eps. The table KINDS holds p and q; the training target, the way back to
x_0_hat and the min-SNR weight all follow from it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor
from torch.nn import functional

from lidarsynth.diffusion.schedule import Schedule

Network = Callable[..., Tensor]  # (x_t (B, C, H, W), log_snr (B,), *condition) -> prediction (B, C, H, W)
Factor = Tensor | float

KINDS: dict[str, Callable[[Tensor, Tensor], tuple[Factor, Factor]]] = {
    "eps": lambda alpha, sigma: (0.0, 1.0),  # the noise (Ho et al. 2020; R2DM)
    "x_0": lambda alpha, sigma: (1.0, 0.0),  # the clean data
    "v": lambda alpha, sigma: (-sigma, alpha),  # (Salimans & Ho 2022)
    "velocity": lambda alpha, sigma: (-1.0, 1.0),  # dx_t/dt of rectified flow (Liu et al. 2022)
    "score": lambda alpha, sigma: (0.0, -1 / sigma),  # grad log p(x_t) (Song & Ermon 2019)
}

LOSSES: dict[str, Callable[..., Tensor]] = {
    "l1": functional.l1_loss,
    "l2": functional.mse_loss,
    "huber": functional.smooth_l1_loss,  # beta = 1
}


def target(kind: str, x_0: Tensor, eps: Tensor, alpha: Tensor, sigma: Tensor) -> Tensor:
    """What a network of this kind is trained to say about x_t = alpha x_0 + sigma eps; the shape of x_0."""
    p, q = KINDS[kind](alpha, sigma)
    return p * x_0 + q * eps


def to_x_0(kind: str, x_t: Tensor, prediction: Tensor, alpha: Tensor, sigma: Tensor) -> Tensor:
    """The clean data that a prediction implies: p x_0 + q eps = prediction, where eps = (x_t - alpha x_0) / sigma.

    For `eps` this divides by alpha, which is 5.5e-4 at t = 1 of the cosine schedule: errors grow 1800-fold there.
    """
    p, q = KINDS[kind](alpha, sigma)
    return (q * x_t - sigma * prediction) / (q * alpha - p * sigma)


def min_snr_weight(kind: str, log_snr: Tensor, alpha: Tensor, sigma: Tensor, gamma: float = 5.0) -> Tensor:
    """Weight of a squared error of `kind` that counts errors of x_0 by min(snr, gamma) (Hang et al. 2023).

    eps: min(snr, gamma) / snr, x_0: min(snr, gamma), v: min(snr, gamma) / (snr + 1) when variance-preserving.
    gamma = inf is R2DM's "off": 1, snr, snr / (snr + 1), so every kind is weighted as plain eps prediction is.
    """
    p, q = KINDS[kind](alpha, sigma)
    return log_snr.exp().clamp(max=gamma) * (sigma / (q * alpha - p * sigma)) ** 2


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Per-sample mean (B,) of values (B, ...) where mask, same shape or broadcastable, is 1; everywhere without one."""
    if mask is None:
        return values.flatten(1).mean(1)
    mask = mask.to(values.dtype).expand_as(values)
    return (values * mask).flatten(1).sum(1) / (mask.flatten(1).sum(1) + 1e-8)


@dataclass(frozen=True)
class Denoiser:
    """A network with its schedule: `denoiser(x_t, t) -> x_0_hat`.

    Raises ValueError for an unknown kind.

    Example:
        >>> denoiser = Denoiser(network, cosine(), kind="eps")
        >>> x_0_hat = denoiser(x_t, t)                            # (B, C, H, W) in [-1, 1]
        >>> loss = denoiser.loss(x_0, t, torch.randn_like(x_0)).mean()
    """

    network: Network  # receives (x_t, log_snr (B,), *condition)
    schedule: Schedule
    kind: str = "eps"  # what the network says, a key of KINDS
    clip: bool = True  # clamp x_0_hat to [-1, 1], the range of the data
    condition: tuple[Tensor, ...] = ()  # further arguments of the network, see `given`

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind must be one of {', '.join(KINDS)}, got {self.kind!r}")

    def __call__(self, x_t: Tensor, t: Tensor) -> Tensor:
        """The estimate of the clean data, (B, C, H, W), from x_t (B, C, H, W) at times t (B,) in [0, 1]."""
        log_snr, alpha, sigma = self.schedule.at(t, x_t)
        x_0_hat = to_x_0(self.kind, x_t, self.predict(x_t, log_snr.flatten()), alpha, sigma)
        return x_0_hat.clamp(-1, 1) if self.clip else x_0_hat

    def predict(self, x_t: Tensor, log_snr: Tensor) -> Tensor:
        """The network's raw output in the dtype of x_t, so that only the network itself runs in half precision."""
        return self.network(x_t, log_snr, *self.condition).to(x_t.dtype)

    def given(self, known: Tensor, mask: Tensor) -> "Denoiser":
        """The same denoiser, told the known pixels: its network is called with (x_t, log_snr, known, mask).

        known (B, C, H, W) in [-1, 1]; mask (B, C, H, W), 1 = known. For networks with these two further arguments.
        """
        if known.shape != mask.shape:
            raise ValueError(f"known and mask must have one shape, got {tuple(known.shape)} and {tuple(mask.shape)}")
        return replace(self, condition=(known, mask))

    def loss(
        self,
        x_0: Tensor,  # (B, C, H, W) clean data in [-1, 1]
        t: Tensor,  # (B,) times in [0, 1]
        eps: Tensor,  # (B, C, H, W) unit Gaussian noise
        mask: Tensor | None = None,  # broadcastable to x_0, 1 = counts; None = every pixel counts
        loss: str = "l2",  # a key of LOSSES
        gamma: float | None = 5.0,  # min-SNR; inf = R2DM's unweighted option; None = no weight at all
        floor: float = 0.0,  # least weight of a sample; x_0 prediction has weights of almost 0 where noise is high
    ) -> Tensor:
        """Weighted loss per sample (B,); minimise its mean."""
        if loss not in LOSSES:
            raise ValueError(f"loss must be one of {', '.join(LOSSES)}, got {loss!r}")
        log_snr, alpha, sigma = self.schedule.at(t, x_0)
        x_t = alpha * x_0 + sigma * eps
        prediction = self.predict(x_t, log_snr.flatten())
        error = LOSSES[loss](prediction, target(self.kind, x_0, eps, alpha, sigma), reduction="none")
        per_sample = masked_mean(error, mask)
        if gamma is None:
            return per_sample
        return per_sample * min_snr_weight(self.kind, log_snr, alpha, sigma, gamma).flatten().clamp(min=floor)
