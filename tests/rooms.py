"""The rooms and who knows whom, from the imports: `python tests/rooms.py` draws them into docs/design.md.

`python tests/rooms.py FOLDER` counts rooms and arrows of any checkout's src/lidarsynth.
"""

import ast
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DESIGN = ROOT / "docs" / "design.md"
BEGIN, END = "<!-- drawn by tests/rooms.py -->\n", "<!-- end -->"


def arrows(package: Path) -> dict[str, set[str]]:
    """Room -> the rooms that its files import, in functions too. A file in the root is a room of its own."""
    known: dict[str, set[str]] = {}
    for path in package.rglob("*.py"):
        room = path.relative_to(package).with_suffix("").parts[0]
        if room != "__init__":
            known.setdefault(room, set()).update(_imported(path) - {room})
    return {room: others & known.keys() for room, others in known.items()}


def _imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("lidarsynth.")}


def needed(known: dict[str, set[str]]) -> dict[str, set[str]]:
    """The arrows that no way over other rooms says already."""
    reached: dict[str, set[str]] = {}

    def reach(room: str) -> set[str]:
        if room not in reached:
            reached[room] = known[room].union(*map(reach, known[room]))
        return reached[room]

    return {room: others - set().union(*map(reach, others)) for room, others in known.items()}


def drawing(package: Path) -> str:
    """The graph for docs/design.md: a line of counts and mermaid's code, from the lowest rooms to the highest."""
    known = {room: others for room, others in arrows(package).items() if room != "__main__"}
    drawn = needed(known)
    lines = [f"    {room} --> {other}" for room in sorted(drawn) for other in sorted(drawn[room])]
    counts = f"{len(known)} rooms, {sum(map(len, known.values()))} arrows; {len(lines)} are drawn, the others follow.\n"
    return counts + "\n```mermaid\ngraph BT\n" + "\n".join(lines) + "\n```\n"


def main() -> None:
    if len(sys.argv) > 1:
        known = arrows(Path(sys.argv[1]))
        print(f"{len(known)} rooms, {sum(map(len, known.values()))} arrows")
        return
    before, _, rest = DESIGN.read_text().partition(BEGIN)
    DESIGN.write_text(before + BEGIN + drawing(ROOT / "src" / "lidarsynth") + rest[rest.index(END) :])


if __name__ == "__main__":
    main()
