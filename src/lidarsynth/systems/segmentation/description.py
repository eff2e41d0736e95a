"""What is said of RangeNet."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment, Segmentation
from lidarsynth.systems.description import About, Description


def _network(experiment: Experiment) -> str:
    layers = (experiment.segmentation or Segmentation()).layers
    return f"RangeNet-{layers}, width {experiment.model.base_channels}: a class for every pixel, makes no scans"


def _details(experiment: Experiment) -> dict[str, str]:
    return {}


def _about(experiment: Experiment) -> About:
    layers = (experiment.segmentation or Segmentation()).layers
    return About(
        f"A RangeNet-{layers} (Milioto et al., IROS 2019) that says the class of every pixel of a LiDAR scan, made "
        "with lidarsynth. It makes no scans.",
        ("from lidarsynth.weights.load import load_parts", "", 'experiment, network = load_parts("{repo_id}")'),
        ("semantic-segmentation",),
    )


DESCRIPTION = Description(_network, _details, _about)
