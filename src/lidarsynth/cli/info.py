"""The verb `info`: what a model, a preset, a sensor or a scan file is."""

from __future__ import annotations

from typing import Annotated

from lidarsynth.cli.arguments import NoSeed, Positional, arg
from lidarsynth.cli.terminal import say


def info(
    what: Annotated[
        Positional[str],
        arg(help="default, a preset, a release, a model folder, an official .pth, a sensor, or a scan file."),
    ] = "default",
    seed: NoSeed = 0,
) -> None:
    """What a model, a preset, a sensor or a scan file is."""
    from lidarsynth.verbs.description import describe

    say(describe(what))
