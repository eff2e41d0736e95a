"""What is said of interpolations."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment
from lidarsynth.systems.description import About, Description


def _network(experiment: Experiment) -> str:
    return experiment.model.network


def _details(experiment: Experiment) -> dict[str, str]:
    """An interpolation has nothing but its settings."""
    word = experiment.model.network
    rows = {
        "nearest": "the value of the nearest known row",
        "bilinear": "linear between the known rows above and below",
        "bicubic": "cubic convolution (a = -0.75) of four known rows",
    }
    cross = "nearest known pixels up, down, left and right, by 1 / distance"
    return {
        "parameters": "0, nothing to train",
        "values": "range in metres and reflectance, an empty pixel is 0; measured pixels stay, the azimuth is a ring",
        "whole beams": f"{rows[word]}; measured rows stay where they are, beyond the outermost their values repeat",
        "other masks": "nearest known pixel" if word == "nearest" else cross,
        "images": "those of any sensor, default hdl-64e-kitti",
    }


def _about(experiment: Experiment) -> About:
    usage = (f'model = ls.load("{experiment.model.network}")', 'dense = model.complete(ls.read("scan.pcd"))')
    return About(f"A {experiment.model.network} interpolation, which has no weights.", usage, ("interpolation",))


DESCRIPTION = Description(_network, _details, _about)
