"""README.md is a promise: its commands and its Python are run here, at small scale, one after the other as printed.

The convention, for whoever writes the README:
- in ```bash blocks every line that starts with `lidarsynth ` is run; `make` lines must name targets of the Makefile;
  other lines (git clone, pip install) are not run;
- ```python blocks are run in one namespace, after the commands;
- a block under the comment `<!-- not run -->` is only checked for verbs that exist;
- the folder holds scan.bin, 000008.bin (64 beams) and vlp16.pcd (16 beams); files that a command writes are there for
  the next;
- scale: see SMALLER; `demo`, `view` and `train` have tests of their own.
"""

import ast
import json
import re
import shlex
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch

from lidarsynth.cli.main import VERBS, main
from lidarsynth.experiment.presets import preset
from lidarsynth.files.formats import write
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import SENSORS
from lidarsynth.systems.table import build_network

REPO_ROOT = Path(__file__).resolve().parents[1]
README = REPO_ROOT / "README.md"
SMALLER = ((r"-n +\d+", "-n 1"), (r"--steps +\d+", "--steps 2"))  # in commands
FEW_STEPS = {"generate"}  # verbs and methods that are given two steps
ELSEWHERE = {"demo", "view", "train"}  # minutes, or endless: tests of their own


class Block(NamedTuple):
    language: str
    lines: list[str]
    run: bool
    first_line: int


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a Markdown text; `run` is False under the comment `<!-- not run -->`."""
    found: list[Block] = []
    inside, last = None, ""
    for number, line in enumerate(text.splitlines(), 1):
        if inside is not None:
            if line.strip() == "```":
                inside = None
            else:
                inside.append(line)
        elif match := re.fullmatch(r"```(\w*).*", line.strip()):
            inside = []
            found.append(Block(match[1], inside, last != "<!-- not run -->", number + 1))
            last = ""
        elif line.strip():
            last = line.strip()
    return found


def commands(block: Block) -> list[list[str]]:
    """The command lines of a block as words: continuation lines joined, comments and `$ ` prompts taken away."""
    joined = "\n".join(block.lines).replace("\\\n", " ").splitlines()
    words = [shlex.split(line.strip().removeprefix("$ "), comments=True) for line in joined]
    return [w for w in words if w]


def smaller(words: list[str]) -> list[str]:
    """The command at small scale: one scan, two steps."""
    line = shlex.join(words)
    for pattern, replacement in SMALLER:
        line = re.sub(pattern, replacement, line)
    words = shlex.split(line)
    return [*words, "--steps", "2"] if words[1] in FEW_STEPS and "--steps" not in words else words


class TwoSteps(ast.NodeTransformer):
    """Gives `steps=2` to every call of a method in FEW_STEPS."""

    def visit_Call(self, node: ast.Call) -> ast.Call:
        self.generic_visit(node)
        if isinstance(node.func, ast.Attribute) and node.func.attr in FEW_STEPS:
            others = [k for k in node.keywords if k.arg != "steps"]
            node.keywords = [*others, ast.keyword("steps", ast.Constant(2))]
        return node


def street(name: str) -> RangeImage:
    """A road between two walls, 16 m apart, as a sensor sees it without noise."""
    sensor = SENSORS[name]
    rays = sensor.directions()
    with np.errstate(divide="ignore"):
        road = np.where(rays[..., 2] < 0, -sensor.mount / rays[..., 2], np.inf)
        wall = 8 / np.abs(rays[..., 1])
    distance = np.minimum(road, wall)
    top = (wall < road) & (wall * rays[..., 2] > 6)
    mask = (distance < sensor.max_range) & (distance > sensor.min_range) & ~top
    reflectance = np.where(wall < road, 0.4, 0.2).astype(np.float32)
    return RangeImage(np.where(mask, distance, 0).astype(np.float32), reflectance * mask, mask, sensor)


def test_the_numbers_are_those_of_the_models_and_their_cards():
    text = README.read_text()
    results = {name: " ".join(shipped(name)["card"]["results"]) for name in ("default", "kitti", "kitti-streets")}
    for name, said in results.items():
        (metres, reflectance) = re.findall(rf"^\| `{name}` \| ([\d.]+ m) \| ([\d.]+) \|$", text, re.M)[0]
        assert f"every fourth beam known {metres}, {reflectance}" in said, name
        assert f"--model {name} " in said or name == "default", "the command names the model"
        for line in re.findall(r"^\| bilinear \| ([\d.]+ m) \| ([\d.]+) \|$", text, re.M):
            assert f"bilinear {', '.join(line)}" in said, name
    (score,) = re.findall(r"an FRD\s+of ([\d.]+)", text)
    assert f"FRD {score}," in results["default"]
    shares = re.search(r"against the best interpolation .* \| (\d+) to (\d+) % less", text)
    assert shares and f"range {shares[1]} to {shares[2]} % below" in results["default"]
    with torch.device("meta"):
        count = sum(p.numel() for p in build_network(preset("r2dm-h")).parameters())
    assert f"R2DM's network, {count:,} parameters" in text
    assert len(SENSORS) == 8 and "limits of eight sensors" in text


def shipped(name: str) -> dict:
    path = REPO_ROOT / "src" / "lidarsynth" / "shipped" / name / "experiment.json"
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the README's reader stands: a folder with scans of their own."""
    folder = tmp_path_factory.mktemp("readme")
    for name in ("scan.bin", "000008.bin"):
        write(folder / name, street("hdl-64e").to_scan())
    write(folder / "vlp16.pcd", street("vlp-16").to_scan())
    return folder


