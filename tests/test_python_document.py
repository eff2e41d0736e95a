"""docs/python.md as a reader walks it: its Python runs, block after block, and its benchmark is read and run."""

from pathlib import Path

import pytest
from test_readme import REPO_ROOT, blocks, street

from lidarsynth.cli.main import main
from lidarsynth.files.formats import write

DOC = REPO_ROOT / "docs" / "python.md"


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIDARSYNTH_CACHE", str(tmp_path / "cache"))
    for name in ("000008.bin", "real/0.bin", "real/1.npz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write(tmp_path / name, street("hdl-64e-kitti"))
    shown = blocks(DOC.read_text())
    namespace: dict[str, object] = {"__name__": "python"}
    for block in (b for b in shown if b.language == "python"):
        exec(compile("\n" * (block.first_line - 1) + "\n".join(block.lines), str(DOC), "exec"), namespace)
    assert namespace["batch"].shape == (2, 2, 64, 1024)  # type: ignore[attr-defined]
    (toml,) = (block for block in shown if block.language == "toml")
    (tmp_path / "mine.toml").write_text("\n".join(toml.lines).replace('["bev-1", "street-2"]', '"bev-1"'))
    main(["benchmark", "generation", "mine.toml", "--out", "out/mine"])
    assert "| mine | 3 |" in capsys.readouterr().out
