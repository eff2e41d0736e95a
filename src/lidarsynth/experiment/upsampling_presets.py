"""Presets of networks that put beams between known ones, and of interpolation: name -> Experiment, as in `presets`."""

from __future__ import annotations

from dataclasses import replace

from lidarsynth.experiment.record import Data, Experiment, Model, Training, Upsampling

WITHOUT_WEIGHTS = ("nearest", "bilinear", "bicubic")  # presets that are models as they are


def lidar_sr() -> Experiment:
    """LiDAR-SR (Shan et al. 2020) as ILN's repository has it. 34,600,001 parameters.

    Papers count epochs of their own streets of CARLA; the number of steps here, and of ILN, is R2DM's.
    """
    return Experiment(
        "lidar-sr",
        data=Data(sensor="hdl-64e-kitti", projection="auto", codec="metric", reflectance=False),
        model=Model(network="lidar-sr", dropout=0.25),
        training=Training(
            batch_size=16, betas=(0.9, 0.999), warmup=0, decay="constant", clip_norm=None, ema_decay=0.0, ema_every=1
        ),
        upsampling=Upsampling(),
    )


def lidar_sr_keras() -> Experiment:
    """LiDAR-SR's own Keras program: noise on ranges, no return and what is nearer than 2 m as 0, a rate that falls with
    1 / (1 + 1e-5 step). Its images begin with the lowest beam, and of these rows 0, 4, 8, ... are known: the last of
    each four from the top."""
    start = lidar_sr()
    training = replace(start.training, steps=100_000, batch_size=32, decay="inverse")
    upsampling = Upsampling(first=3, noise=0.03, keras=True, min_range=2.0)
    return replace(start, name="lidar-sr-keras", training=training, upsampling=upsampling)


def lidar_sr_tiny() -> Experiment:
    """LiDAR-SR of seconds, for tests."""
    start = lidar_sr()
    return replace(
        start,
        name="lidar-sr-tiny",
        data=replace(start.data, height=16, width=64),
        model=replace(start.model, base_channels=4),
        training=replace(start.training, steps=20, batch_size=4, learning_rate=3e-3),
        upsampling=Upsampling(passes=8),
    )


def iln() -> Experiment:
    """ILN (Kwon et al. 2022) with one layer of attention, as released (iln_1d). 1,244,673 parameters."""
    start = lidar_sr()
    return replace(
        start,
        name="iln",
        model=Model(network="iln", num_residual_blocks=(16,), dropout=0.1),
        training=replace(start.training, decay="halving"),
    )


def iln_0d() -> Experiment:
    """ILN without attention. 1,219,649 parameters."""
    return replace(iln(), name="iln-0d", upsampling=Upsampling(depth=0))


def iln_2d() -> Experiment:
    """ILN with two layers of attention. 1,269,697 parameters."""
    return replace(iln(), name="iln-2d", upsampling=Upsampling(depth=2))


def liif() -> Experiment:
    """LIIF (Chen et al. 2021) as ILN's repository compares with it. 1,434,049 parameters."""
    return replace(iln(), name="liif", model=Model(network="liif", num_residual_blocks=(16,)))


def iln_tiny() -> Experiment:
    """ILN of seconds, for tests."""
    start, small = iln(), lidar_sr_tiny()
    return replace(
        start,
        name="iln-tiny",
        data=small.data,
        model=replace(start.model, base_channels=8, attn_num_heads=2, num_residual_blocks=(2,)),
        training=replace(small.training, decay="halving"),
        upsampling=Upsampling(queries=512),
    )


def _interpolation(word: str) -> Experiment:
    return Experiment(word, data=Data(sensor="hdl-64e-kitti", projection="auto", codec="metric"), model=Model(word))


def nearest() -> Experiment:
    """Nearest-neighbour interpolation."""
    return _interpolation("nearest")


def bilinear() -> Experiment:
    """Bilinear interpolation."""
    return _interpolation("bilinear")


def bicubic() -> Experiment:
    """Bicubic interpolation, a = -0.75."""
    return _interpolation("bicubic")
