"""The verb `export`: a model as one ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lidarsynth.cli.arguments import NoSeed, Positional, SensorWord, Source, arg
from lidarsynth.cli.terminal import load_with_bar, say, warn


def export(
    model: Positional[Source],
    out: Annotated[Positional[Path], arg(metavar="OUT.onnx", help="file to write.")],
    sensor: Annotated[SensorWord, arg(help="of the images, for a model of any sensor; default the model's.")] = None,
    any_columns: Annotated[
        bool, arg(help="leave the number of columns open, from 32 on in multiples of 16; of default.")
    ] = False,
    seed: NoSeed = 0,
) -> None:
    """Write a model as ONNX: completion in one step of default, kitti, kitti-streets; of others a denoising step.

    It takes a minute, and needs the extra onnx. To run the file, onnxruntime and numpy are enough: docs/onnx.md.
    """
    from lidarsynth.lidar.sensor import get_sensor
    from lidarsynth.systems.notes import elsewhere
    from lidarsynth.verbs.export import export_onnx

    loaded = load_with_bar(model, "cpu")
    done = export_onnx(loaded, out, sensor, any_columns)
    if sensor is not None and (told := elsewhere(loaded.into(get_sensor(sensor)))):
        warn(f"{model} {told}; export default")
    say(f"wrote {done.path}: {done.does}, {done.sensor.name}, opset {done.opset}, {done.size / 1e6:.1f} MB")
    for name, shape in {**done.inputs, **done.outputs}.items():
        kind = "in " if name in done.inputs else "out"
        what = done.says.get(name.removeprefix("filled_"), "")
        say(f"  {kind} {name:<18} float32 {' x '.join(map(str, shape)):<22} {what}")
