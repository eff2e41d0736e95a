"""What a benchmark has to know of a model beyond what it makes."""

from __future__ import annotations

from lidarsynth.benchmark.config import GenerationMethod, UpsamplingMethod
from lidarsynth.systems.scan_model import ScanModel


def has_reflectance(model: ScanModel) -> bool:
    """Whether the reflectance of its scans means anything."""
    return model.experiment.data.reflectance


def completion_evaluations(model: ScanModel, method: UpsamplingMethod) -> int:
    """Network evaluations per scan. Raises ValueError for what the model cannot do."""
    return model.evaluations(method.method or "auto", method.steps_asked, method.resamples, method.sampler)


def generation_evaluations(model: ScanModel, method: GenerationMethod) -> int:
    """Network evaluations per scan. Raises ValueError for what the model cannot do."""
    steps = model.generation_steps(method.steps_asked, method.sampler)
    return steps * (2 if method.sampler == "heun" else 1)
