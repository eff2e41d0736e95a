"""Exported files: the same scans as the model's by another program; they say what they are; others are refused."""

import json
import logging
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import lidarsynth as ls
from lidarsynth.cli.main import main
from lidarsynth.experiment.presets import preset
from lidarsynth.experiment.record import Confidence, Data, Experiment, Model, with_fields
from lidarsynth.lidar.corruption import corrupt
from lidarsynth.networks.cascade import Cascade
from lidarsynth.networks.coarse_unet import CoarseUNet
from lidarsynth.networks.fill_unet import FillUNet
from lidarsynth.networks.running import counted
from lidarsynth.streets.reader import SyntheticStreets
from lidarsynth.systems.cascade.gaps import straight_in_gaps
from lidarsynth.systems.cascade.model import CascadeModel
from lidarsynth.systems.filling import Filling
from lidarsynth.systems.table import assemble, build_network, graph_of
from lidarsynth.verbs.export import Exported, export_onnx

ROOT = Path(__file__).resolve().parents[1]
SENSOR = ls.Sensor("small", tuple(np.linspace(5, -25, 20).tolist()), 64, 0.5, 120.0, mount=1.8, dimness=(0.0,) * 20)
WEIGHTS = Confidence(-1.0, -0.5, 0.3, -0.2, -0.1, -0.4, 0.7)
MATES = pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")


def cascade() -> CascadeModel:
    torch.manual_seed(0)
    fill = FillUNet((16, 16), (1, 1))
    torch.nn.init.normal_(fill.out.weight, std=0.02)
    network = Cascade(CoarseUNet(32, (1, 2, 2, 2), 1), fill).eval()
    record = Experiment("test", Data(sensor=SENSOR.to_dict()), Model(network="cascade"), confidence=WEIGHTS)
    return CascadeModel(network, SENSOR, record)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Exported:
    return export_onnx(cascade(), tmp_path_factory.mktemp("onnx") / "fill.onnx", open_columns=True)


def run(path: Path, **inputs: np.ndarray) -> list[np.ndarray]:
    session = MATES.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    return session.run(None, inputs)  # type: ignore[return-value]


@pytest.mark.parametrize("dim", [0, 1, 2, -1])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_the_last_known_place_by_counting_is_the_running_maximum(dim: int, share: float):
    known = torch.rand(3, 17, 33, generator=torch.Generator().manual_seed(1)) < share
    number = torch.arange(known.shape[dim], dtype=torch.int32).view([-1 if i == dim % 3 else 1 for i in range(3)])
    place = torch.where(known, number, -1)
    assert torch.equal(counted(place, dim), place.cummax(dim).values)


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    ("width", "recipe"),
    [(64, "beams:4"), (128, "points:0.2"), (48, "sector:90"), (128, "region:3:9:-3:3"), (32, "beams:2")],
)
def test_the_fill_is_the_models_for_any_number_of_columns(exported: Exported, width: int, recipe: str):
    model = cascade().into(SENSOR.resized(width=width))
    image = SyntheticStreets(3, 1, model.sensor).image(0)
    known = corrupt(image, recipe)
    sparse = image.keep(known)
    arrays = {"range": sparse.range, "reflectance": sparse.reflectance, "known": known.astype(np.float32)}
    found = run(exported.path, **{name: values[None, None] for name, values in arrays.items()})
    filled = model.fill(sparse, known, Filling("conditional", 1))
    parts = [values[0, 0] for values in found]  # in gaps the file leaves surfaces as the network filled them in
    parts[0] = straight_in_gaps(replace(filled, range=parts[0]), known).range
    for values, expected in zip(parts, (filled.range, filled.reflectance, filled.confidence), strict=True):
        np.testing.assert_allclose(values, expected, rtol=1e-4, atol=2e-4)
    np.testing.assert_array_equal(found[0][0, 0][known & sparse.mask], sparse.range[known & sparse.mask])


def test_what_stands_in_pixels_that_are_not_known_says_nothing():
    blocked = replace(SENSOR, blocked=((2, 10, 40), (5, 0, 63)))
    image = SyntheticStreets(3, 1, SENSOR).image(0)
    known = torch.from_numpy(corrupt(image, "beams:4"))[None, None]
    whole = [torch.from_numpy(part)[None, None] for part in (image.range, image.reflectance)]
    told = [torch.where(known, part, 0.0) for part in whole]
    graph = graph_of(cascade().into(blocked)).module
    with torch.no_grad():
        for found, expected in zip(graph(*whole, known.float()), graph(*told, known.float()), strict=True):
            assert torch.equal(found, expected)


