"""docs/design.md and docs/changes.md are true: rooms, places, and the code that a user's file would hold."""

import os
import re
import runpy
from pathlib import Path

import pytest
import rooms
from forked import Forked
from test_house import ROOMS

ROOT = Path(__file__).resolve().parents[1]
DESIGN = (ROOT / "docs" / "design.md").read_text()
SRC = ROOT / "src" / "lidarsynth"


def test_the_rooms_of_the_map_are_those_of_the_test():
    listed = re.findall(r"^([a-z]+)/ {2,}", DESIGN, re.M)
    assert tuple(listed) == ROOMS[: len(listed)] and set(ROOMS) - set(listed) == {"__main__"}
    there = {path.name for path in SRC.iterdir() if path.is_dir() and path.name not in ("__pycache__", "shipped")}
    assert there <= set(listed)


def test_the_picture_of_the_rooms_is_what_the_files_import():
    assert rooms.drawing(SRC) in DESIGN, "python tests/rooms.py draws it"


def test_every_place_that_is_named_is_there():
    places = re.findall(r"\]\((\.\./[^)]+)\)", DESIGN)
    assert len(places) > 10
    assert [place for place in places if not (ROOT / "docs" / place).exists()] == []


@pytest.mark.parametrize(
    ("table", "file"),
    [("STEPS", "diffusion/samplers.py"), ("READERS", "files/formats.py"), ("WRITERS", "files/formats.py"),
     ("SOURCES", "data/sources.py"), ("SENSORS", "lidar/sensor.py"), ("PRESETS", "experiment/presets.py"),
     ("SYSTEMS", "systems/table.py"), ("MEASURES", "evaluation/measures.py"),
     ("PROTOCOLS", "evaluation/protocols.py")],
)  # fmt: skip
def test_every_table_is_a_dict_where_the_map_says(table: str, file: str):
    assert f"`{table}`" in DESIGN
    assert re.search(rf"^{table}(: [^=]*)? = {{", (SRC / file).read_text(), re.M)


def test_texts_name_documents_that_are_there():
    made = {"report.md", "table.md", "README.md"}  # by the program
    for path in [*ROOT.glob("src/**/*.py"), *ROOT.glob("benchmarks/*.py"), *ROOT.glob("docs/**/*.md")]:
        for name in re.findall(r"[\w/.-]+\.md\b", path.read_text()):
            there = any((base / name).exists() for base in (ROOT, ROOT / "docs", path.parent))
            assert there or Path(name).name in made, f"{path}: {name}"


def test_each_concept_of_the_readme_is_in_its_file():
    text = (ROOT / "README.md").read_text()
    rows = re.findall(r"^\| (.+?) \| (\[.+\)) \|$", text[: text.index("## Use it")], re.M)
    assert len(rows) >= 15
    for concept, links in rows:
        paths = [ROOT / target for target in re.findall(r"\]\(([^)]+)\)", links)]
        assert all(path.exists() for path in paths), concept
        if paths[0].is_file():
            words = re.findall(r"`(\w+)`", concept)
            assert [word for word in words if word not in paths[0].read_text()] == [], concept


def test_what_moved_is_where_the_list_says():
    lines = (ROOT / "docs" / "changes.md").read_text().splitlines()
    cells = [line.split("|")[2] for line in lines if line.count("|") == 3]
    named = [name for cell in cells for name in re.findall(r"`lidarsynth\.([a-z_.]+)`", cell)]
    assert len(named) >= 15
    for name in named:
        path = SRC / name.replace(".", "/")
        there = path.is_dir() or any(p.with_suffix(".py").exists() for p in (path, path.parent))
        assert there, name


@pytest.mark.slow
def test_tables_are_added_to_from_outside(tmp_path: Path):
    """In a process of its own, as a user's file: tables of this one stay as they are."""
    (code,) = re.findall(r"```python\n(.*?)```", DESIGN, re.S)
    (tmp_path / "mine.py").write_text(code + "print(again.sensor.name, int(again.mask.sum()) > 1000, report)\n")
    done = Forked(tmp_path, run=_users_file)
    said, errors = done.communicate()
    assert done.returncode == 0, errors
    assert said.split()[:2] == ["mine", "True"]
    assert re.search(r"mine-1 v1.*cells +0\.0\d", said, re.S), said


def _users_file(words: list[str]) -> None:
    os.chdir(words[0])
    runpy.run_path("mine.py", run_name="__main__")
