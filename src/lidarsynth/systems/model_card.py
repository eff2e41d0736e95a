"""The model card of a repository: Markdown that is filled in from an experiment."""

from __future__ import annotations

import json

from lidarsynth.experiment.record import Card, Experiment, Model
from lidarsynth.experiment.sensor import build_sensor

LICENCES = {  # how a card's licence begins -> the hub's word for it
    "MIT": "mit",
    "Apache-2.0": "apache-2.0",
    "CC BY-NC-SA 3.0": "cc-by-nc-sa-3.0",
    "CC BY-NC-SA 4.0": "cc-by-nc-sa-4.0",
    "CC BY 4.0": "cc-by-4.0",
    "CC0": "cc0-1.0",
}


def card_text(experiment: Experiment, repo_id: str = "owner/name") -> str:
    """The model card of a repository, Markdown under the hub's metadata: what it is, where it learned, its licence.

    Everything in it comes from the experiment and its card. Raises ValueError when the experiment has no valid sensor.
    """
    sections = [_metadata(experiment.card.licence), _title(experiment), _usage(experiment, repo_id), _table(experiment)]
    sections += _story(experiment.card)
    return "\n\n".join(sections) + "\n"


def _metadata(licence: str) -> str:
    lines = ["library_name: lidarsynth", "tags: [lidar, point-cloud, range-image, diffusion]"]
    if licence:
        word = next((word for start, word in LICENCES.items() if licence.startswith(start)), "other")
        lines.append(f"license: {word}")
        lines += [f"license_name: {json.dumps(licence)}"] if word == "other" else []
    return "\n".join(["---", *lines, "---"])


def _title(experiment: Experiment) -> str:
    what = "generates and completes" if experiment.model.network == "conditional-unet" else "generates"
    kind, paper, number = ("diffusion", "R2DM", "2309.09256")
    if experiment.score is not None:
        kind, paper, number = ("score-based", "LiDARGen", "2209.03954")
    return (
        f"# {experiment.name}, {build_sensor(experiment).name}\n\nA {kind} model that {what} LiDAR scans, made with "
        f"lidarsynth after {paper} ([arXiv {number}](https://arxiv.org/abs/{number}))."
    )


def _usage(experiment: Experiment, repo_id: str) -> str:
    steps = "steps=32, " if experiment.score is None else ""  # few steps are not enough for Langevin dynamics
    return f"""```python
import lidarsynth as ls  # pip install 'lidarsynth[hub]'

model = ls.load("{repo_id}")
images = model.generate(4, {steps}seed=0)
dense = model.complete(ls.read("scan.pcd"))
```"""


def _table(experiment: Experiment) -> str:
    data, model, diffusion, training = experiment.data, experiment.model, experiment.diffusion, experiment.training
    sensor, weighted = build_sensor(experiment), "none" if diffusion.gamma is None else f"min-SNR {diffusion.gamma:g}"
    rows = {
        "sensor": f"{sensor.name}, {sensor.height} beams from {sensor.elevations[0]:+.2f} to "
        f"{sensor.elevations[-1]:+.2f} degrees, {sensor.min_range:g} to {sensor.max_range:g} m",
        "images": f"{data.height} x {data.width}, {data.projection} projection, {data.codec} range, reflectance 0 to 1",
        "network": f"{model.network}, base {model.base_channels}"
        + ("" if model.network == "refinenet" else _unet(model)),
        "diffusion": f"{diffusion.schedule} schedule, predicts {diffusion.kind}, {diffusion.loss} loss, "
        f"weighting {weighted}",
        "training": f"{training.steps:,} steps of {training.batch_size}, learning rate {training.learning_rate:g}, "
        f"seed {training.seed}",
        "augmentation": ", ".join(w for w, on in (("roll", data.roll), ("mirror", data.mirror)) if on) or "none",
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows.items())])


def _unet(model: Model) -> str:
    return (
        f" x {list(model.channel_multipliers)}, blocks {list(model.num_residual_blocks)}, "
        f"stem {model.stem[0]}x{model.stem[1]}, {model.coords_encoding}"
    )


def _story(card: Card) -> list[str]:
    """The sections of what the card holds; what it does not say is said to be unknown, not left out."""
    sections = [f"## Learned from\n\n{card.data or 'Not recorded.'}"]
    sections.append(f"## Licence\n\n{card.licence or 'Not stated: ask the owner before use.'}")
    for title, lines in (("History", card.history), ("Results", card.results)):
        if lines:
            sections.append("\n".join([f"## {title}", "", *(f"- {line}" for line in lines)]))
    return sections
