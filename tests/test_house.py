"""The house rules of docs/design.md as tests: who imports whom, how long, how named, how loud, how light."""

import ast
import contextlib
import importlib
import resource
import statistics
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

import lidarsynth

Node = TypeVar("Node", bound=ast.AST)
PACKAGE = Path(lidarsynth.__file__).parent
REPO_ROOT = Path(__file__).resolve().parents[1]
FILES = sorted(PACKAGE.rglob("*.py"))
CODE = [path for path in FILES if path.name != "__init__.py"]
# A room may know the rooms above it in this list, never those below; the root's files come last.
ROOMS = (
    "lidar",  # Scan, RangeImage, Sensor, projection, depth codes, corruption, recognition, SemanticKITTI classes
    "diffusion",  # mathematics: schedule, denoiser, samplers, langevin, repaint
    "experiment",  # the record, presets, what a folder on disk holds
    "pictures",  # colours, strips, perspective, figures
    "files",  # one scan file in or out
    "streets",  # synthetic streets
    "data",  # data sets, caches
    "metrics",  # numbers on arrays
    "networks",  # torch modules
    "training",  # loop, task, checkpoint, journal; knows no system
    "systems",  # one folder per family: its build, model, task, official files, card
    "weights",  # load, shipped, download
    "evaluation",  # protocols, statistics, image sets, report
    "benchmark",  # models x protocols
    "verbs",  # what each verb does, callable from Python
    "viewer",  # server and static files
    "cli",  # one file a verb: arguments, printing
    "__main__",
)
CORE = {
    "torch",
    "numpy",
    "einops",
    "safetensors",
    "tyro",
    "tqdm",
    "PIL",
    "platformdirs",
    "tomli",
}  # pyproject
VAGUE = {"utils", "util", "helpers", "helper", "common", "misc", "base", "tools"}
PURE = {"experiment/record", "experiment/presets", "experiment/upsampling_presets"}  # no torch, no numpy, no lidar
SPEAKERS = {"cli/terminal.py", "__main__.py"}  # the only ones that print and set the exit code


