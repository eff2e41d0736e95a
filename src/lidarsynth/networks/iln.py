"""ILN (Kwon et al. 2022): ranges at any direction, as a weighted mean of measured neighbours; and LIIF beside it.

Images and queries are those of ILN's repository: the lowest beam in row 0, ranges in [-1,1] (2 r / norm_r - 1, no
return = 1), directions (vertical, horizontal) in [-1,1], where pixel i of n has its centre at -1 + (2i + 1) / n.
Neighbours do not wrap around, so that queries beyond the centres of border pixels see those alone.
"""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.networks.tensors import iln_arguments, iln_tensors, load_weights

LIIF_ARGUMENTS: dict[str, int | bool] = {"local_ensemble": True, "feat_unfold": False, "cell_decode": False}
SHIFTS = ((-1, -1), (-1, 1), (1, -1), (1, 1))  # of the four neighbours: (vertical, horizontal), in half pixels


class RingConv(nn.Module):
    """3x3 convolution that keeps the size (B,C,H,W): rows repeat beyond the ends, columns are a ring."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, 3)

    def forward(self, x: Tensor) -> Tensor:
        x = x.view_as(x)  # adds the rows' gradients up before those of what else x goes into, as F.pad does
        x = torch.cat([x[:, :, :1], x, x[:, :, -1:]], 2)  # not F.pad, whose gradient torch 2.13 compiles wrongly
        return self.conv(F.pad(x, (1, 1, 0, 0), mode="circular"))


class EDSRBlock(nn.Module):
    """x + conv(ReLU(conv(x))), without normalisation (Lim et al. 2017)."""

    def __init__(self, channels: int):
        super().__init__()
        self.body = nn.Sequential(RingConv(channels, channels), nn.ReLU(), RingConv(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.body(x)


class Encoder(nn.Module):
    """EDSR at full size: (B,1,H,W) -> (B,C,H,W)."""

    def __init__(self, channels: int = 64, blocks: int = 16):
        super().__init__()
        self.head = nn.Sequential(RingConv(1, channels))
        self.body = nn.Sequential(*(EDSRBlock(channels) for _ in range(blocks)), RingConv(channels, channels))

    def forward(self, x: Tensor) -> Tensor:
        x = self.head(x)
        return x + self.body(x)


class Attention(nn.Module):
    """Self-attention among the neighbours: (...,4,C) -> (...,4,C)."""

    def __init__(self, channels: int, heads: int, dropout: float):
        super().__init__()
        self.heads = heads
        self.to_qkv = nn.Linear(channels, 3 * channels, bias=False)
        self.to_out = nn.Sequential(nn.Linear(channels, channels), nn.Dropout(dropout))

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (part.unflatten(-1, (self.heads, -1)).transpose(-2, -3) for part in self.to_qkv(x).chunk(3, dim=-1))
        attention = (q @ k.transpose(-1, -2) * q.shape[-1] ** -0.5).softmax(-1)
        return self.to_out((attention @ v).transpose(-2, -3).flatten(-2))


class FeedForward(nn.Module):
    """Two linear layers around a GELU: (...,C) -> (...,C)."""

    def __init__(self, channels: int, dropout: float):
        super().__init__()
        first, second = nn.Linear(channels, channels), nn.Linear(channels, channels)
        self.net = nn.Sequential(first, nn.GELU(), nn.Dropout(dropout), second, nn.Dropout(dropout))

    def forward(self, x: Tensor) -> Tensor:
        return self.net(x)


class PreNorm(nn.Module):
    """x + fn(LayerNorm(x))."""

    def __init__(self, channels: int, fn: nn.Module):
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.fn = fn

    def forward(self, x: Tensor) -> Tensor:
        return x + self.fn(self.norm(x))


class Transformer(nn.Module):
    """`depth` layers of attention and feed-forward, each pre-normalised: (...,4,C) -> (...,4,C)."""

    def __init__(self, channels: int, depth: int, heads: int, dropout: float):
        super().__init__()
        self.layers = nn.ModuleList(
            nn.Sequential(
                PreNorm(channels, Attention(channels, heads, dropout)),
                PreNorm(channels, FeedForward(channels, dropout)),
            )
            for _ in range(depth)
        )

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            x = layer(x)
        return x


class NeighbourWeights(nn.Module):
    """Features (...,4,C) and relative places (...,4,2) of four neighbours -> weights (...,4), which add up to 1."""

    def __init__(self, channels: int, depth: int, heads: int, dropout: float = 0.1):
        super().__init__()
        self.pos_embedding = nn.Linear(2, channels)
        self.transformer = Transformer(channels, depth, heads, dropout)
        self.mlp_head = nn.Sequential(nn.LayerNorm(channels), nn.Linear(channels, 1))

    def forward(self, features: Tensor, places: Tensor) -> Tensor:
        tokens = self.transformer(features + self.pos_embedding(places))
        return self.mlp_head(tokens).squeeze(-1).softmax(-1)


class ILN(nn.Module):
    """ILN; parameter names are those of the checkpoints of its repository.

    `forward(low (B,1,H,W), queries (B,Q,2)) -> (B,Q)`: ranges in [-1,1], never outside those of the four neighbours.
    `encode` and `decode` are its halves, to ask for many queries in pieces. `depth` 0, 1 and 2 are the published
    iln_0d, iln_1d and iln_2d with 1,219,649, 1,244,673 and 1,269,697 parameters.
    """

    def __init__(self, depth: int = 1, heads: int = 8, channels: int = 64, blocks: int = 16, dropout: float = 0.1):
        super().__init__()
        if channels % heads:
            raise ValueError(f"heads must divide {channels} channels, got {heads}")
        self.heads = heads
        self.encoder = Encoder(channels, blocks)
        self.attention = NeighbourWeights(channels, depth, heads, dropout)

    def forward(self, low: Tensor, queries: Tensor) -> Tensor:
        return self.decode(low, self.encode(low), queries)

    def encode(self, low: Tensor) -> Tensor:
        """Features (B,C,H,W) of ranges (B,1,H,W), float32 under autocast too: places among them need it."""
        return self.encoder(low).float()

    def decode(self, low: Tensor, features: Tensor, queries: Tensor) -> Tensor:
        """Ranges (B,Q) at queries (B,Q,2), from ranges (B,1,H,W) and their features."""
        near, places, ranges = neighbours(features, low, queries)
        return (self.attention(near, places) * ranges).sum(-1)


class LIIF(nn.Module):
    """LIIF (Chen et al. 2021) as ILN's repository compares with it, `liif_lidar`; the interface of ILN.

    A perceptron says a range from each of the four neighbours, and these are weighted by the opposite areas. The result
    is not bounded. Cell decoding, off in the published configuration, is left out.
    """

    def __init__(
        self,
        channels: int = 64,
        hidden: int = 256,
        blocks: int = 16,
        unfold: bool = False,  # whether the perceptron is told the features of 3x3 pixels, zeros beyond the borders
        ensemble: bool = True,  # of the four neighbours; without, the pixel that a query is in says the range alone
    ):
        super().__init__()
        self.unfold, self.ensemble = unfold, ensemble
        self.encoder = Encoder(channels, blocks)
        told = channels * (9 if unfold else 1) + 2
        self.imnet = Perceptron((told, hidden, hidden, hidden, hidden, 1))

    def forward(self, low: Tensor, queries: Tensor) -> Tensor:
        return self.decode(low, self.encode(low), queries)

    def encode(self, low: Tensor) -> Tensor:
        """Features (B,C,H,W) of ranges (B,1,H,W), float32 under autocast too: places among them need it.

        Unfolded they are (B,9C,H,W): of each channel the nine pixels, row by row.
        """
        features = self.encoder(low).float()
        return F.unfold(features, 3, padding=1).unflatten(-1, features.shape[2:]) if self.unfold else features

    def decode(self, low: Tensor, features: Tensor, queries: Tensor) -> Tensor:
        """Ranges (B,Q) at queries (B,Q,2), from ranges (B,1,H,W) and their features."""
        near, places, _ = neighbours(features, low, queries, self.ensemble)
        said = self.imnet(torch.cat([near, places], dim=-1)).squeeze(-1)
        areas = (places[..., 0] * places[..., 1]).abs() + 1e-9
        return (said * areas.flip(-1) / areas.sum(-1, keepdim=True)).sum(-1)


class Perceptron(nn.Module):
    """Linear layers of these widths with ReLU in between: (...,first) -> (...,last)."""

    def __init__(self, widths: tuple[int, ...]):
        super().__init__()
        layers: list[nn.Module] = []
        for a, b in pairwise(widths):
            layers += [nn.Linear(a, b), nn.ReLU()]
        self.layers = nn.Sequential(*layers[:-1])

    def forward(self, x: Tensor) -> Tensor:
        return self.layers(x)


def neighbours(features: Tensor, low: Tensor, queries: Tensor, ensemble: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    """Features (B,Q,4,C), relative places (B,Q,4,2) in half pixels and ranges (B,Q,4) of the pixels around queries.

    features (B,C,H,W), low (B,1,H,W), queries (B,Q,2); the neighbours are in the order of SHIFTS. Without `ensemble`
    there is one for each query, not four: the pixel that it is in.
    On a pixel's centre only the 1e-6 decides which they are: this keeps the published order of float32 operations.
    Raises ValueError if the shapes do not fit.
    """
    batch, _, height, width = low.shape
    if low.shape[1] != 1 or queries.ndim != 3 or len(queries) != batch or queries.shape[2] != 2:
        shapes = f"{tuple(low.shape)} and {tuple(queries.shape)}"
        raise ValueError(f"low and queries must be (B, 1, H, W) and (B, Q, 2), got {shapes}")
    centres = pixel_centres(height, width, low.device).expand(batch, -1, -1, -1)
    image = torch.cat([features, centres.to(features.dtype), low.to(features.dtype)], dim=1)
    found = []
    shifts = [(v / height + 1e-6, h / width + 1e-6) for v, h in SHIFTS] if ensemble else [(0.0, 0.0)]
    for shift in shifts:
        grid = (queries + queries.new_tensor(shift)).clamp(-1 + 1e-6, 1 - 1e-6).flip(-1)[:, None]
        found.append(F.grid_sample(image, grid.to(image.dtype), mode="nearest", align_corners=False)[:, :, 0])
    near, centre, ranges = torch.stack(found, dim=2).permute(0, 3, 2, 1).split([features.shape[1], 2, 1], dim=-1)
    return near, (queries[:, :, None] - centre) * queries.new_tensor([height, width]), ranges.squeeze(-1)


def pixel_centres(height: int, width: int, device: torch.device | None = None) -> Tensor:
    """(2,H,W): vertical, then horizontal place of each pixel's centre in [-1,1]."""
    vertical, horizontal = (
        -1 + 1 / size + 2 / size * torch.arange(size, device=device).float() for size in (height, width)
    )
    return torch.stack(torch.meshgrid(vertical, horizontal, indexing="ij"))


