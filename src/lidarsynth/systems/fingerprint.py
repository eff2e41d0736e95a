"""What decides the scans that a model makes, as a few digits."""

from __future__ import annotations

import json
from hashlib import blake2b
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # `project` of many scans needs no torch
    from lidarsynth.systems.scan_model import ScanModel


def fingerprint(model: ScanModel) -> str:
    """16 hex digits of what decides the scans: sensor, network and diffusion settings, and every weight."""
    record = model.experiment.to_dict()
    settings = {part: values for part, values in record.items() if part not in ("name", "training", "card")}
    digest = blake2b(json.dumps(settings, sort_keys=True).encode(), digest_size=8)
    for name, tensor in sorted(model.network.state_dict().items()):
        digest.update(name.encode() + tensor.cpu().numpy().tobytes())
    return digest.hexdigest()
