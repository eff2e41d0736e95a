"""RangeNet's published weights: official archives and folders, and LiDAR-Diffusion's without remission."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from io import BytesIO
from pathlib import Path
from typing import Any

from lidarsynth.networks.archive import read_yaml, weight_files
from lidarsynth.networks.rangenet import MEANS, STDS, RangeNet
from lidarsynth.networks.tensors import Undrawn, load_weights, read_state

# File of an archive -> the most bytes it may have; RangeNet-53's encoder has 163 MB.
FILES: dict[str, int] = {
    "backbone": 1 << 29,
    "segmentation_decoder": 1 << 29,
    "segmentation_head": 1 << 26,
    "arch_cfg.yaml": 1 << 20,
}
LIDM_FILES = {**FILES, "config.yaml": 1 << 20}  # LiDM's own folder calls it so, and needs no head


def read_rangenet(path: str | Path) -> RangeNet:
    """The network of an official archive `<name>.tar.gz`, or of a folder with its files, in evaluation mode.

    Nothing is written to disk: the files are read in memory, weights with `weights_only`. Raises ValueError when the
    archive is damaged, lacks a file, holds links or paths that lead outside, or another network; ImportError without
    pyyaml.
    """
    path = Path(path)
    files = weight_files(path, FILES, FILES, "RangeNet")
    layers, means, stds = _fields(files["arch_cfg.yaml"], f"{path}: arch_cfg.yaml", remission=True)
    return _filled(path, files, "arch_cfg.yaml", layers, means, stds)


def read_lidm_rangenet(path: str | Path) -> RangeNet:
    """LiDAR-Diffusion's RangeNet of four channels: its folder with `config.yaml`, or R2Flow's `rangenet21_lidm.tar.gz`.

    Raises as `read_rangenet`. A folder that tells no means and stds gets SemanticKITTI's.
    """
    path = Path(path)
    files = weight_files(path, LIDM_FILES, ("backbone", "segmentation_decoder"), "RangeNet")
    config = next((name for name in ("arch_cfg.yaml", "config.yaml") if name in files), None)
    if config is None:
        raise ValueError(f"{path}: expected arch_cfg.yaml or config.yaml, found neither")
    layers, means, stds = _fields(files[config], f"{path}: {config}", remission=False)
    return _filled(path, files, config, layers, means[:4], stds[:4])


def _filled(
    path: Path, files: Mapping[str, bytes], config: str, layers: int, means: Sequence[float], stds: Sequence[float]
) -> RangeNet:
    try:
        with Undrawn() if "segmentation_head" in files else nullcontext():
            network = RangeNet(layers, means=means, stds=stds)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {config}: {error}") from None
    parts = {"backbone": network.backbone, "segmentation_decoder": network.decoder, "segmentation_head": network.head}
    for name, module in parts.items():
        if name in files:
            load_weights(module, read_state(BytesIO(files[name]), f"{path}: {name}"), f"{path}: {name}", counters=True)
    return network.eval()


def _fields(text: bytes, where: str, remission: bool) -> tuple[int, list[float], list[float]]:
    """Layers, means and stds of a network that we can build, fields as in the RangeNet repository."""
    config = read_yaml(text, where)
    try:
        backbone = config["backbone"]
        found = [backbone["OS"], *(backbone["input_depth"][k] for k in ("range", "xyz", "remission"))]
        layers, numbers = backbone["extra"]["layers"], _numbers(config, needed=remission)
    except (KeyError, TypeError) as error:
        raise ValueError(f"{where}: expected the fields of RangeNet, found {str(error)!r:.100}") from None
    if found != [32, True, True, remission]:
        raise ValueError(f"{where}: expected backbone OS 32 with range, xyz and {'' if remission else 'no '}remission, "
                         f"found {found}")  # fmt: skip
    if not all(isinstance(values, list) and all(isinstance(v, int | float) for v in values) for values in numbers):
        raise ValueError(f"{where}: expected img_means and img_stds as numbers, found {numbers!r:.100}")
    return layers, numbers[0], numbers[1]


def _numbers(config: Any, needed: bool) -> list[Any]:
    if needed or "dataset" in config:
        return [config["dataset"]["sensor"][k] for k in ("img_means", "img_stds")]
    return [list(MEANS), list(STDS)]
