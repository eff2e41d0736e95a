"""What a benchmark has to know of a model beyond what it makes."""

from __future__ import annotations

from lidarsynth.benchmark.config import GenerationMethod, UpsamplingMethod
from lidarsynth.scan_model import ScanModel

# Words of `experiment.Model.network` that are published with range only: where a measure takes more, they are N/A.
WITHOUT_REFLECTANCE = frozenset({"vanilla-gan", "dusty-v1", "dusty-v2", "lidar-sr", "iln", "liif"})


def has_reflectance(model: ScanModel) -> bool:
    """Whether the reflectance of its scans means anything."""
    return model.experiment.model.network not in WITHOUT_REFLECTANCE


def completion_evaluations(model: ScanModel, method: UpsamplingMethod) -> int:
    """Network evaluations per scan. Raises ValueError for what the model cannot do."""
    return model.evaluations(method.method or "auto", method.steps_asked, method.resamples or 10)


def generation_evaluations(model: ScanModel, method: GenerationMethod) -> int:
    """Network evaluations per scan. Raises ValueError for what the model cannot do."""
    steps = model.generation_steps(method.steps_asked, method.sampler)
    return steps * (2 if method.sampler == "heun" else 1)
