"""The verb `info`: what a model, a preset, a sensor, a file or a folder is."""

from __future__ import annotations

from typing import Annotated

from lidarsynth.cli.arguments import NoSeed, Positional, arg
from lidarsynth.cli.terminal import say


def info(
    what: Annotated[
        Positional[str],
        arg(help="a model, preset, release or sensor; or a file or folder: scans, bag, capture, cache, statistics."),
    ] = "default",
    seed: NoSeed = 0,
) -> None:
    """What a model, a preset, a sensor, a file or a folder is."""
    from lidarsynth.verbs.description import describe

    say(describe(what))
