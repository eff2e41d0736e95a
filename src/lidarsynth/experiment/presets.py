"""One function per released model and per row of the paper's tables: name -> Experiment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from lidarsynth.experiment import upsampling_presets
from lidarsynth.experiment.record import (
    Adversarial,
    Card,
    Data,
    Diffusion,
    Experiment,
    Model,
    Score,
    Segmentation,
    Training,
)


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
    data = Data(sensor="hdl-64e-r2dm", projection="unfolding", width=512, columns=2048)
    return Experiment("r2dm-kitti-raw", data=data)


def lidargen() -> Experiment:
    """LiDARGen as published (Zyrianov et al. 2022), with 29,694,082 parameters; sampled in 232 x 5 steps and one."""
    return Experiment(
        "lidargen",
        data=Data(sensor="hdl-64e-lidargen", codec="log-63m"),
        model=Model(network="refinenet", base_channels=128),
        diffusion=Diffusion(schedule="ve", kind="score", clip=False, gamma=None, mean_weight=False),
        training=Training(
            steps=300_001,
            batch_size=24,
            betas=(0.9, 0.999),
            warmup=0,
            decay="constant",
            clip_norm=None,
            ema_decay=0.999,
            ema_every=1,
            ema_start=0,
        ),
        score=Score(),
    )


def lidargen_tiny() -> Experiment:
    """LiDARGen of seconds, for tests: a narrow network, small images, few noise levels."""
    full = lidargen()
    return replace(
        full,
        name="lidargen-tiny",
        data=replace(full.data, sensor="hdl-64e-kitti", projection="auto", height=16, width=64),
        model=replace(full.model, base_channels=8),
        training=replace(full.training, steps=20, batch_size=4, learning_rate=1e-3, ema_decay=0.9),
        score=Score(levels=8),
    )


def vanilla_gan() -> Experiment:
    """Vanilla GAN (Caccia et al.) as trained again for DUSty v2: 36.31 M parameters, discriminator 2.82 M."""
    return Experiment(
        "vanilla-gan",
        data=Data(
            sensor="hdl-64e-dusty",
            projection="unfolding",
            width=512,  # of 2048, columns 4k
            codec="inverse",
            reflectance=False,
        ),
        model=Model(network="vanilla-gan", base_channels=64),
        training=Training(
            steps=781_250,  # 25 M images
            batch_size=32,
            learning_rate=2e-3,
            betas=(0.0, 0.99),
            warmup=0,
            decay="constant",
            clip_norm=None,
        ),
        adversarial=Adversarial(),
    )


def dusty_v1() -> Experiment:
    """DUSty v1 as trained again for DUSty v2: with ray-drop. 36.31 M parameters, discriminator 2.82 M."""
    start = vanilla_gan()
    return replace(start, name="dusty-v1", model=replace(start.model, network="dusty-v1"))


def dusty_v2() -> Experiment:
    """DUSty v2 (Nakashima et al., WACV 2023): renders ray angles. 4.37 M parameters, discriminator 38.45 M."""
    return replace(vanilla_gan(), name="dusty-v2", model=Model(network="dusty-v2", base_channels=32))


def tiny_gan() -> Experiment:
    """DUSty v2 of seconds, for tests; with --set model.network=vanilla-gan or dusty-v1 the others."""
    full = dusty_v2()
    return replace(
        full,
        name="tiny-gan",
        data=replace(full.data, sensor="hdl-64e-kitti", projection="auto", height=32, width=64),
        model=replace(full.model, base_channels=4),
        training=replace(full.training, steps=20, batch_size=4, ema_half_life=20),
        adversarial=Adversarial(
            latent_channels=8, style_channels=8, max_channels=8, r1_every=4, augmentation_images=100, warmup_images=40
        ),
    )


def r2dm_refinenet() -> Experiment:
    """R2DM with LiDARGen's network as its noise predictor: the architecture of LiDARGen in R2DM's diffusion."""
    return Experiment("r2dm-refinenet", model=Model(network="refinenet", base_channels=128))


def kitti_streets() -> Experiment:
    """One small network that generates and completes scans of one sensor: here the true beams of KITTI's HDL-64E."""
    return Experiment(
        "kitti-streets",
        data=Data(sensor="hdl-64e-kitti", projection="auto"),
        model=Model(
            network="conditional-unet",
            base_channels=32,
            channel_multipliers=(1, 2, 4, 8),
            num_residual_blocks=(2, 2, 2, 2),
            stem=(4, 1),  # whole columns: edges need every azimuth step
            candidates=True,
            around=True,
        ),
        diffusion=Diffusion(kind="x_0", floor=1.0, mean_weight=False),
        training=Training(
            steps=10_000,
            batch_size=4,
            learning_rate=1e-3,
            warmup=200,
            ema_decay=0.98,  # a short run: average over 500 steps
            ema_start=500,
            generation_share=0.5,
            upsampling_share=0.4,
        ),
    )


