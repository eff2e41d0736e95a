"""The coarse stage of generation: a few beams and columns of any sensor, where a street's layout is decided."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from lidarsynth.diffusion.schedule import flow
from lidarsynth.lidar.sensor import Sensor
from lidarsynth.networks.efficient_unet import EfficientUNet
from lidarsynth.networks.fill_unet import ring
from lidarsynth.networks.rays import decode_range, encode_range, ground_range, level_sines, mounts

ROWS, COLUMNS = 16, 128
RAY_CHANNELS = 8
LOWEST, BINS = -32, 61  # degrees of the standard's first bin, and how many of one degree there are
STANDARD_MOUNT = 1.73  # metres
BOUND = 8.0  # of log_snr: with less noise the network has hardly been trained


def grid_rows(height: int, first: float = 0.5) -> np.ndarray:
    """Which of `height` >= 16 beams the coarse stage sees: 16, evenly, from the share `first` of a step on."""
    return np.floor((np.arange(ROWS) + first) * height / ROWS).astype(int)


def grid_columns(width: int, first: float = 0.5, count: int = COLUMNS) -> np.ndarray:
    """Which of `width` columns it sees: `count`, evenly."""
    return np.floor((np.arange(count) + first) * width / count).astype(int)


def grid_rays(sensor: Sensor, blocked: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> tuple[Tensor, Tensor]:
    """What the network is told of the rays, (8, R, C), and their standing elevations (R, C) in radians.

    Elevation, ground, steps to the beams above and below, azimuth, blocked, and the sensor's limit. The standing
    elevation is that at which a sensor 1.73 m up sees the same spot of flat ground.
    """
    elevation = np.radians(np.asarray(sensor.elevations))[rows]
    azimuth = sensor.ray_angles()[1, 0, columns].astype(np.float64)
    mount = mounts(sensor)[rows][:, None]
    sine = np.clip(level_sines(sensor, elevation, azimuth), -1, 1)
    step = np.degrees(np.abs(np.diff(elevation)))
    up, down = (np.log2(s / 1.6 + 0.1)[:, None] / 2 for s in (np.append(0, step), np.append(step, 0)))
    ground = torch.from_numpy(ground_range(sine, mount))
    limit = math.log2(min(sensor.max_range, 250) + 1) / 4 - 1
    parts = (3 * elevation[:, None], 2 * encode_range(ground).numpy(), up, down, np.sin(azimuth)[None],
             np.cos(azimuth)[None], blocked[np.ix_(rows, columns)], limit)  # fmt: skip
    told = np.stack([np.broadcast_to(part, (len(rows), len(columns))) for part in parts]).astype(np.float32)
    standing = np.arcsin(np.clip(sine * STANDARD_MOUNT / mount, -1, 1)).astype(np.float32)
    return torch.from_numpy(told), torch.from_numpy(standing)


class CoarseUNet(nn.Module):
    """`forward(x_t (B, 3, 16, 128), log_snr (B,), rays (B, 8, 16, 128)) -> velocity (B, 3, 16, 128)`.

    Channels of x_0: range code and reflectance, each standardised by its mean and spread at the ray's standing
    elevation (buffer `standard`), and +1 where the ray returned, -1 where not; empty pixels hold their left
    neighbour's values. Else unit noise would drown the ground, whose code spreads by 0.03 near the car and by 0.27 at
    the horizon.

    noisiest  -log_snr of the noise that grids are drawn from. At 8 what many pixels have in common, how open a scene
              is, still shows through; pure noise has none of it, and scenes drawn from it would be too much alike
    """

    standard: Tensor

    def __init__(
        self,
        base_channels: int = 64,
        multipliers: tuple[int, ...] = (1, 2, 4, 4),
        blocks: int = 2,
        noisiest: float = BOUND,
    ):
        super().__init__()
        self.schedule = flow(BOUND, noisiest)
        self.unet = EfficientUNet(
            3 + RAY_CHANNELS,
            3,
            (ROWS, COLUMNS),
            base_channels,
            channel_multipliers=multipliers,
            num_residual_blocks=(blocks,) * 4,
            coords_encoding=None,
            stem=(2, 2),
        )
        self.detail = Detail()
        self.register_buffer("standard", torch.stack([torch.zeros(2, BINS), torch.ones(2, BINS)]))

    def forward(self, x_t: Tensor, log_snr: Tensor, rays: Tensor) -> Tensor:
        x = torch.cat([x_t, rays], 1).contiguous(memory_format=torch.channels_last)
        return self.detail(x_t, rays, self.unet(x, log_snr), log_snr)

    def standards(self, standing: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and spread (B, 2, H, W) of range code and of 2 reflectance - 1, at standing elevations (B, H, W)."""
        place = (torch.rad2deg(standing) - LOWEST).clamp(0, BINS - 1.001)
        low = place.long()
        share = (place - low)[:, None]
        mean, spread = (
            table[:, low].transpose(0, 1) * (1 - share) + table[:, low + 1].transpose(0, 1) * share
            for table in self.standard
        )
        return mean, spread

    def encode(self, metres: Tensor, reflectance: Tensor, standing: Tensor, dimness: Tensor | float = 0.0) -> Tensor:
        """x_0 (B, 3, H, W) of metres (B, H, W), 0 where nothing returned, and reflectance (B, H, W) in [0, 1].

        dimness  (H, 1), how much less than the mean beam a beam reads: its reflectance stands in x_0 as if it did not
        """
        mean, spread = self.standards(standing)
        returned = metres > 0
        values = (torch.stack([encode_range(metres), 2 * (reflectance + dimness) - 1], 1) - mean) / spread
        return torch.cat([left_filled(values, returned), 2 * returned[:, None].float() - 1], 1)

    def decode(self, x_0: Tensor, standing: Tensor, dimness: Tensor | float = 0.0) -> tuple[Tensor, Tensor]:
        """Metres, 0 where nothing returned, and reflectance, each (B, H, W), of x_0 (B, 3, H, W)."""
        mean, spread = self.standards(standing)
        code, reflectance = (x_0[:, :2] * spread + mean).unbind(1)
        returned = x_0[:, 2] > 0
        return decode_range(code) * returned, ((reflectance + 1) / 2 - dimness).clamp(0, 1) * returned


