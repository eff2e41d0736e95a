"""A model as one ONNX file that says what it is (the extra `onnx`)."""

from __future__ import annotations

import copy
import json
import logging
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from lidarsynth.lidar.sensor import Sensor, get_sensor
from lidarsynth.lidar.whole_file import write_whole
from lidarsynth.networks.device import usual_torch
from lidarsynth.networks.running import LONGEST
from lidarsynth.systems.graph import Graph
from lidarsynth.systems.scan_model import ScanModel
from lidarsynth.systems.table import graph_of

OPSET = 18
LEAST = 2  # blocks of columns, where these are open: one alone is narrower than what is put around it


@dataclass(frozen=True)
class Exported:
    """A file that was written.

    inputs, outputs  name -> shape; a number, or `columns` where it is open
    """

    path: Path
    does: str
    opset: int
    sensor: Sensor
    inputs: Mapping[str, tuple[int | str, ...]]
    outputs: Mapping[str, tuple[int | str, ...]]
    says: Mapping[str, str]
    size: int


def export_onnx(model: ScanModel, path: str | Path, sensor: str | None = None, open_columns: bool = False) -> Exported:
    """Write the model as ONNX: completion in one step of a cascade and of conditional models, else a denoising step.

    sensor        of the images, for a model of any sensor; None = the model's own
    open_columns  inputs may have any number of columns, in multiples of 16, from 32 to 4,096

    The file's metadata name the sensor (JSON), what inputs and outputs are, the model and its licence.
    A folder that is not there is made. The model stays as it is, on its device. Raises ValueError for other models, for
    a name without .onnx, for open columns that the sensor's own are none of or before torch 2.7, and where the extra
    `onnx` is missing.
    """
    path = Path(path)
    _check_writable(path)
    model = model if sensor in (None, model.sensor.name) else model.into(get_sensor(sensor))
    with usual_torch():
        graph = graph_of(model, open_columns)
        _check_columns(model.sensor, graph)
        proto = _program(graph)
    shapes = _shapes(proto.graph.input), _shapes(proto.graph.output)
    _describe(proto, model, graph)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, proto.SerializeToString())
    except OSError as error:
        raise ValueError(f"{path}: expected a writable folder with room, found: {error.strerror}") from None
    opset = next(entry.version for entry in proto.opset_import if not entry.domain)
    return Exported(path, graph.does, opset, model.sensor, *shapes, graph.says, path.stat().st_size)


def _check_writable(path: Path) -> None:
    """Raises ValueError, before the minute that it takes, for what is no name of a file to write."""
    if path.suffix.lower() != ".onnx" or path.is_dir():
        found = "a folder" if path.is_dir() else repr(path.name[-20:])
        raise ValueError(f"{path}: expected the name of a file that ends in .onnx, found {found}")
    parent = next(folder for folder in path.absolute().parents if folder.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        found = "a file" if parent.is_file() else "no right"
        raise ValueError(f"{path}: expected a writable folder, found {found} at {parent}")


def _check_columns(sensor: Sensor, graph: Graph) -> None:
    """Raises ValueError for a sensor whose own images a file with open columns would not take, and for a torch that
    writes none."""
    if graph.open_columns and torch.__version__ < "2.7":  # compares as versions do
        raise ValueError(f"expected torch 2.7 or newer for any number of columns, found {torch.__version__}; leave "
                         "--any-columns out")  # fmt: skip
    least = LEAST * graph.multiple
    if graph.open_columns and (sensor.width % graph.multiple or not least <= sensor.width <= LONGEST):
        raise ValueError(f"{sensor.name}: expected a multiple of {graph.multiple} from {least} to {LONGEST} as its own "
                         f"columns for any number of them, found {sensor.width}; leave --any-columns out, or take a "
                         "sensor of another width")  # fmt: skip


def _program(graph: Graph) -> Any:
    """The ONNX model of a graph."""
    try:
        import onnx  # noqa: F401
        from onnxscript import optimizer
    except ImportError:
        raise ValueError("expected the packages onnx and onnxscript; pip install 'lidarsynth[onnx]'") from None
    columns = torch.export.Dim("blocks", min=LEAST, max=LONGEST // graph.multiple) * graph.multiple
    shapes = {name: {3: columns} for name in graph.inputs} if graph.open_columns else None
    module = copy.deepcopy(graph.module).cpu()  # the model's own weights stay where they are
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            module,
            kwargs=dict(graph.inputs),
            dynamo=True,
            optimize=False,  # its rewriting of torch 2.13 leaves names without a node
            opset_version=OPSET,
            input_names=list(graph.inputs),
            output_names=list(graph.outputs),
            dynamic_shapes=shapes,
            verbose=False,
        )
        assert program is not None
        optimizer.fold_constants(program.model)
        optimizer.remove_unused_nodes(program.model)
    return program.model_proto


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's warnings about itself."""
    loggers = {logger: logger.level for logger in map(logging.getLogger, ("torch.onnx", "onnx_ir", "onnxscript"))}
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in loggers.items():
            logger.setLevel(level)


def _shapes(values: Any) -> dict[str, tuple[int | str, ...]]:
    return {v.name: tuple(d.dim_value or "columns" for d in v.type.tensor_type.shape.dim) for v in values}


def _describe(proto: Any, model: ScanModel, graph: Graph) -> None:
    card = model.experiment.card
    facts = {
        "model": model.experiment.name,
        "does": graph.does,
        "sensor": json.dumps(model.sensor.to_dict()),
        "licence": card.licence,
        "data": card.data,
        **{f"about {name}": text for name, text in graph.says.items() if name in (*graph.inputs, *graph.outputs)},
    }
    if graph.open_columns:
        facts["columns"] = f"any multiple of {graph.multiple} from {LEAST * graph.multiple} to {LONGEST}"
    proto.producer_name = "lidarsynth"
    for key, value in facts.items():
        entry = proto.metadata_props.add()
        entry.key, entry.value = key, value
