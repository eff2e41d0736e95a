"""The command line: a verb is a file of this folder that holds a function of the file's name. Nothing lists them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import FunctionType

from lidarsynth.cli.arguments import fields_joined
from lidarsynth.cli.parsing import parsed
from lidarsynth.cli.terminal import answer, say


def _verbs() -> dict[str, Callable[..., None]]:
    """Word -> verb, by the alphabet. Heavy imports are inside the verbs, so that --help is instant."""
    words = sorted(path.stem for path in Path(__file__).parent.glob("[a-z]*.py") if path.stem != "main")
    held = {word: vars(import_module(f"lidarsynth.cli.{word}")).get(word) for word in words}
    return {word: verb for word, verb in held.items() if isinstance(verb, FunctionType)}


VERBS = _verbs()


def main(argv: list[str] | None = None) -> None:
    """Run one verb: exits 0, or 2 with one line that says what was expected and what was found."""
    argv = sys.argv[1:] if argv is None else argv
    if argv[:1] == ["--version"]:
        answer(_version)
    else:
        answer(lambda: parsed(VERBS, fields_joined(argv) if argv[:1] == ["train"] else argv)())


def _version() -> None:
    from importlib.metadata import version

    say(f"lidarsynth {version('lidarsynth')}")
