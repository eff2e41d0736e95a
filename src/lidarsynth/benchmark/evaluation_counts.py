"""How often a model evaluates its network for one scan, the cost that the papers compare."""

from __future__ import annotations

from lidarsynth.benchmark.config import GenerationMethod, UpsamplingMethod
from lidarsynth.systems.scan_model import ScanModel


def completion_evaluations(model: ScanModel, method: UpsamplingMethod) -> int:
    """Network evaluations per scan. Raises ValueError for what the model cannot do."""
    return model.evaluations(method.method or "auto", method.steps_asked, method.resamples, method.sampler)


def generation_evaluations(model: ScanModel, method: GenerationMethod) -> int:
    """Network evaluations per scan. Raises ValueError for what the model cannot do."""
    steps = model.generation_steps(method.steps_asked, method.sampler)
    return steps * (2 if method.sampler == "heun" else 1)
