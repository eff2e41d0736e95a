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


def record_of(
    kind: str,
    config: Upsampling | Generation,
    setup: Setup,
    rows: Sequence[Row],
    data: Mapping[str, Any],
    command: str,
) -> str:
    """results.json: numbers, counts, seeds, seconds, versions, hashes and the command. No infinity, no NaN."""
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
        lines = Path("/proc/cpuinfo").read_text().splitlines() if sys.platform == "linux" else []
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
