"""What is said of networks that put beams between known ones."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment, Upsampling
from lidarsynth.systems.description import About, Description

PAPERS = {
    "lidar-sr": "Shan et al., Robotics and Autonomous Systems 2020",
    "iln": "Kwon, Sung & Yoon, ICRA 2022",
    "liif": "Chen, Liu & Wang, CVPR 2021",
}


def _network(experiment: Experiment) -> str:
    model, group = experiment.model, experiment.upsampling or Upsampling()
    if model.network == "lidar-sr":
        program = "Keras" if group.keras else "PyTorch"
        return f"lidar-sr ({program}), base {model.base_channels}, dropout {model.dropout:g}; range only"
    size = f"{sum(model.num_residual_blocks)} blocks of {model.base_channels} channels"
    if model.network == "iln":
        return f"iln, {size}, {group.depth} layers of {model.attn_num_heads} heads; range only"
    told = f"{', of 3x3 pixels' if group.unfold else ''}{'' if group.ensemble else ', of one neighbour'}"
    return f"{model.network}, {size}{told}; range only"


def _shown(experiment: Experiment) -> dict[str, str]:
    """What a network that puts beams between known ones is shown, and how it answers."""
    group, height = experiment.upsampling or Upsampling(), experiment.data.height
    rows = f"{height // group.factor[0]} to {height} rows (beams:{group.factor[0]}:{group.first})"
    range_ = f"1 is {group.norm:g} m, up to {group.max_range:g} m, no return is {0 if group.keras else 1}"
    range_ += f", nearer than {group.min_range:g} m is 0" if group.min_range else ""
    if experiment.model.network != "lidar-sr":
        return {"upsampling": f"{rows}, and any other known beams and rays; {range_}"}
    answer = f"mean of {group.passes} passes under dropout, empty where they vary by more than {group.threshold:.0%}"
    return {"upsampling": f"{rows}; {range_}; {answer}"}


def _about(experiment: Experiment) -> About:
    word = experiment.model.network
    return About(
        f"A network that puts beams between the known ones of a LiDAR scan, without reflectance, made with lidarsynth "
        f"after {word} ({PAPERS[word]}). It makes no new scans.",
        ('model = ls.load("{repo_id}")', 'dense = model.upsample(ls.read("scan.pcd"))  # recognises its sensor'),
        ("super-resolution",),
    )


DESCRIPTION = Description(_network, _shown, _about)