def module_name(path: Path) -> str:
    return ".".join(("lidarsynth", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__")


def part(name: str) -> str:
    """The room a module lies in: lidarsynth.lidar.scan -> lidar."""
    return name.split(".")[1]


def short(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(), str(path))


@cache
def nodes(path: Path, kind: type[Node]) -> list[Node]:
    """All of a kind in a file, however deep."""
    return _by_kind(path).get(kind, [])  # type: ignore[return-value]


@cache
def _by_kind(path: Path) -> dict[type[ast.AST], list[ast.AST]]:
    found: dict[type[ast.AST], list[ast.AST]] = {}
    for node in ast.walk(tree(path)):
        found.setdefault(type(node), []).append(node)
    return found


MODULES = {module_name(path): path for path in FILES}


@cache
def imported(path: Path, everywhere: bool = True) -> set[str]:
    """Full names of what a file imports, in its functions too where `everywhere`: modules, and names in modules."""
    names: set[str] = set()
    inside = [*nodes(path, ast.Import), *nodes(path, ast.ImportFrom)]
    for node in inside if everywhere else tree(path).body:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{short(path)}:{node.lineno}: imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


@cache
def imported_modules(path: Path) -> set[str]:
    """The lidarsynth modules a file imports; `from lidarsynth.lidar import sensor` is lidarsynth.lidar.sensor."""
    ours = {name for name in imported(path) if name.split(".")[0] == "lidarsynth"}
    return {name if name in MODULES else name.rpartition(".")[0] for name in ours} - {module_name(path)}


@cache
def functions(path: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [*nodes(path, ast.FunctionDef), *nodes(path, ast.AsyncFunctionDef)]


@cache
def calls(path: Path) -> list[tuple[str, ast.Call]]:
    return [(ast.unparse(node.func), node) for node in nodes(path, ast.Call)]


def of_every(paths: list[Path]) -> Callable[[Callable[[Path], None]], Callable[[], None]]:
    """A rule for one file as one test of all of them, which names every file that breaks it."""

    def decorate(rule: Callable[[Path], None]) -> Callable[[], None]:
        def test() -> None:
            broken = []
            for path in paths:
                try:
                    rule(path)
                except AssertionError as error:
                    broken.append(str(error))
            assert not broken, "\n".join(broken)

        test.__name__ = rule.__name__
        return test

    return decorate


@of_every(CODE)
def test_a_room_knows_only_the_rooms_above_it(path: Path):
    own = part(module_name(path))
    assert own in ROOMS, f"{short(path)} is in no room of docs/design.md"
    above = ROOMS[: ROOMS.index(own)]
    others = {part(name) for name in imported_modules(path) if name != "lidarsynth"} - {own}
    assert others <= set(above), f"{short(path)} in {own} imports {sorted(others - set(above))}, rooms below its own"


@of_every(CODE)
def test_no_submodule_imports_the_root_or_private_names(path: Path):
    assert "lidarsynth" not in imported_modules(path), "the root imports the parts, never the other way round"
    private = {n for n in imported(path) if n.startswith("lidarsynth") and n.rpartition(".")[2].startswith("_")}
    assert private <= {"lidarsynth.__main__"}, f"{short(path)} takes private names of another module: {private}"


def test_there_is_no_import_cycle():
    graph = {name: imported_modules(path) for name, path in MODULES.items() if name != "lidarsynth"}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"import cycle: {' -> '.join(error.args[1])}")


def test_sub_package_inits_are_empty():
    full = [short(p) for p in FILES if p.name == "__init__.py" and p.parent != PACKAGE and p.read_text().strip()]
    assert full == []
    bare = {p.parent for p in CODE} - {p.parent for p in FILES if p.name == "__init__.py"}
    assert not bare, f"folders without __init__.py: {bare}"


@of_every(CODE)
def test_optional_packages_are_imported_where_they_are_used(path: Path):
    top = {name.split(".")[0] for name in imported(path, everywhere=False)}
    foreign = top - CORE - {"lidarsynth"} - sys.stdlib_module_names
    assert not foreign, (
        f"{short(path)} imports {sorted(foreign)} at its top: only {sorted(CORE)} come with every install"
    )


@of_every(FILES)
def test_files_and_functions_are_short(path: Path):
    lines = path.read_text().splitlines()
    assert len(lines) <= 400, f"{short(path)} has {len(lines)} lines"
    long = {f.name: n for f in functions(path) if (n := (f.end_lineno or 0) - f.lineno + 1) > 60}
    assert not long, f"{short(path)}: functions over 60 lines: {long}"


def test_modules_are_named_by_what_they_hold():
    assert not [short(p) for p in FILES if VAGUE & set(p.relative_to(PACKAGE).with_suffix("").parts)]


@of_every([p for p in CODE if short(p) not in SPEAKERS])
def test_the_library_never_prints_and_never_exits(path: Path):
    loud = {"print", "exit", "quit", "sys.exit", "os._exit", "sys.stdout.write", "sys.stderr.write"}
    found = [f"{name} in line {node.lineno}" for name, node in calls(path) if name in loud]
    raised = [node for node in nodes(path, ast.Raise) if isinstance(node.exc, ast.Call | ast.Name)]
    exits = [n for n in raised if ast.unparse(n.exc.func if isinstance(n.exc, ast.Call) else n.exc) == "SystemExit"]
    found += [f"SystemExit in line {node.lineno}" for node in exits]
    assert not found, f"{short(path)}: {found}"


@of_every(CODE)
def test_code_of_others_is_never_loaded(path: Path):
    for name, node in calls(path):
        options = {k.arg: ast.unparse(k.value) for k in node.keywords}
        where = f"{short(path)}:{node.lineno}"
        assert name != "torch.load" or options.get("weights_only") == "True", f"{where}: weights_only=True is missing"
        assert options.get("allow_pickle", "False") == "False", f"{where}: allow_pickle"
        assert name not in {"eval", "exec", "compile", "__import__"}, f"{where}: {name}"
    pickles = {"pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve"}
    assert not pickles & {name.split(".")[0] for name in imported(path)}
    assert "torch.load" not in imported(path), "write torch.load in full, so that this test sees it"


@of_every(CODE)
def test_text_names_its_encoding(path: Path):
    for name, node in calls(path):
        method, words = name.rpartition(".")[2], {k.arg for k in node.keywords}
        modes = {a.value for a in node.args if isinstance(a, ast.Constant)} & {"r", "w", "a", "x", "r+", "w+", "a+"}
        whole = method in {"read_text", "write_text"} and name != method  # read_text alone is our own, of UTF-8
        text = whole or (method == "open" and modes and name != "archive.open")  # the last of a zip, in bytes
        assert not text or "encoding" in words, f"{short(path)}:{node.lineno}: Windows and LC_ALL=C have their own"


@of_every(CODE)
def test_no_duck_typing_hidden_signatures_or_global_randomness(path: Path):
    for name, node in calls(path):
        assert name != "hasattr", f"{short(path)}:{node.lineno}: hasattr"
        assert name not in {"torch.manual_seed", "np.random.seed", "random.seed"}, (
            f"{short(path)}:{node.lineno}: {name}"
        )
    hidden = [f.name for f in functions(path) if f.args.kwarg and not f.name.startswith("_")]
    assert not hidden, f"{short(path)}: **{'kwargs'} hides the signature of {hidden}"


@of_every(CODE)
def test_public_names_have_docstrings(path: Path):
    assert ast.get_docstring(tree(path)), f"{short(path)} says nothing about itself"
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    public = [n for n in tree(path).body if isinstance(n, kinds) and not n.name.startswith("_")]
    assert not [n.name for n in public if not ast.get_docstring(n)], f"{short(path)}: public names without a docstring"


def test_concrete_classes_are_never_subclassed():
    classes = [(p, n) for p in FILES for n in nodes(p, ast.ClassDef)]
    interfaces = {n.name for _, n in classes if {"Protocol", "ABC"} & {ast.unparse(b).split("[")[0] for b in n.bases}}
    ours = {n.name for _, n in classes} - interfaces - {"Protocol", "ABC"}  # a class of ours may have that name
    bad = [f"{short(p)}: {n.name}" for p, n in classes if ours & {ast.unparse(b).split(".")[-1] for b in n.bases}]
    assert bad == [], "give the shared part a function or an interface"


def run_python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=60, cwd=REPO_ROOT)


def test_experiments_and_presets_are_pure_python():
    heavy = "print(sorted({'torch', 'numpy', 'PIL', 'einops', 'safetensors'} & set(sys.modules)))"
    done = run_python("-c", f"import sys, lidarsynth, lidarsynth.experiment.presets; {heavy}")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
    for name in PURE:
        own = {n.split(".")[0] for n in imported(PACKAGE / f"{name}.py")}
        assert own <= sys.stdlib_module_names | {"lidarsynth"}


def imported_by(done: subprocess.CompletedProcess[str]) -> set[str]:
    """The modules that `python -X importtime` lists, however deep."""
    return {line.rpartition("|")[2].strip() for line in done.stderr.splitlines() if line.startswith("import time:")}


def test_help_does_not_import_torch():
    done = run_python("-X", "importtime", "-m", "lidarsynth", "--help")
    assert done.returncode == 0, done.stderr[-500:]
    assert "lidarsynth" in done.stdout
    read = imported_by(done)
    assert "lidarsynth.cli.main" in read, "importtime lists what --help imported"
    assert not read & {"torch", "numpy", "PIL", "tqdm.auto", "safetensors", "einops", "typeguard"}


def test_what_a_file_is_is_said_without_torch(tmp_path: Path):
    """Which takes seconds to import, and no scan, sensor or bag needs it."""
    (tmp_path / "own.toml").write_text("beams = 4\ntop = 3.0\nbottom = -3.0\n")
    done = run_python("-X", "importtime", "-m", "lidarsynth", "info", str(tmp_path / "own.toml"))
    assert done.returncode == 0 and "4 from +3.00 to -3.00 degrees" in done.stdout
    assert "| torch" not in done.stderr
    assert "lidarsynth.verbs.description" in (read := imported_by(done)) and "torch" not in read


def test_a_scan_is_projected_without_torch(tmp_path: Path):
    angle = np.linspace(-3, 3, 500)
    np.save(tmp_path / "a.npy", np.column_stack([9 * np.cos(angle), 9 * np.sin(angle), 0 * angle, 0.5 + 0 * angle]))
    words = str(tmp_path / "a.npy"), "--sensor", "vlp-16", "--out", str(tmp_path / "a.npz")
    done = run_python("-X", "importtime", "-m", "lidarsynth", "project", *words)
    assert done.returncode == 0 and (tmp_path / "a.npz").exists() and (tmp_path / "a.png").exists()
    assert "lidarsynth.verbs.batch" in done.stderr and "| torch" not in done.stderr
    assert "torch" not in imported_by(done)
    np.save(tmp_path / "b.npy", np.load(tmp_path / "a.npy"))
    words = str(tmp_path / "a.npy"), str(tmp_path / "b.npy"), "--sensor", "vlp-16", "--out", str(tmp_path / "images")
    done = run_python("-X", "importtime", "-m", "lidarsynth", "project", *words)
    assert done.returncode == 0 and len(list((tmp_path / "images").glob("?.npz"))) == 2
    assert "torch" not in imported_by(done)


def cpu_seconds(*arguments: str) -> float:
    """Processor time of one Python process: what a clock shows on an idle machine, whoever else works on this one."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = run_python(*arguments)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr[-2000:]
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_help_answers_in_half_a_second():
    bare = statistics.median(cpu_seconds("-c", "pass") for _ in range(3))
    asked = statistics.median(cpu_seconds("-m", "lidarsynth", "--help") for _ in range(3))
    slow = max(bare / 0.025, 1.0)  # a bare Python takes 15 to 25 ms; more, and the machine is slow or crowded
    assert asked < 0.5 * slow, f"--help took {asked:.2f} s, a bare python {bare:.3f} s"


@pytest.mark.parametrize("path", sorted((REPO_ROOT / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_imports_is_there(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("lidarsynth."):
            there = importlib.import_module(node.module)
            for alias in node.names:  # of a package its modules, too, which are names once they are imported
                with contextlib.suppress(ModuleNotFoundError):
                    importlib.import_module(f"{node.module}.{alias.name}")
            assert [alias.name for alias in node.names if not hasattr(there, alias.name)] == []
