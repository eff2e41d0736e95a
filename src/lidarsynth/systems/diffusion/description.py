"""What is said of U-Nets and of RefineNet."""

from __future__ import annotations

from lidarsynth.experiment.record import Experiment
from lidarsynth.systems.description import About, Description


def _unet(experiment: Experiment) -> str:
    model = experiment.model
    shape = f"base {model.base_channels} x {model.channel_multipliers}, blocks {model.num_residual_blocks}"
    return f"{model.network}, {shape}, stem {model.stem[0]}x{model.stem[1]}, {model.coords_encoding}"


def _refinenet(experiment: Experiment) -> str:
    return f"refinenet of LiDARGen, base {experiment.model.base_channels}, column and row as coordinates"


def _details(experiment: Experiment) -> dict[str, str]:
    diffusion, score = experiment.diffusion, experiment.score
    if score is None:
        return {"diffusion": f"{diffusion.schedule} schedule, predicts {diffusion.kind}, {diffusion.loss} loss"}
    return {
        "score matching": f"{score.levels} noise levels, sigma {score.sigma_max:g} to {score.sigma_min:g} of data in "
        f"[0, 1]; sampled in {score.steps} Langevin steps at each",
    }


def _about(experiment: Experiment) -> About:
    what = "generates and completes" if experiment.model.network == "conditional-unet" else "generates"
    kind, paper, number, steps = "diffusion", "R2DM", "2309.09256", "steps=32, "
    if experiment.score is not None:  # few steps are not enough for Langevin dynamics
        kind, paper, number, steps = "score-based", "LiDARGen", "2209.03954", ""
    return About(
        f"A {kind} model that {what} LiDAR scans, made with lidarsynth after {paper} "
        f"([arXiv {number}](https://arxiv.org/abs/{number})).",
        ('model = ls.load("{repo_id}")', f"images = model.generate(4, {steps}seed=0)",
         'dense = model.complete(ls.read("scan.pcd"))'),
        ("diffusion",),
    )  # fmt: skip


def _network(experiment: Experiment) -> str:
    return _refinenet(experiment) if experiment.model.network == "refinenet" else _unet(experiment)


DESCRIPTION = Description(_network, _details, _about)