def angle_queries(elevation: Tensor, azimuth: Tensor, size: tuple[int, int], min_v: float, max_v: float) -> Tensor:
    """Queries (h w, 2), row by row, for directions given by elevations (h,) and azimuths (w,), in radians.

    size          H, W of the image that is asked
    min_v, max_v  elevations of its first and its last row, radians; its columns begin at azimuth -pi and ascend

    Equal to the published program's to 2.4e-7. That matters nowhere in ILN; LIIF's answer in line with the centres of
    border pixels is a ratio of such roundings, in the published program too.
    """
    height, width = size
    step = (max_v - min_v) / (height - 1)
    v = 2 * (elevation - (min_v - step / 2)) / (max_v - min_v + step) - 1
    turned = azimuth + math.pi / width
    turned = torch.where(turned >= math.pi, turned - 2 * math.pi, turned)
    h = 2 * (turned + math.pi) / (2 * math.pi) - 1
    return torch.stack(torch.meshgrid(v, h, indexing="ij"), dim=-1).flatten(0, 1)


def from_official(checkpoint: object, model: str = "iln") -> ILN | LIIF:
    """The network, in evaluation mode, of a checkpoint of ILN's repository; model "iln" or "liif_lidar".

    Its arguments are those of the checkpoint, `d` layers of `h` heads; where it tells none, as published. The number of
    layers is also read from the tensors. Raises ValueError if something does not fit, or a LIIF decodes cells.
    """
    if model not in ("iln", "liif_lidar"):
        raise ValueError(f'model must be "iln" or "liif_lidar", got {model!r}')
    weights = iln_tensors(checkpoint, model)
    assert isinstance(checkpoint, dict)
    if model == "liif_lidar":
        found = iln_arguments(checkpoint, LIIF_ARGUMENTS)
        if found["cell_decode"]:
            raise ValueError(f"expected a LIIF without cell_decode, as published, found {found}")
        network: ILN | LIIF = LIIF(unfold=bool(found["feat_unfold"]), ensemble=bool(found["local_ensemble"]))
    else:
        depth = sum(key.startswith("attention.transformer") and key.endswith(".to_qkv.weight") for key in weights)
        found = iln_arguments(checkpoint, {"d": depth, "h": 8})
        if found["d"] != depth:
            raise ValueError(f"expected tensors of d = {found['d']} layers, as model.args says, found {depth}")
        network = ILN(depth, heads=found["h"])
    load_weights(network, weights)
    return network.eval()
