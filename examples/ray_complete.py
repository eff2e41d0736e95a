"""Complete the scans of a folder on a Ray cluster (the extra `ray`): one model a worker, files in and out.

python examples/ray_complete.py SCANS OUT                        this machine, with as many workers as it has cores
python examples/ray_complete.py SCANS OUT --workers 32 --gpus 1  32 workers of a running cluster, a GPU each

SCANS and OUT must be reachable from every machine: a shared disk. Files are called as `lidarsynth complete` calls them.
One that is there already is left out, so a job that was stopped goes on where it was, and nothing below OUT is read; a
broken scan is named in the summary and not the end. The exit code is 2 where no scan could be completed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import ray

from lidarsynth.lidar.plural import plural
from lidarsynth.verbs.batch import Job, Work, start
from lidarsynth.verbs.inputs import FileInput, Reading, inputs_of
from lidarsynth.verbs.output_files import works
from lidarsynth.weights.load import load

NAMED = 5  # failures


class Completion:
    """A worker: its model is loaded once, then called with batches of `source` and `target` paths."""

    def __init__(self, model: str, device: str):
        job = Job("complete", model, device, picture=False)
        self.one = start(job, None, None, workers=2)  # one thread each: Ray counts cores

    def __call__(self, batch: dict[str, np.ndarray]) -> dict[str, list[Any]]:
        results = []
        for source, target in zip(batch["source"], batch["target"], strict=True):
            item = FileInput(Path(target).stem, Path(source), Reading())
            results.append(self.one(Work(item, Path(target), check=False)))
        return {
            "source": list(batch["source"]),
            "new": [result.points[1] - result.points[0] for result in results],
            "error": [result.error or "" for result in results],
        }


def pairs(scans: Path, out: Path, ending: str, there: list[Path] | None = None) -> list[dict[str, str]]:
    """Source and target of every scan whose target is not there yet; targets that are there are added to `there`.

    Raises ValueError for what is no scan file or folder of them, and where two scans would go to one file.
    """
    if out.is_dir() and scans.is_dir() and out.samefile(scans):  # a second run would read what the first one wrote
        raise ValueError(f"{out}: expected another folder than that of the scans, found the same")
    inputs = inputs_of([scans], out=out)
    if inputs.streams:
        raise ValueError(f"{scans}: expected scan files, found bags or captures")
    todo = works(inputs, out, ending, skip=True, skipped=there, beside=Job("complete").beside)
    paths = [(work.item.path, work.target) for work in todo if work.target is not None]
    return [{"source": str(a.absolute()), "target": str(b.absolute())} for a, b in paths]


def complete(scans: Path, out: Path, model: str = "default", workers: int = 2, gpus: float = 0, ending: str = "ply",
             batch: int = 16) -> list[dict[str, Any]]:  # fmt: skip
    """A row (source, new, error) per scan, in any order, by `workers` on a cluster that `ray.init` has joined."""
    todo = pairs(scans, out, ending)
    if not todo:
        return []
    rows = ray.data.from_items(todo, override_num_blocks=max(1, min(len(todo), -(-len(todo) // batch))))
    done = rows.map_batches(
        Completion,
        fn_constructor_kwargs={"model": model, "device": "cuda" if gpus else "cpu"},
        batch_size=batch,
        compute=ray.data.ActorPoolStrategy(size=workers),
        num_gpus=gpus or None,
        num_cpus=1,
    )
    return done.take_all()


def refuse(reason: object) -> NoReturn:
    """One line, and the exit code of what cannot be done."""
    print(reason, file=sys.stderr)
    sys.exit(2)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="default")
    parser.add_argument("--workers", type=int, help="default: the cluster's cores, or its GPUs")
    parser.add_argument("--gpus", type=float, default=0, help="of a worker")
    parser.add_argument("--format", default="ply", choices=["ply", "pcd", "bin", "npy", "npz"])
    args = parser.parse_args()
    there: list[Path] = []
    try:
        pairs(args.scans, args.out, args.format, there)
        load(args.model)
    except (ValueError, OSError) as error:
        refuse(error)
    ray.init()
    cores = ray.cluster_resources().get("GPU" if args.gpus else "CPU", 1)
    workers = args.workers or max(1, int(cores / (args.gpus or 1)))
    rows = complete(args.scans, args.out, args.model, workers, args.gpus, args.format)
    failed = [row for row in rows if row["error"]]
    for row in failed[:NAMED]:
        source, error = row["source"], row["error"]
        print(error if source in error else f"{source}: {error}", file=sys.stderr)
    told = f"; {len(there)} there already" if there else ""
    print(f"{plural(len(rows) - len(failed), 'scan')} completed, {len(failed)} failed{told}")
    if failed and len(failed) == len(rows) and not there:
        refuse(f"{args.scans}: expected scans, found all {len(failed)} broken")


if __name__ == "__main__":
    main()