def test_a_scan_without_reflectance_is_filled_as_the_model_does():
    model, image = cascade(), SyntheticStreets(3, 1, SENSOR).image(0)
    known = corrupt(image, "beams:4")
    sparse = replace(image, reflectance=np.zeros_like(image.reflectance)).keep(known)
    arrays = [torch.from_numpy(part)[None, None] for part in (sparse.range, sparse.reflectance, known)]
    with torch.no_grad():
        parts = [part[0, 0].numpy() for part in graph_of(model).module(*arrays[:2], arrays[2].float())]
    filled = model.fill(sparse, known, Filling("conditional", 1))
    parts[0] = straight_in_gaps(replace(filled, range=parts[0], mask=parts[0] > 0), known).range
    for values, expected in zip(parts, (filled.range, filled.reflectance, filled.confidence), strict=True):
        np.testing.assert_allclose(values, expected, rtol=1e-4, atol=2e-4)
    assert parts[1][known & sparse.mask].mean() > 0.1


def test_what_the_program_around_has_set_does_not_matter_and_its_model_stays(monkeypatch, tmp_path: Path, caplog):
    model, seen = cascade(), []

    def exporter(module: torch.nn.Module, **_: object) -> None:
        logging.getLogger("onnxscript.optimizer._constant_folding").warning("skips something")
        own = {part.data_ptr() for part in model.network.parameters()}
        shared = any(part.data_ptr() in own for part in module.parameters())
        seen.append((shared, torch.get_default_dtype(), torch.get_default_device().type))
        seen.append(torch.is_autocast_enabled("cpu"))
        raise ZeroDivisionError

    monkeypatch.setattr(torch.onnx, "export", exporter)
    torch.set_default_dtype(torch.float64)
    try:
        with torch.device("meta"), torch.autocast("cpu", torch.bfloat16), pytest.raises(ZeroDivisionError):
            export_onnx(model, tmp_path / "x.onnx")
    finally:
        torch.set_default_dtype(torch.float32)
    assert seen == [(False, torch.float32, "cpu"), False]  # a copy goes to the CPU, not a program's own weights
    assert not caplog.records


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_file_says_what_it_is(exported: Exported):
    import onnx

    proto = onnx.load(str(exported.path))
    onnx.checker.check_model(proto)
    facts = {entry.key: entry.value for entry in proto.metadata_props}
    assert json.loads(facts["sensor"])["elevations"] == list(SENSOR.elevations)
    assert facts["does"] == "completion in one step" and facts["columns"] == "any multiple of 16 from 32 to 4096"
    assert exported.opset == 18 and exported.inputs["range"] == (1, 1, 20, "columns")
    assert list(exported.outputs) == ["filled_range", "filled_reflectance", "confidence"]
    assert [path.name for path in exported.path.parent.iterdir()] == ["fill.onnx"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_conditional_model_completes_and_another_takes_one_step(tmp_path: Path):
    small = {"data.sensor": SENSOR.rows(range(16)).to_dict(), "data.height": 16, "data.width": 64}
    small |= {
        "model.base_channels": 8,
        "model.channel_multipliers": (1, 1, 1, 1),
        "model.num_residual_blocks": (1, 1, 1, 1),
    }
    small |= {"model.gn_num_groups": 4, "model.attn_num_heads": 2, "data.mend": False, "data.projection": "spherical"}
    torch.manual_seed(1)
    experiment = with_fields(preset("kitti-streets"), small | {"model.stem": (1, 1)})
    network = build_network(experiment)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.05)
    model = assemble(experiment, network)
    image = SyntheticStreets(3, 1, model.sensor).image(0)
    known = corrupt(image, "points:0.2")
    sparse = image.keep(known)
    noise = torch.randn(2, 16, 64, generator=torch.Generator().manual_seed(5))[None].numpy()  # that of seed 5
    path = export_onnx(model, tmp_path / "complete.onnx").path
    arrays = {"range": sparse.range, "reflectance": sparse.reflectance, "known": known.astype(np.float32)}
    found = run(path, noise=noise, **{name: values[None, None] for name, values in arrays.items()})
    filled = model.fill(sparse, known, model.resolved(Filling(seed=5)))
    np.testing.assert_allclose(found[0][0, 0], filled.range, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(found[1][0, 0], filled.reflectance, rtol=1e-3, atol=1e-3)


def test_what_cannot_be_exported_is_said_in_a_line(tmp_path: Path):
    with pytest.raises(ValueError, match=r"expected a network of cascade, .* to export, found bilinear"):
        export_onnx(ls.load("bilinear"), tmp_path / "x.onnx")
    with pytest.raises(ValueError, match=r"ends in \.onnx"):
        export_onnx(cascade(), tmp_path / "x.pt")
    tilted = cascade().into(replace(SENSOR, tilt=(1.0, 0.0)))
    with pytest.raises(ValueError, match="without tilt and blocked rays"):
        graph_of(tilted, open_columns=True)
    for width in (16, 100, 4112):  # as Pandar64's 1,800, which are no multiple of 16
        with pytest.raises(
            ValueError, match=f"small: expected a multiple of 16 from 32 to 4096 .*, found {width}; leave"
        ):
            export_onnx(cascade().into(replace(SENSOR, width=width)), tmp_path / "x.onnx", open_columns=True)
    assert list(tmp_path.iterdir()) == []


def test_open_columns_want_a_torch_that_writes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for old in ("2.6.0", "2.6.0+cu124"):
        monkeypatch.setattr(torch, "__version__", type(torch.__version__)(old))
        with pytest.raises(
            ValueError, match=rf"^expected torch 2.7 or newer for any .*, found {re.escape(old)}; leave"
        ):
            export_onnx(cascade(), tmp_path / "x.onnx", open_columns=True)
    assert list(tmp_path.iterdir()) == []


def test_a_model_that_was_tuned_to_another_sensor_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    def written(model: CascadeModel, path: Path, sensor: str | None, _: bool) -> Exported:
        return Exported(path, "completion in one step", 18, ls.get_sensor(sensor or model.sensor), {}, {}, {}, 1)

    monkeypatch.setattr("lidarsynth.verbs.export.export_onnx", written)
    said = []
    for model, *sensor in (("kitti", "--sensor", "vlp-16"), ("kitti",), ("default", "--sensor", "vlp-16")):
        main(["export", model, str(tmp_path / "x.onnx"), *sensor])
        said.append(capsys.readouterr().err)
    assert said == ["lidarsynth: kitti was tuned to hdl-64e-kitti, and vlp-16 is another; export default\n", "", ""]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_folder_of_the_file_is_made_and_what_is_no_file_is_refused_at_once(tmp_path: Path):
    (tmp_path / "x.onnx").mkdir()
    (tmp_path / "file").touch()
    for name, found in (("x.onnx", "that ends in .onnx, found a folder"), ("x.pt", "that ends in .onnx, found 'x.pt'"),
                        ("file/x.onnx", f"a writable folder, found a file at {tmp_path / 'file'}")):  # fmt: skip
        with pytest.raises(ValueError, match=re.escape(found)) as error:
            export_onnx(cascade(), tmp_path / name)
        assert str(error.value).startswith(f"{tmp_path / name}: expected ")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["file", "x.onnx"]
    done = export_onnx(cascade(), tmp_path / "new" / "folder" / "x.onnx")
    assert done.path.stat().st_size == done.size > 0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_example_needs_no_torch(exported: Exported, tmp_path: Path):
    scan = SyntheticStreets(4, 1, SENSOR).image(0).to_scan()
    ls.write(tmp_path / "scan.pcd", replace(scan, ring=None, label=None))
    program = [sys.executable, "-X", "importtime", str(ROOT / "examples" / "onnx_complete.py")]
    done = subprocess.run([*program, str(exported.path), str(tmp_path / "scan.pcd"), str(tmp_path / "dense.npy")],
                          capture_output=True, text=True, env={**os.environ, "OMP_NUM_THREADS": "1"})  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    assert " torch" not in done.stderr and " lidarsynth" not in done.stderr
    dense = np.load(tmp_path / "dense.npy")
    np.testing.assert_array_equal(dense[: len(scan), :3], scan.xyz)
    assert dense.shape[1] == 5 and len(dense) > len(scan)
    filled = cascade().into(SENSOR).complete(scan)
    assert abs(len(dense) - len(filled.to_scan())) < 0.1 * len(filled.to_scan())


STUB = """
import json, numpy as np
from types import SimpleNamespace as N
META = {"sensor": json.dumps({"name": "four", "elevations": [2, 0, -2, -4], "width": 8, "min_range": 1,
                              "max_range": 90}), "does": "completion in one step"}
def InferenceSession(*_, **__):
    filled = lambda _, feed: [np.where(feed["known"] > 0, feed["range"], 10), np.full((1, 1, 4, 8), 0.5)]
    return N(get_modelmeta=lambda: N(custom_metadata_map=META), get_inputs=lambda: [], run=filled)
"""  # of a network that sees 10 m everywhere
BEAMS = np.radians(np.repeat([2.0, 0.0, -2.0, -4.0], 2))


def example(folder: Path, *words: str) -> tuple[int, str]:
    """Exit code and stderr of the example in a folder, where onnxruntime is the one that lies there, if any."""
    program = [sys.executable, str(ROOT / "examples" / "onnx_complete.py"), *words]
    done = subprocess.run(program, capture_output=True, text=True, cwd=folder, timeout=60,
                          env={**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"})  # fmt: skip
    return done.returncode, done.stderr.strip()


def cloud(elevations: np.ndarray = BEAMS, **light: np.ndarray) -> np.ndarray:
    """Eight points 5 m away, two a beam, as a table with a field `intensity`, or others."""
    light = light or {"intensity": np.full(8, 0.25, np.float32)}
    table = np.zeros(8, [(axis, "<f4") for axis in "xyz"] + [(k, v.dtype, v.shape[1:]) for k, v in light.items()])
    table["x"], table["y"] = 5 * np.cos(elevations), 0.5 * np.cos(elevations) * np.tile([1, -1], 4)
    table["z"] = np.hypot(table["x"], table["y"]) * np.tan(elevations)
    for name, values in light.items():
        table[name] = values
    return table


def pcd(table: np.ndarray, size: str = "POINTS 8") -> bytes:
    """The table as a binary .pcd; fields that begin with `_` are padding."""
    fields = {name: table.dtype[name] for name in table.dtype.names or ()}
    rows = {
        "FIELDS": ["_" if name.startswith("_") else name for name in fields],
        "SIZE": [str(dtype.base.itemsize) for dtype in fields.values()],
        "TYPE": [dtype.base.kind.upper() for dtype in fields.values()],
        "COUNT": [str(int(np.prod(dtype.shape))) for dtype in fields.values()],
    }
    head = "".join(f"{key} {' '.join(words)}\n" for key, words in rows.items())
    return f"# .PCD v0.7\n{head}{size}\nDATA binary\n".encode() + table.tobytes()


@pytest.fixture
def stubbed(tmp_path: Path) -> Path:
    (tmp_path / "onnxruntime.py").write_text(STUB)
    (tmp_path / "x.onnx").touch()
    return tmp_path


SHADES = np.arange(8)


@pytest.mark.parametrize(("table", "size", "shade"), [
    (cloud(normal=np.full((8, 3), 7, "<f4"), intensity=SHADES.astype("<f4") / 10), "POINTS 8", SHADES / 10),
    (cloud(_1=np.full((8, 4), 9, "u1"), intensity=SHADES.astype("<f4") / 10, _2=np.zeros((8, 12), "u1")), "POINTS 8",
     SHADES / 10),
    (cloud(intensity=SHADES.astype("<f4"), timestamp=np.full(8, 2**60, "<u8")), "WIDTH 4\nHEIGHT 2", SHADES / 255),
    (cloud(intensity=(SHADES / 7).astype("u1")), "POINTS 8", (SHADES == 7) / 255),
    (cloud(intensity=SHADES.astype("u1")), "POINTS 8", SHADES / 255),
    (cloud(intensity=(SHADES * 9000).astype("<u2")), "POINTS 8", SHADES * 9000 / 65535),
    (cloud(intensity=np.where(SHADES == 3, np.nan, 0.5).astype("<f4")), "POINTS 8", (SHADES != 3) / 2),
])  # fmt: skip
def test_the_example_reads_what_the_header_says(stubbed: Path, table: np.ndarray, size: str, shade: np.ndarray):
    (stubbed / "scan.pcd").write_bytes(pcd(table, size))
    assert example(stubbed, "x.onnx", "scan.pcd", "d.npy") == (0, "")
    dense = np.load(stubbed / "d.npy")
    np.testing.assert_array_equal(dense[:8, :3], np.stack([table[axis] for axis in "xyz"], 1))
    np.testing.assert_allclose(dense[:8, 3], shade, rtol=1e-6)
    assert len(dense) == 32  # of 4 x 8 pixels the points are in one each
    np.testing.assert_allclose(np.linalg.norm(dense[8:, :3], axis=1), 10, rtol=1e-6)


def test_the_example_takes_no_other_sensor_s_scan_for_its_own(stubbed: Path):
    (stubbed / "scan.pcd").write_bytes(pcd(cloud(np.radians(np.repeat([2.0, 0.0, -2.0, -9.0], 2)))))
    said = "scan.pcd: expected a scan of four, found 25% of the points a step off all its beams"
    assert example(stubbed, "x.onnx", "scan.pcd", "d.npy") == (2, said) and not (stubbed / "d.npy").exists()
    (stubbed / "scan.pcd").write_bytes(pcd(cloud(np.radians(np.linspace(2.0, -4.0, 8)))))
    code, said = example(stubbed, "x.onnx", "scan.pcd", "d.npy")
    assert code == 0 and said.endswith("if another sensor took them, the new points are wrong")


def test_the_example_refuses_targets_that_it_would_not_write(stubbed: Path):
    (stubbed / "scan.pcd").write_bytes(pcd(cloud()))
    for target, told in (("out.bin", "a file that ends in .npy, found another"),
                         ("no/d.npy", "a folder to write into, found none")):  # fmt: skip
        assert example(stubbed, "x.onnx", "scan.pcd", target) == (2, f"{target}: expected {told}")
    assert sorted(path.name for path in stubbed.iterdir() if path.is_file()) == ["onnxruntime.py", "scan.pcd", "x.onnx"]
    assert example(stubbed)[0] == 2


def test_the_example_refuses_what_is_no_network_in_one_line(tmp_path: Path):
    for name in ("x.onnx", "scan.pcd"):
        (tmp_path / name).write_bytes(b"no network")
    said = "x.onnx: expected a file of `lidarsynth export`, found another or a damaged one"
    assert example(tmp_path, "x.onnx", "scan.pcd", "d.npy") == (2, said)


def test_the_example_refuses_what_is_no_binary_cloud_in_one_line(stubbed: Path):
    head = (
        "VERSION .7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\n"
    )
    kind, other = "a .pcd with DATA binary, found", head.replace("intensity", "i")
    header = "FIELDS, SIZE, TYPE, COUNT and POINTS of a .pcd, found"
    for content, told in ((f"{head}DATA binary_compressed\n0000", f"{kind} binary_compressed"),
                          (f"{head}DATA ascii\n1 2 3 0\n", f"{kind} ascii"), (head, f"{kind} no DATA"),
                          ("", f"{kind} no DATA"), ("\x89PNG\x00\xff", f"{kind} no DATA"),
                          (f"{head}DATA binary\n0000", "1 points of 16 bytes, found 4 bytes"),
                          (f"{head}DATA binary\n{'0' * 32}", "1 points of 16 bytes, found 32 bytes"),
                          (f"{other}DATA binary\n{'0' * 16}", "the fields x y z intensity, found no intensity"),
                          (f"{head}DATA binary\n{chr(0) * 16}", "points with a return, found none of 1 points"),
                          (f"{head.replace('POINTS 1', 'POINTS 0')}DATA binary\n",
                           "points with a return, found none of 0 points"),
                          (f"{head.replace('F F F F', 'F F F X')}DATA binary\n", f"{header} TYPE and SIZE X4"),
                          (f"{head.replace('FIELDS', '#')}DATA binary\n", f"{header} no FIELDS"),
                          ("FIELDS x\nSIZE 4\nTYPE F\nDATA binary\n", f"{header} no WIDTH"),
                          ):  # fmt: skip
        (stubbed / "scan.pcd").write_text(content, "latin-1")
        code, said = example(stubbed, "x.onnx", "scan.pcd", "d.npy")
        assert (code, said) == (2, f"scan.pcd: expected {told}") and not (stubbed / "d.npy").exists()
