"""LiDAR-Diffusion's weights of MinkowskiNet and SPVCNN: read by name and shape, all of them or none."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from lidarsynth.networks.archive import read_yaml, weight_files
from lidarsynth.networks.minkowski_unet import MinkowskiUNet, widths_of
from lidarsynth.networks.spvcnn import SPVCNN
from lidarsynth.networks.tensors import CONVERT, check_shapes, load_weights, read_pickle

Kind = Literal["minkowskinet", "spvcnn"]
CHECKPOINT, CONFIG = "model.ckpt", "config.yaml"
FILES = {CHECKPOINT: 1 << 30, CONFIG: 1 << 20}
FIRST = "stem.0.kernel"  # its name tells the prefix of all the others
WIDTHS = (FIRST, *(f"stage{k}.2.net.0.kernel" for k in range(1, 5)), *(f"up{k}.1.1.net.0.kernel" for k in range(1, 5)))


def read_sparse(path: str | Path, kind: Kind) -> MinkowskiUNet | SPVCNN:
    """The network of a `.tar.gz` or folder with model.ckpt, or of a checkpoint by itself, in evaluation mode.

    Tensors are taken by name, below any common prefix; widths are those of the tensors, and `model_params.cr` of a
    config.yaml must say the same. Names of other things, such as a loss, are left out. Raises ValueError for a damaged
    or another file, and for one of pickled classes, saying how to convert it; ImportError without pyyaml.
    """
    path = Path(path)
    if path.suffix in (".ckpt", ".pth", ".pt"):
        files, where, checkpoint = {}, str(path), read_pickle(path, str(path), CONVERT)
    else:
        files, where = weight_files(path, FILES, (CHECKPOINT,), kind), f"{path}: {CHECKPOINT}"
        checkpoint = read_pickle(BytesIO(files[CHECKPOINT]), where, CONVERT)
    tensors = _tensors_of(checkpoint, where)
    if absent := [name for name in WIDTHS if name not in tensors or tensors[name].ndim != 3]:
        raise ValueError(f"{where}: expected the tensors of {kind}, found no kernel {absent[0]}")
    widths = tuple(tensors[name].shape[2] for name in WIDTHS)
    if CONFIG in files:
        _check_widths(files[CONFIG], f"{path}: {CONFIG}", widths)
    if kind == "minkowskinet" and any(name.startswith("point_transforms.") for name in tensors):
        raise ValueError(f"{where}: expected the tensors of minkowskinet, found a point branch, as of spvcnn")
    build = {"minkowskinet": MinkowskiUNet, "spvcnn": SPVCNN}[kind]
    with torch.device("meta"):  # shapes first, so that absurd ones cost nothing
        shapes = build(widths)
    known = shapes.state_dict().keys()
    own = {name: value for name, value in tensors.items() if name in known}
    check_shapes(shapes, own, where)
    network = build(widths)
    load_weights(network, own, where, counters=True)
    return network.eval()


def _tensors_of(checkpoint: Any, where: str) -> dict[str, Tensor]:
    """Tensors by name, of a state dict or a dictionary that holds one, below the prefix of the first kernel."""
    state = checkpoint.get("state_dict", checkpoint) if isinstance(checkpoint, dict) else checkpoint
    if not isinstance(state, dict) or not all(isinstance(name, str) for name in state):
        raise ValueError(f"{where}: expected tensors by name, found {type(state).__name__}")
    prefixes = [name.removesuffix(FIRST) for name in state if name.endswith(FIRST)]
    if len(prefixes) != 1:
        raise ValueError(f"{where}: expected one tensor named ...{FIRST}, found {len(prefixes)}")
    own = {name.removeprefix(prefixes[0]): value for name, value in state.items() if name.startswith(prefixes[0])}
    return {name: value for name, value in own.items() if isinstance(value, Tensor)}


def _check_widths(text: bytes, where: str, widths: tuple[int, ...]) -> None:
    config = read_yaml(text, where)
    params = config.get("model_params") if isinstance(config, dict) else None
    cr = params.get("cr") if isinstance(params, dict) else None
    if isinstance(cr, int | float) and 0 < cr < 100 and widths_of(cr) != widths:
        raise ValueError(f"{where}: expected widths {list(widths_of(cr))} of cr {cr}, found tensors of {list(widths)}")
