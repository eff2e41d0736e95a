"""What is said of the cascade."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment
from lidarsynth.systems.cascade.layout import CHOICE
from lidarsynth.systems.description import About, Description


def _network(experiment: Experiment) -> str:
    return "cascade: a coarse layout, and one step that fills in the rest, for any sensor"


def _details(experiment: Experiment) -> dict[str, str]:
    model = experiment.model
    layout = "column by column after a draft by flow matching, and " if model.column_channels else ""
    between = "; 512 columns by what is drawn between them" if model.between_channels else ""
    between += ", then up to 61 beams" if model.beam_channels else ""
    between += f", one of {CHOICE} layouts, by its odds as a street's" if model.judge_channels else ""
    grid = f"a grid of 16 beams x 128 columns, {layout}by flow matching{between}"
    return {"layout": f"{grid}; all pixels are filled in one step"}


def _about(experiment: Experiment) -> About:
    return About(
        "A model that generates, completes and upsamples LiDAR scans of any sensor, made with lidarsynth.",
        ('model = ls.load("{repo_id}")', "images = model.generate(4, seed=0)",
         'dense = model.complete(ls.read("scan.pcd"))', 'up = model.upsample(ls.read("vlp16.pcd"), times=4)'),
        ("diffusion", "super-resolution"),
    )  # fmt: skip


DESCRIPTION = Description(_network, _details, _about)
