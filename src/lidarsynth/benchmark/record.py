"""Everything that a benchmark measured and what with, as JSON."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from lidarsynth.benchmark.config import Generation, Upsampling
from lidarsynth.benchmark.rows import Row
from lidarsynth.benchmark.setup import Setup
from lidarsynth.lidar.small_file import LARGEST_INDEX, read_json

FREE = ("title", "figure", "images", "count", "published")  # may change from run to run of one experiment


def check_same(results: Path, kind: str, config: Upsampling | Generation, replaced: Sequence[str] = ()) -> None:
    """Raises ValueError where results.json has a row of the same name that another experiment made: of another kind,
    question or data, under a protocol that is asked for no more, or with other settings of its own.

    replaced  fields that options gave in place of the file's; these, and those of the run before, may be others
    """
    if not results.exists():
        return
    found = read_json(results, LARGEST_INDEX)
    if not isinstance(found, dict) or not isinstance(found.get("config"), dict):
        raise ValueError(f"{results}: expected the results of a benchmark, found another table; use another --out")
    was, asked = (_decisive(str(word), of) for word, of in ((found.get("benchmark"), found["config"]), (kind, config)))
    if was["kind"] == kind and not any(key.startswith("method") for key in was.keys() & asked.keys()):
        return  # no row of theirs is made again
    free = {*replaced, *found.get("replaced", [])}
    other = [key for key in was if key in asked and key not in free and was[key] != asked[key]]
    if "protocol" in other and set(was["protocol"]) <= set(asked["protocol"]):
        other.remove("protocol")
    for key in other:
        raise ValueError(f"{results.parent}: expected the experiment that it has the results of, with {key} = "
                         f"{was[key]!r:.200}, found {asked[key]!r:.200}; use another --out")  # fmt: skip


def _decisive(kind: str, config: Upsampling | Generation | Mapping[str, Any]) -> dict[str, Any]:
    """What makes an experiment another one, by its words in the file: each row for itself."""
    table = json.loads(json.dumps(config if isinstance(config, Mapping) else asdict(config)))
    methods, protocols = table.pop("method", []), table.pop("protocol", [])
    told = {"kind": kind, "protocol": [protocols] if isinstance(protocols, str) else protocols}
    told |= {key: value for key, value in table.items() if key not in FREE}
    for method in methods:
        row = {key: value for key, value in method.items() if key not in FREE and value is not None}
        several = isinstance(row.get("steps"), list)
        for steps in row["steps"] if several else [row.get("steps")]:
            name = f"method {row.get('name')!r}" + (f" of {steps} steps" if several else "")
            told[name] = row | {"steps": steps}
    return told


def record_of(
    kind: str,
    config: Upsampling | Generation,
    setup: Setup,
    rows: Sequence[Row],
    data: Mapping[str, Any],
    command: str,
    replaced: Sequence[str] = (),
) -> str:
    """results.json: numbers, counts, seeds, seconds, versions, hashes and the command. No infinity, no NaN.

    replaced  as in `check_same`
    """
    models = {
        word: {
            "name": model.experiment.name,
            "fingerprint": setup.fingerprints[word],
            "licence": model.experiment.card.licence,
            "learned from": model.experiment.card.data,
        }
        for word, model in setup.models.items()
    }
    record = {
        "benchmark": kind,
        "title": config.title,
        "command": command,
        "config": asdict(config),
        "replaced": list(replaced),
        "data": data,
        "models": models,
        "methods": [row.to_dict() for row in rows],
        "versions": {
            **{name: version(name) for name in ("lidarsynth", "torch", "numpy")},
            "python": platform.python_version(),
        },
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "device": setup.device,
        },
    }
    return json.dumps(_plain(record), indent=1, allow_nan=False) + "\n"


def processor() -> str:
    """What the processor calls itself, or its kind."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines() if sys.platform == "linux" else []
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
