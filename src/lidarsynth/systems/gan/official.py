"""Official checkpoints of Vanilla GAN, DUSty v1 and DUSty v2: those of the WACV 2023 release, and of the IROS 2021 one,
which has DUSty-II too.

A WACV file is dict(cfg, step, angle, G, D, G_ema, A, ...), whose `cfg` is a pickled OmegaConf object. It is read with
weights_only=True all the same: STAND_INS are empty classes that take the place of OmegaConf's, so that no code of that
package runs or is needed. Nothing is read from them: tensors tell kind, widths and resolution, and `angle` the rays. A
file that pickles more than that is refused. An IROS file is dict(step, G, D, G_ema, ...); its rays are not in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor, nn

from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Adversarial, Card, Data, Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.sensor import get_sensor
from lidarsynth.networks.gan.iros21 import generator_weights, masks
from lidarsynth.networks.tensors import Undrawn, load_weights
from lidarsynth.systems.gan.build import generator


class _Nothing:
    """An object of another package's class, without its behaviour."""


class _NoTable(dict):
    """A table that forgets what it was made with."""

    def __init__(self, *ignored: object):
        super().__init__()


STAND_INS = [  # what torch.serialization.safe_globals takes: our class, and the name that the file knows
    *[(_Nothing, f"omegaconf.nodes.{kind}Node") for kind in ("Any", "String", "Integer", "Float", "Boolean", "Enum")],
    *[(_Nothing, f"omegaconf.base.{name}") for name in ("ContainerMetadata", "Metadata")],
    (_Nothing, "omegaconf.dictconfig.DictConfig"),
    (_Nothing, "omegaconf.listconfig.ListConfig"),
    (_Nothing, "typing.Any"),
    (_NoTable, "collections.defaultdict"),
    *[(kind, f"builtins.{kind.__name__}") for kind in (dict, list, int, float, str, bool)],
]

LICENCE = "CC BY-NC-SA 3.0, that of KITTI"


def belongs(checkpoint: object) -> bool:
    """Whether this is a dict with a generator, its average and a discriminator."""
    return isinstance(checkpoint, dict) and {"G", "D", "G_ema"} <= checkpoint.keys()


def read(checkpoint: Any, name: str, ema: bool = True) -> tuple[Experiment, nn.Module]:
    """The experiment, called `name`, and the generator of a checkpoint; sizes are those of its tensors.

    ema  the moving average (True) or the raw weights

    Raises ValueError for tensors that are missing, of other shapes, or of another network.
    """
    part = "G_ema" if ema else "G"
    state = checkpoint[part]
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(f"expected {part} with tensors by name, found {type(state).__name__}")
    first_release = any(key.startswith(("0.0.module", "backbone.")) for key in state)
    if first_release:
        state = generator_weights(state)
        experiment = _iros21(state)
    else:
        experiment = _wacv23(state, checkpoint.get("angle"), name)
    title, data = ("IROS 2021", "KITTI Odometry") if first_release else ("WACV 2023", "KITTI raw")
    word = "DUSty-II" if (experiment.adversarial or Adversarial()).image_mask else experiment.model.network
    history = f"official {word} checkpoint ({title}), step {checkpoint.get('step', 'not told')}"
    experiment = replace(experiment, name=name, card=Card(LICENCE, data, (history,)))
    with Undrawn():
        network = generator(experiment, build_sensor(experiment)).eval()
    weights = {f"generator.{key}": value for key, value in state.items()}
    if experiment.model.network == "dusty-v2":
        weights["angles"] = checkpoint["angle"]
    load_weights(network, weights, part)
    return experiment, network


def _wacv23(state: Mapping[str, Tensor], angle: object, name: str) -> Experiment:
    """Without weights; the sensor has the rays of `angle` (1, 2, H, W)."""
    if not isinstance(angle, Tensor) or angle.ndim != 4 or angle.shape[:2] != (1, 2):
        found = tuple(angle.shape) if isinstance(angle, Tensor) else type(angle).__name__
        raise ValueError(f"expected angle (1, 2, H, W) beside G, found {found}")
    if any(key.startswith("mapping_network.") for key in state):
        style, latent = _shape(state, "mapping_network.1.0.module.weight", 2)
        top = _shape(state, "synthesis_network.layers.0.conv1.weight", 5)[1]
        base = _shape(state, "synthesis_network.layers.4.conv1.weight", 5)[1]
        group, word = Adversarial(latent, style, max_channels=top), "dusty-v2"
    else:
        group, base, size = _dcgan(state)
        word = _word(state)
        if size != tuple(angle.shape[2:]):
            raise ValueError(f"expected a generator of the size of angle {tuple(angle.shape[2:])}, found {size}")
    experiment = preset(word)
    data = replace(experiment.data, sensor=_sensor(angle, name), height=angle.shape[2], width=angle.shape[3])
    return replace(experiment, data=data, model=replace(experiment.model, base_channels=base), adversarial=group)


def _iros21(state: Mapping[str, Tensor]) -> Experiment:
    """Without weights; the sensor is KITTI's, since the release has its rays in another file."""
    group, base, (height, width) = _dcgan(state)
    word = _word(state)
    experiment = preset(word)
    # Without ray-drop an inverse depth that is nearly 0 stands for no return, as in the release's evaluation.
    empty = 0.008 if word == "vanilla-gan" else 0.0
    group = replace(group, iros21=True, empty_below=empty, image_mask=masks(state) == 2)
    data = Data("hdl-64e-iros21", "unfolding", height, width, "inverse-minmax", reflectance=False)
    return replace(experiment, data=data, model=replace(experiment.model, base_channels=base), adversarial=group)


def _dcgan(state: Mapping[str, Tensor]) -> tuple[Adversarial, int, tuple[int, int]]:
    """Latents and widest map, channels of the finest map, and (H, W), of Vanilla GAN and DUSty v1."""
    latent, top, rows, columns = _shape(state, "synthesis_network.0.1.module.weight", 4)
    base = _shape(state, "synthesis_network.3.1.module.weight", 4)[1]
    return Adversarial(latent, max_channels=top), base, (16 * rows, 16 * columns)


def _word(state: Mapping[str, Tensor]) -> str:
    return "dusty-v1" if any(".heads.raydrop_logit." in key for key in state) else "vanilla-gan"


def _shape(state: Mapping[str, Tensor], key: str, dimensions: int) -> tuple[int, ...]:
    if key not in state or state[key].ndim != dimensions:
        found = tuple(state[key].shape) if key in state else f"{len(state)} tensors {sorted(state)[:2]}"
        raise ValueError(f"expected a generator with {key} of {dimensions} dimensions, found {found}")
    return tuple(state[key].shape)


def _sensor(angle: Tensor, name: str) -> str | dict[str, Any]:
    """The mean measured beams, columns evenly spaced: an eighth of a pixel at most from the columns of `angle`.

    The released table has a word.
    """
    rows = np.degrees(angle[0, 0].double().numpy()).mean(axis=1)
    if not np.all(np.diff(rows) < 0):
        raise ValueError(f"expected angle with elevations that fall from row to row, found {rows[:4]} degrees")
    released = get_sensor("hdl-64e-dusty")
    if len(rows) == released.height and np.allclose(rows, released.elevations, rtol=0, atol=1e-4):
        return released.name
    limits = {"min_range": 1.45, "max_range": 80.0, "mount": 1.73}
    return {"name": name, "elevations": rows.round(6).tolist(), "width": angle.shape[3], **limits}
