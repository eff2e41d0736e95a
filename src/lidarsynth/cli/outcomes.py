"""What is said of the scans of verbs that take many, such as `complete` and `label`: one by one, and of all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from lidarsynth.cli.terminal import say, warn
from lidarsynth.lidar.plural import plural, was

if TYPE_CHECKING:
    from lidarsynth.verbs.batch import Result

NAMED = 5  # failures, and files, that are named one by one


def tell(result: Result) -> None:
    """What became of a scan that did not fail, in a line for each thing to be said."""
    from lidarsynth.files.fields import dropped_points

    if result.dropped:
        say(f"{result.source}: {dropped_points(result.dropped)}, {result.points[0]} stay")
    if result.warning:
        warn(result.warning)
    if result.note:
        say(f"{result.source}: {result.note}")
    if result.target is not None:
        beside = f", with {', '.join(result.beside)} beside it" if result.beside else ""
        say(f"wrote {result.target}" + (f" and {result.picture}" if result.picture else "") + beside)


def tell_of_many(result: Result, each: bool, number: int) -> None:
    """A line per scan where they are few; of many only warnings and failures, and of those the first few."""
    if result.error is not None:
        if number > 1:  # the first is kept until it is known whether all fail
            warn(named_failure(result))
    elif each:
        tell(result)
    elif result.warning and number <= NAMED:
        warn(result.warning)


def say_summary(results: list[Result], skipped: int, seconds: float, where: Path) -> None:
    """A line about all scans, under that of the first one, if it failed."""
    failed = [result for result in results if result.error is not None]
    if failed and failed[0] is results[0]:
        warn(named_failure(failed[0]))
    done = len(results) - len(failed)
    text = f"{plural(done, 'scan')} in {seconds:.1f} s"
    text += f", {done / seconds:.1f} a second" if done and seconds > 1 else ""
    text += f"; {skipped} {was(skipped)} there already" if skipped else "" if results else "; there was none to read"
    text += f"; {len(failed)} failed: {', '.join(result.name for result in failed[:NAMED])}" if failed else ""
    text += ", ..." if len(failed) > NAMED else ""
    say(f"{text}; see {where}")


def named_failure(result: Result) -> str:
    """A failure with the file that it is of, and which message or turn of one that holds many."""
    text, name = str(result.error).removeprefix(f"{result.source}: "), Path(result.name).name
    one_of_many = not result.source.name.startswith(name) and name not in text
    return text if str(result.source) in text else f"{result.source}: {f'{name}: ' if one_of_many else ''}{text}"


def check_any(merged: Path) -> None:
    """Raises ValueError where the report of all shards tells that every scan failed."""
    from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json

    report = read_json(merged, LARGEST_INDEX)
    if report["failed"] and not report["done"] + report["skipped"]:
        raise ValueError(f"{merged}: expected scans, found all {report['failed']} of {report['settings']['shards']} "
                         "shards broken")  # fmt: skip


def refuse_all(failed: list[Result]) -> NoReturn:
    """Raises ValueError that names the first of the scans, which all failed."""
    first = named_failure(failed[0])
    raise ValueError(
        first if len(failed) == 1 else f"expected scans, found all {len(failed)} broken; the first: {first}"
    )