class Detail(nn.Module):
    """Corrects a velocity (B, 3, H, W) pixel by pixel, where the U-Net sees patches; of no effect before training.

    Told x_t, the rays, the velocity and the x_0 that it means: three convolutions on a ring, modulated by the noise.
    """

    def __init__(self, channels: int = 32):
        super().__init__()
        modulation = nn.Linear(64, 2 * channels + 3)
        self.noise = nn.Sequential(nn.Linear(3, 64), nn.SiLU(), modulation)
        self.first = nn.Conv2d(9 + RAY_CHANNELS, channels, 3, padding=(1, 0))
        self.second = nn.Conv2d(channels, channels, 3, padding=(1, 0))
        self.last = nn.Conv2d(channels, 3, 3, padding=(1, 0))
        for layer in (modulation, self.last):
            nn.init.zeros_(layer.weight)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)

    def forward(self, x_t: Tensor, rays: Tensor, velocity: Tensor, log_snr: Tensor) -> Tensor:
        t = torch.sigmoid(-log_snr / 2)
        x_0 = x_t - t[:, None, None, None] * velocity
        scale, shift, gate = self.noise(torch.stack([t, log_snr / 8, t * (1 - t)], 1))[..., None, None].split(
            [self.second.in_channels, self.second.in_channels, 3], 1
        )
        h = torch.cat([x_t, velocity, x_0, rays], 1).contiguous(memory_format=torch.channels_last)
        h = F.silu(self.first(ring(h, 1)) * (1 + scale) + shift)
        h = h + F.silu(self.second(ring(h, 1)))
        return velocity + self.last(ring(h, 1)) + gate * x_0


def left_filled(values: Tensor, returned: Tensor) -> Tensor:
    """(B, C, H, W) with the values of the nearest return to the left, around the turn, where not `returned` (B, H, W).

    0 in rows without a return.
    """
    width = returned.shape[-1]
    place = torch.where(returned, torch.arange(width, device=returned.device), -1).cummax(-1).values
    place = torch.where(place < 0, place[..., -1:], place)
    source = place.clamp(min=0)[:, None].expand_as(values)
    return values.gather(3, source) * (place >= 0)[:, None]
