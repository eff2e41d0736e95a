"""The model card of a repository: Markdown that is filled in from an experiment."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from lidarsynth.experiment.record import Card, Data, Experiment
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.systems.description import Description, training_line

LICENCES = {  # how a card's licence begins -> the hub's word for it
    "MIT": "mit",
    "Apache-2.0": "apache-2.0",
    "CC BY-NC-SA 3.0": "cc-by-nc-sa-3.0",
    "CC BY-NC-SA 4.0": "cc-by-nc-sa-4.0",
    "CC BY 4.0": "cc-by-4.0",
    "CC0": "cc0-1.0",
}


def card_text(experiment: Experiment, description: Description, repo_id: str = "owner/name") -> str:
    """The model card of a repository, Markdown under the hub's metadata: what it is, where it learned, its licence.

    Everything in it comes from the experiment, its card and its system's description. Raises ValueError when the
    experiment has no valid sensor.
    """
    about, sensor = description.about(experiment), build_sensor(experiment)
    usage = ["```python", "import lidarsynth as ls  # pip install 'lidarsynth[hub]'", *about.usage, "```"]
    sections = [
        _metadata(experiment.card.licence, about.tags),
        f"# {experiment.name}, {sensor.name}\n\n{about.sentence}",
        "\n".join(usage).replace("{repo_id}", repo_id),
        _table(experiment, {"network": description.network(experiment), **description.details(experiment)}),
        *_story(experiment.card),
    ]
    return "\n\n".join(sections) + "\n"


def _metadata(licence: str, tags: Sequence[str]) -> str:
    lines = ["library_name: lidarsynth", f"tags: [{', '.join(('lidar', 'point-cloud', 'range-image', *tags))}]"]
    if licence:
        word = next((word for start, word in LICENCES.items() if licence.startswith(start)), "other")
        lines.append(f"license: {word}")
        lines += [f"license_name: {json.dumps(licence)}"] if word == "other" else []
    return "\n".join(["---", *lines, "---"])


def _table(experiment: Experiment, own: Mapping[str, str]) -> str:
    """Sensor, images, training, and between them the rows of the system's `own`."""
    data, sensor = experiment.data, build_sensor(experiment)
    reflectance = ", reflectance 0 to 1" if data.reflectance else ", no reflectance"
    rows = {
        "sensor": f"{sensor.name}, {sensor.height} beams from {sensor.elevations[0]:+.2f} to "
        f"{sensor.elevations[-1]:+.2f} degrees, {sensor.min_range:g} to {sensor.max_range:g} m",
        "images": f"{data.height} x {data.width}, {data.projection} projection, {data.codec} range{reflectance}",
        **own,
        "training": f"{training_line(experiment)}, seed {experiment.training.seed}",
        "augmentation": _augmentation(data),
    }
    return "\n".join(["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in rows.items())])


def _augmentation(data: Data) -> str:
    """All that changes a training image, with how often or how much."""
    parts = {
        "roll": data.roll,
        "mirror": data.mirror,
        f"worlds up to {data.scale:.0%} larger or smaller": data.scale > 0,
        f"a sector of another scan in {data.mix:.0%} of those to be completed": data.mix > 0,
        f"{data.even:.0%} of KITTI's to be completed drawn in the even grid hdl-64e": data.even > 0,
    }
    return ", ".join(words for words, on in parts.items() if on) or "none"


def _story(card: Card) -> list[str]:
    """The sections of what the card holds; what it does not say is said to be unknown, not left out."""
    sections = [f"## Learned from\n\n{card.data or 'Not recorded.'}"]
    sections.append(f"## Licence\n\n{card.licence or 'Not stated: ask the owner before use.'}")
    for title, lines in (("History", card.history), ("Results", card.results)):
        if lines:
            sections.append("\n".join([f"## {title}", "", *(f"- {line}" for line in lines)]))
    return sections
