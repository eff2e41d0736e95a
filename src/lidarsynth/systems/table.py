"""The table of systems: word of `model.network` -> what its family brings; and what is done by looking it up."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from lidarsynth.experiment.eight_bits import unpacked
from lidarsynth.experiment.folder import on_base, owned, read_experiment
from lidarsynth.experiment.record import RECORD, WEIGHTS, Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.lidar.small_file import LARGEST_WEIGHTS, check_regular
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.finite import refuse_not_finite
from lidarsynth.networks.tensors import Undrawn, load_weights
from lidarsynth.systems.cascade.family import CASCADE
from lidarsynth.systems.diffusion.family import CONDITIONAL_UNET, EFFICIENT_UNET, REFINENET
from lidarsynth.systems.gan.family import GAN
from lidarsynth.systems.graph import Graph
from lidarsynth.systems.interpolation.family import INTERPOLATION
from lidarsynth.systems.memory import check_memory
from lidarsynth.systems.model_card import card_text
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.segmentation.family import RANGENET
from lidarsynth.systems.system import Official, System
from lidarsynth.systems.upsampling.family import ILN_SYSTEM, LIDAR_SR, LIIF_SYSTEM
from lidarsynth.training.task import Task

SHIPPED = Path(str(files("lidarsynth") / "shipped"))  # folders of the weights inside the package

SYSTEMS: dict[str, System] = {
    "cascade": CASCADE,
    "efficient-unet": EFFICIENT_UNET,
    "conditional-unet": CONDITIONAL_UNET,
    "refinenet": REFINENET,  # a noise predictor; with a score group LiDARGen's score network
    "vanilla-gan": GAN,
    "dusty-v1": GAN,
    "dusty-v2": GAN,
    "lidar-sr": LIDAR_SR,
    "iln": ILN_SYSTEM,
    "liif": LIIF_SYSTEM,
    "nearest": INTERPOLATION,
    "bilinear": INTERPOLATION,
    "bicubic": INTERPOLATION,
    "rangenet": RANGENET,
}


def system_of(experiment: Experiment) -> System:
    """What the experiment's network brings. Raises ValueError for a word that is not in SYSTEMS."""
    word = experiment.model.network
    if word not in SYSTEMS:
        raise ValueError(f"model.network: expected one of {', '.join(SYSTEMS)}, found {word!r}")
    return SYSTEMS[word]


def build_network(experiment: Experiment) -> nn.Module:
    """The experiment's network with fresh weights and, where it has them, the sensor's ray angles; for evaluation.

    Raises ValueError for a word that is not in SYSTEMS, and for a network larger than this machine's memory.
    """
    system, sensor = system_of(experiment), build_sensor(experiment)
    check_memory(experiment, lambda: system.build(experiment, sensor))
    return system.build(experiment, sensor).eval()


def assemble(experiment: Experiment, network: nn.Module) -> ScanModel:
    """The model of an experiment and its trained network. Raises ValueError for a network that makes no scans."""
    model = system_of(experiment).model
    if model is None:
        words = ", ".join(word for word, system in SYSTEMS.items() if system.model)
        raise ValueError(f"{experiment.name}: expected a network of {words}, which make scans, "
                         f"found {experiment.model.network}")  # fmt: skip
    for part in tuple(network.children()) if isinstance(network, Cascade) else (network,):
        refuse_not_finite(part, experiment.name)
    return model(experiment, network.eval())


def task_of(experiment: Experiment) -> Task:
    """How the experiment's network is trained. Raises ValueError for one that has nothing to train."""
    task = system_of(experiment).task
    if task is None:
        words = ", ".join(word for word, system in SYSTEMS.items() if system.task)
        raise ValueError(f"model.network: expected one of {words}, found {experiment.model.network!r}")
    return task(experiment)


def transfer(network: nn.Module, experiment: Experiment, weights: nn.Module, source: Experiment, name: str) -> None:
    """Copy trained `weights` (of experiment `source`, called `name`) into the fresh `network` of `experiment`.

    What may differ, its family's `transfer` says. Raises ValueError for weights of another family, or that do not fit.
    """
    system = system_of(experiment)
    if system.transfer is None or system.family != system_of(source).family:
        found, expected = (f"{e.model.network} of {e.data.codec} range" for e in (source, experiment))
        raise ValueError(f"{name}: expected weights of {expected}, found {found}")
    system.transfer(network, experiment, weights, source, name)


def card_of(experiment: Experiment, repo_id: str = "owner/name") -> str:
    """`card_text` of any experiment. Raises ValueError as `system_of`."""
    return card_text(experiment, system_of(experiment).description, repo_id)


def graph_of(model: ScanModel, open_columns: bool = False) -> Graph:
    """What an exported file of the model holds. Raises ValueError for models that nothing can be exported of."""
    graph = system_of(model.experiment).graph
    if graph is None:
        words = ", ".join(word for word, system in SYSTEMS.items() if system.graph)
        raise ValueError(f"{model.experiment.name}: expected a network of {words} to export, found "
                         f"{model.experiment.model.network}")  # fmt: skip
    return graph(model, open_columns)


def official_readers() -> dict[str, Official]:
    """The readers of published checkpoints by the names of their systems; R2DM's own are read by `weights`."""
    readers = [system.official for system in SYSTEMS.values()]
    return {reader.name: reader for reader in readers if reader is not None}


def load_folder(folder: str | Path) -> tuple[Experiment, nn.Module]:
    """A saved model: its experiment and its network. Raises ValueError when either file is not as it should be.

    Of one with a `base`, the weights that it shares are read from that, which must be shipped and have no base itself.
    """
    experiment, path = read_experiment(folder), Path(folder) / WEIGHTS
    shared: dict[str, Tensor] = {}
    if experiment.base:
        base, shared = _base(experiment, str(folder))
        experiment = on_base(experiment, base)
    with Undrawn():
        network = build_network(experiment)
    try:
        check_regular(path, LARGEST_WEIGHTS)
        weights = unpacked(load_file(path))
    except FileNotFoundError:
        raise ValueError(f"{folder}: expected {WEIGHTS} beside {RECORD}, found none") from None
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: expected safetensors weights, found {error}") from None
    load_weights(network, {**shared, **weights}, str(path))
    return experiment, network


def _base(experiment: Experiment, folder: str) -> tuple[Experiment, dict[str, Tensor]]:
    """The record of an experiment's base, and the weights that it has from it, by name."""
    bases = {home.name: home for home in SHIPPED.iterdir() if (home / RECORD).is_file()}
    home = bases.get(experiment.base)
    base = None if home is None else read_experiment(home)
    if home is None or base is None or base.base:
        raise ValueError(f"{folder}: expected a base of shipped weights that have none, found {experiment.base!r:.60}")
    own, weights = owned(experiment), unpacked(load_file(home / WEIGHTS))
    return base, {name: value for name, value in weights.items() if not name.startswith(own)}
