"""The verb `train`: train a preset."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import Positional, arg
from lidarsynth.cli.terminal import progress_line, say
from lidarsynth.training.options import Options


def train(
    preset: Annotated[Positional[str], arg(help="such as default, r2dm-h, tiny.")],
    data: Annotated[
        Path | None,
        arg(metavar="CACHE|synthetic|virtual|varied|interiors|recordings", help="or several, A,B; or streets."),
    ] = None,
    out: Annotated[Path | None, arg(help="folder for weights and checkpoints; default runs/PRESET.")] = None,
    weights: Annotated[str | None, arg(name="from", metavar="MODEL", help="start from these weights.")] = None,
    set: Annotated[tuple[str, ...], arg(help="such as training.steps=9; or --training.steps 9.")] = (),
    validation: Annotated[Path | None, arg(metavar="CACHE", help="images that are not trained on.")] = None,
    resume: Annotated[bool, arg(help="insist that there is a run to continue.")] = False,
    dry_run: Annotated[bool, arg(help="print the resolved experiment and stop.")] = False,
    seed: Annotated[int, arg(help="of weights, order and noise.")] = 0,
    options: Annotated[Options, arg(name="")] = Options(),  # noqa: B008, frozen
) -> None:
    """Train a preset; killed at any moment, the same command goes on exactly, from the newest checkpoint."""
    from lidarsynth.verbs.training import resolve, run

    experiment = resolve(preset, set, seed, data)
    if dry_run:
        say(json.dumps(asdict(experiment), indent=1))
        return
    if data is None:
        raise ValueError("expected --data CACHE or --data synthetic, found neither")
    out = out or Path("runs") / preset
    steps = experiment.training.steps
    done = list(progress_line(run(experiment, data, out, weights, validation, options, resume), steps))
    if done:  # other processes than the first say nothing
        say(
            f"wrote {out}/" + (f", stopped after step {done[-1]}; the same command goes on" if done[-1] < steps else "")
        )
