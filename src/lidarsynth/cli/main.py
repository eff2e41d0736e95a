"""The command line: one table word -> verb. Heavy imports are inside the verbs, so that --help is instant."""

from __future__ import annotations

import sys

from lidarsynth.cli.arguments import fields_joined
from lidarsynth.cli.benchmark import benchmark
from lidarsynth.cli.complete import complete
from lidarsynth.cli.data import data
from lidarsynth.cli.demo import demo
from lidarsynth.cli.evaluate import evaluate
from lidarsynth.cli.export import export
from lidarsynth.cli.generate import generate
from lidarsynth.cli.info import info
from lidarsynth.cli.project import project
from lidarsynth.cli.realise import realise
from lidarsynth.cli.sensor import sensor
from lidarsynth.cli.streets import streets
from lidarsynth.cli.terminal import answer, say
from lidarsynth.cli.train import train
from lidarsynth.cli.upsample import upsample
from lidarsynth.cli.view import view

VERBS = {
    "demo": demo,
    "generate": generate,
    "complete": complete,
    "upsample": upsample,
    "realise": realise,
    "project": project,
    "view": view,
    "sensor": sensor,
    "data": data,
    "streets": streets,
    "train": train,
    "evaluate": evaluate,
    "benchmark": benchmark,
    "export": export,
    "info": info,
}


def main(argv: list[str] | None = None) -> None:
    """Run one verb: exits 0, or 2 with one line that says what was expected and what was found."""
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--version"]:
        from importlib.metadata import version

        say(f"lidarsynth {version('lidarsynth')}")
        return
    answer(VERBS, fields_joined(argv) if argv[:1] == ["train"] else argv)
