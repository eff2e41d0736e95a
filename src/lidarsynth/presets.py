"""One function per released model and per row of the paper's tables: name -> Experiment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lidarsynth.experiment import Card, Data, Diffusion, Experiment, Model, Training


def r2dm_a() -> Experiment:
    """R2DM table II, row A: log range, L2, raw angles."""
    return Experiment("r2dm-a", model=Model(coords_encoding="polar_coordinates"))


def r2dm_b() -> Experiment:
    """Row B: L1 loss."""
    return replace(r2dm_a(), name="r2dm-b", diffusion=Diffusion(loss="l1"))


def r2dm_c() -> Experiment:
    """Row C: Huber loss."""
    return replace(r2dm_a(), name="r2dm-c", diffusion=Diffusion(loss="huber"))


def r2dm_d() -> Experiment:
    """Row D: metric range."""
    return replace(r2dm_a(), name="r2dm-d", data=Data(codec="metric"))


def r2dm_e() -> Experiment:
    """Row E: inverse range."""
    return replace(r2dm_a(), name="r2dm-e", data=Data(codec="inverse"))


def r2dm_f() -> Experiment:
    """Row F: no spatial bias."""
    return replace(r2dm_a(), name="r2dm-f", model=Model(coords_encoding=None))


def r2dm_g() -> Experiment:
    """Row G: spherical harmonics."""
    return replace(r2dm_a(), name="r2dm-g", model=Model(coords_encoding="spherical_harmonics"))


def r2dm_h() -> Experiment:
    """Row H, the paper's model: Fourier features. 31,099,650 parameters."""
    return Experiment("r2dm-h")


def r2dm_kitti_raw() -> Experiment:
    """The paper's KITTI-Raw model: scan unfolding at 64x2048, subsampled to 64x512. 31,098,498 parameters."""
    return Experiment("r2dm-kitti-raw", data=Data(projection="unfolding", width=512))


def default() -> Experiment:
    """The shipped model: one small network that generates and completes, on the true beams of the HDL-64E."""
    return Experiment(
        "default",
        data=Data(sensor="hdl-64e-kitti", projection="auto"),
        model=Model(
            network="conditional-unet",
            base_channels=32,
            channel_multipliers=(1, 2, 4, 8),
            num_residual_blocks=(1, 1, 2, 2),
            stem=(2, 4),
        ),
        diffusion=Diffusion(kind="x_0", floor=1.0, mean_weight=False),
        training=Training(
            steps=5_250,
            batch_size=4,
            learning_rate=5e-4,
            warmup=200,
            ema_decay=0.98,  # a short run: average over 500 steps
            ema_start=500,
            generation_share=0.5,
        ),
    )


def kitti() -> Experiment:
    """`default` fine-tuned on real scans (`--from default`), for completion first of all."""
    start = default()
    return replace(
        start,
        name="kitti",
        data=replace(start.data, roll=True, mirror=True),
        training=replace(start.training, steps=12_000, warmup=100, ema_decay=0.99, generation_share=0.25),
        card=Card(
            licence="CC BY-NC-SA 3.0, that of KITTI",
            data="from `default`, on 105 real HDL-64E scans of KITTI (about 75 different views)",
        ),
    )


def tiny() -> Experiment:
    """A model of seconds, for tests."""
    return Experiment(
        "tiny",
        data=Data(sensor="hdl-64e-kitti", projection="auto", height=16, width=64),
        model=Model(
            network="conditional-unet",
            base_channels=8,
            channel_multipliers=(1, 1, 2, 2),
            num_residual_blocks=(1, 1, 1, 1),
            attn_num_heads=2,
        ),
        diffusion=Diffusion(kind="x_0", mean_weight=False),
        training=Training(steps=20, batch_size=4, learning_rate=1e-3, warmup=2, ema_start=5, generation_share=0.5),
    )


PRESETS: dict[str, Callable[[], Experiment]] = {
    "default": default,
    "kitti": kitti,
    "r2dm-a": r2dm_a,
    "r2dm-b": r2dm_b,
    "r2dm-c": r2dm_c,
    "r2dm-d": r2dm_d,
    "r2dm-e": r2dm_e,
    "r2dm-f": r2dm_f,
    "r2dm-g": r2dm_g,
    "r2dm-h": r2dm_h,
    "r2dm-kitti-raw": r2dm_kitti_raw,
    "tiny": tiny,
}


def preset(name: str) -> Experiment:
    """The experiment of a word of PRESETS. Raises ValueError for another word."""
    if name not in PRESETS:
        raise ValueError(f"expected a preset of {', '.join(PRESETS)}, found {name!r}")
    return PRESETS[name]()