def test_blocks_are_found_and_scaled():
    shell = "```bash\nmake demo\n$ lidarsynth generate -n 40 \\\n  --out o  # four\n```\n"
    text = shell + "<!-- not run -->\n\n```python\nx\n```\n"
    bash, python = blocks(text)
    assert (bash.language, bash.run, python.language, python.run) == ("bash", True, "python", False)
    assert commands(bash) == [["make", "demo"], ["lidarsynth", "generate", "-n", "40", "--out", "o"]]
    assert smaller(commands(bash)[1]) == ["lidarsynth", "generate", "-n", "1", "--out", "o", "--steps", "2"]
    tree = TwoSteps().visit(ast.parse("m.generate(4, steps=32, seed=0)"))
    assert ast.unparse(ast.fix_missing_locations(tree)) == "m.generate(4, seed=0, steps=2)"


def test_readme_shows_both_ways_in():
    shown = blocks(README.read_text())
    lines = [c for b in shown if b.language == "bash" for c in commands(b)]
    assert ["make", "demo"] in lines and ["make", "test"] in lines
    assert sum(c[0] == "lidarsynth" for b in shown if b.run and b.language == "bash" for c in commands(b)) >= 2
    assert sum(len(b.lines) for b in shown if b.run and b.language == "python") >= 5


def test_readme_names_only_targets_and_verbs_that_exist():
    lines = [c for b in blocks(README.read_text()) if b.language == "bash" for c in commands(b)]
    targets = set(re.findall(r"^([a-z]+):", (REPO_ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {word for c in lines if c[0] == "make" for word in c[1:]} <= targets
    verbs = {c[1] for c in lines if c[0] == "lidarsynth" and not c[1].startswith("-")}
    assert verbs <= set(VERBS)


def test_readme_commands_and_python_run(folder: Path, monkeypatch: pytest.MonkeyPatch):
    shown = [block for block in blocks(README.read_text()) if block.run]
    monkeypatch.chdir(folder)
    for words in (c for b in shown if b.language == "bash" for c in commands(b)):
        if words[0] != "lidarsynth" or words[1] in ELSEWHERE:
            continue
        main(smaller(words)[1:])
    namespace: dict[str, object] = {"__name__": "readme"}
    for block in (b for b in shown if b.language == "python"):
        tree = ast.fix_missing_locations(TwoSteps().visit(ast.parse("\n".join(block.lines))))
        ast.increment_lineno(tree, block.first_line - 1)  # a traceback then shows the README's own line
        exec(compile(tree, str(README), "exec"), namespace)