def default() -> Experiment:
    """A coarse layout, then one step that fills it in: one model for any sensor, from `--data virtual`."""
    return Experiment(
        "default",
        data=Data(sensor="hdl-64e-kitti", projection="auto", even=0.5),
        model=Model(
            network="cascade",
            base_channels=64,  # of both stages
            channel_multipliers=(1, 2, 4, 4),
            num_residual_blocks=(2, 2, 2, 2),  # of the coarse stage
            coords_encoding=None,  # both are told each pixel's rays
            classes=20,
            noisiest=10,  # at 8, a scene's openness still shows through
            column_channels=256,
            between_channels=64,
            beam_channels=56,
            inside_channels=12,
            likeliest=True,
            likeliest_blocks=(1, 2, 6, 6),  # wide maps cost time, small ones little
            observer_channels=48,
        ),
        diffusion=Diffusion(schedule="flow", kind="velocity", clip=False, gamma=None, mean_weight=False),
        training=Training(
            steps=20_000,
            batch_size=8,
            learning_rate=2e-3,  # half of it for the coarse stage
            warmup=200,
            ema_decay=0.999,
            ema_start=200,
            ema_every=1,
            generation_share=0.5,  # of crops that learn to be drawn; the others learn the most likely image
        ),
    )


def tuned() -> Experiment:
    """The shipped `default` for scans of one's own: its fill of least error goes on alone."""
    start = default()
    return replace(
        start,
        name="tuned",
        base="default",
        data=replace(start.data, mix=0.7, even=0.0),
        model=replace(start.model, noisiest=8),  # as the shipped one has learned
        training=replace(
            start.training,
            steps=3_000,
            batch_size=4,
            learning_rate=8e-4,
            warmup=100,
            ema_decay=0.996,
            generation_share=0.0,
            upsampling_share=0.4,
        ),
    )


def kitti() -> Experiment:
    """`tuned` on real scans of KITTI's HDL-64E, whose surest classes `default` has named."""
    start = tuned()
    return replace(
        start,
        name="kitti",
        data=replace(start.data, even=0.5),
        model=replace(start.model, observer_channels=64, own_classes=True),
        training=replace(start.training, steps=11_600),
        card=Card(
            licence="CC BY-NC-SA 3.0, that of KITTI",
            data="from `default`, on 105 real HDL-64E scans of KITTI (about 75 different views)",
            sensor="hdl-64e-kitti",
        ),
    )


def rangenet_53() -> Experiment:
    """RangeNet-53 as published (Milioto et al. 2019). 50,377,364 parameters; for labelled scans, as SemanticKITTI's."""
    return Experiment(
        "rangenet-53",
        model=Model(network="rangenet", base_channels=32, dropout=0.01),
        training=Training(steps=250_000, learning_rate=1e-3, warmup=2_000),
        segmentation=Segmentation(layers=53),
    )


def rangenet_21() -> Experiment:
    """RangeNet-21 as published. 24,712,980 parameters."""
    return replace(rangenet_53(), name="rangenet-21", segmentation=Segmentation(layers=21))


def rangenet_street() -> Experiment:
    """The feature network of the protocol street-1, a quarter as wide, for synthetic streets. 1,549,908 parameters."""
    return Experiment(
        "rangenet-street",
        data=Data(sensor="hdl-64e-kitti", projection="auto", roll=True, mirror=True),
        model=Model(network="rangenet", base_channels=8),
        training=Training(steps=3_500, batch_size=4, learning_rate=3e-3, warmup=200, ema_decay=0.98, ema_start=500),
        segmentation=Segmentation(layers=21, columns=512, drop=0.1),
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
    "dusty-v1": dusty_v1,
    "dusty-v2": dusty_v2,
    "kitti": kitti,
    "kitti-streets": kitti_streets,
    "bicubic": upsampling_presets.bicubic,
    "bilinear": upsampling_presets.bilinear,
    "iln": upsampling_presets.iln,
    "iln-0d": upsampling_presets.iln_0d,
    "iln-2d": upsampling_presets.iln_2d,
    "iln-tiny": upsampling_presets.iln_tiny,
    "lidar-sr": upsampling_presets.lidar_sr,
    "lidar-sr-keras": upsampling_presets.lidar_sr_keras,
    "lidar-sr-tiny": upsampling_presets.lidar_sr_tiny,
    "lidargen": lidargen,
    "lidargen-tiny": lidargen_tiny,
    "liif": upsampling_presets.liif,
    "nearest": upsampling_presets.nearest,
    "r2dm-a": r2dm_a,
    "r2dm-b": r2dm_b,
    "r2dm-c": r2dm_c,
    "r2dm-d": r2dm_d,
    "r2dm-e": r2dm_e,
    "r2dm-f": r2dm_f,
    "r2dm-g": r2dm_g,
    "r2dm-h": r2dm_h,
    "r2dm-kitti-raw": r2dm_kitti_raw,
    "r2dm-refinenet": r2dm_refinenet,
    "rangenet-21": rangenet_21,
    "rangenet-53": rangenet_53,
    "rangenet-street": rangenet_street,
    "tiny": tiny,
    "tiny-gan": tiny_gan,
    "tuned": tuned,
    "vanilla-gan": vanilla_gan,
}


def preset(name: str) -> Experiment:
    """The experiment of a word of PRESETS. Raises ValueError for another word."""
    if name not in PRESETS:
        raise ValueError(f"expected a preset of {', '.join(PRESETS)}, found {name!r}")
    return PRESETS[name]()
