"""docs/metrics.md as a reader walks it: its commands and its Python run, and its tables name what exists."""

import re
from pathlib import Path

import pytest
from test_evaluate import REAL, STREETS, saved
from test_readme import REPO_ROOT, blocks, commands

from lidarsynth.cli.main import main
from lidarsynth.evaluation import accumulation
from lidarsynth.evaluation.protocols import PROTOCOLS

DOC = REPO_ROOT / "docs" / "metrics.md"
TEXT = DOC.read_text()


def test_the_document_names_every_protocol_and_its_rows():
    table = TEXT.partition("## Protocols")[2].partition("\n| number |")[0]
    named = dict(re.findall(r"^\| `([\w-]+)`[^|]*\| ([^|]+) \|", table, re.MULTILINE))
    assert named.keys() == PROTOCOLS.keys()
    for name, rows in named.items():
        for word in ("FRD", "FPD", "KPD", "JSD", "MMD", "COV", "1-NNA", "IoU"):
            has = any(row.name.split(" x")[0].split()[-1] == word or row.name == word for row in PROTOCOLS[name].rows)
            assert has == (word in rows), f"{name}: {word}"
    for folder, file in re.findall(r"\]\((\.\./src/lidarsynth/metrics)/(\w+\.py)\)", TEXT):
        assert (DOC.parent / folder / file).is_file()


def test_commands_and_python_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(accumulation, "URLS", {})
    saved(tmp_path / "out", STREETS)
    saved(tmp_path / "real", REAL)
    said = []
    shown = [block for block in blocks(TEXT) if block.run]
    for words in (c for b in shown if b.language == "bash" for c in commands(b)):
        main(words[1:])
        said.append(capsys.readouterr().out)
    tables = [text.partition("\n")[2].partition("wrote")[0] for text in said if text.startswith("bev-1")]
    assert len(tables) == 3 and len(set(tables)) == 1, "images, shared statistics and merged halves score the same"
    (python,) = (block for block in shown if block.language == "python")
    exec(compile("\n".join(python.lines), str(DOC), "exec"), {})
    out = capsys.readouterr().out
    assert f"{float(out.split()[0]):.3f}" in tables[0] and "precision=" in out and "hausdorff=" in out
