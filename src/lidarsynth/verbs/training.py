"""One training run in a folder: fresh, from other weights, or continued; what `lidarsynth train` does."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from lidarsynth.data.index import read_index
from lidarsynth.diffusion.denoiser import KINDS, LOSSES
from lidarsynth.diffusion.schedule import SCHEDULES
from lidarsynth.experiment.folder import read_experiment
from lidarsynth.experiment.presets import PRESETS, preset
from lidarsynth.experiment.record import WEIGHTS, Card, Experiment, with_fields
from lidarsynth.experiment.sensor import build_sensor
from lidarsynth.files.lock import only_writer
from lidarsynth.lidar.depth import CODECS
from lidarsynth.lidar.projection import PROJECTIONS
from lidarsynth.lidar.scan import RangeImage
from lidarsynth.lidar.sensor import WORDS
from lidarsynth.networks.coordinates import ENCODINGS
from lidarsynth.pictures.figure import compare
from lidarsynth.systems.table import SYSTEMS, build_network, system_of, task_of, transfer
from lidarsynth.training.checkpoint import STATE, checkpoints, load_run, newest_whole, save_checkpoint, sweep
from lidarsynth.training.examples import (
    CASCADE,
    OF_ANY,
    SYNTHETIC,
    Streets,
    TrainingImages,
    folders_of,
    open_images,
    share_of,
    words_of,
)
from lidarsynth.training.journal import Journal
from lidarsynth.training.loop import DECAYS, Progress, Run, start, train
from lidarsynth.training.machine import accelerator_of, any_process, fixed_randomness, silent_threads, stop_signals
from lidarsynth.training.monitor import Monitor
from lidarsynth.training.options import Options
from lidarsynth.verbs.training_start import Start, check_start, shared_images, start_of, unfinished, write_start
from lidarsynth.weights.load import load_parts, shipped

if TYPE_CHECKING:
    from accelerate import Accelerator

TERMS = "for what was learned from the scans, their own terms"  # a licence that nobody but their owner knows
UNTRUE_NOW = "; no real scan"  # of a card, once scans are learned from
EVERY = 4  # beams, of which pictures are completed from one


def resolve(name: str, changes: tuple[str, ...] = (), seed: int = 0, data: str | Path | None = None) -> Experiment:
    """A preset with `group.field=value` changes, values in JSON or bare words, for the images of cache `data`.

    Sensor, resolution and projection are the cache's, unless `changes` name them. Raises ValueError by name.
    """
    chosen: dict[str, Any] = {"training.seed": seed}
    for change in changes:
        path, equals, text = change.partition("=")
        if not equals:
            raise ValueError(f"expected group.field=value, such as training.steps=1000, found {change!r}")
        try:
            chosen[path] = json.loads(text)
        except json.JSONDecodeError:
            chosen[path] = text
    experiment = with_fields(preset(name), chosen)
    check_words(experiment)
    knows = preset(name).data.reflectance  # said of the network, which does not follow it
    if (found := experiment.data.reflectance) != knows:
        raise ValueError(f"data.reflectance: expected {json.dumps(knows)}, as the network of {name} has it, found "
                         f"{json.dumps(found)}")  # fmt: skip
    return experiment if data is None else _for_images(experiment, data, set(chosen))


def check_words(experiment: Experiment) -> None:
    """Raises ValueError by name for a word that its table does not have, for no steps, and for no known rows."""
    tables = {
        "data": {"codec": CODECS, "projection": PROJECTIONS},
        "model": {"network": SYSTEMS, "coords_encoding": ENCODINGS},
        "diffusion": {"schedule": SCHEDULES, "kind": KINDS, "loss": LOSSES},
        "training": {"decay": DECAYS},
    }
    for group, words in tables.items():
        for name, table in words.items():
            if (word := getattr(getattr(experiment, group), name)) not in table:
                choices = ", ".join("null" if choice is None else choice for choice in table)
                raise ValueError(f"{group}.{name}: expected one of {choices}, found {word!r}")
    if experiment.training.steps < 1:
        raise ValueError("training.steps: expected at least 1, found 0")
    if (group := experiment.upsampling) and group.first >= group.factor[0]:
        raise ValueError(f"upsampling.first: expected less than {group.factor[0]}, the rows of upsampling.factor, "
                         f"found {group.first}")  # fmt: skip


def _for_images(experiment: Experiment, data: str | Path, chosen: set[str]) -> Experiment:
    """The experiment with the projection and the sensor of the images, unless the user chose those fields."""
    images = open_images(data, experiment)
    projection, drawn = experiment.data.projection, images.source.get("projection", experiment.data.projection)
    if "data.projection" not in chosen and (projection, drawn) != ("auto", "unfolding"):  # auto unfolds what it can
        experiment = with_fields(experiment, {"data.projection": drawn})
    found, expected = images.sensor, build_sensor(experiment)
    shape, (height, width) = (found.height, found.width), (expected.height, expected.width)
    if chosen & {"data.sensor", "data.height", "data.width"} and shape != (height, width):
        raise ValueError(f"{data}: expected images of {height} x {width}, found {shape[0]} x {shape[1]}")
    if "data.sensor" in chosen or found == expected:
        return experiment
    words = [w for w, s in WORDS.items() if s.height % found.height == 0 and s.resized(*shape) == found]
    sensor = words[0] if words else found.to_dict()
    return with_fields(experiment, {"data.sensor": sensor, "data.height": shape[0], "data.width": shape[1]})


def run(
    experiment: Experiment,
    data: str | Path,
    out: str | Path,
    weights: str | None = None,
    validation: str | Path | None = None,
    options: Options | None = None,
    resume: bool = False,
) -> Iterator[Progress]:
    """Train on a cache, or on `synthetic` streets, into folder `out`; in the main process, yield after every step.

    The first yield says where the run stands: at 0, or at the step of the newest checkpoint; that is continued exactly,
    or, with more `training.steps`, extended: behind the checkpoint the learning rate is that of the longer run.
    weights     start from these (a word, a folder or a file as in `load`), when there is no checkpoint yet; where there
                is one it may be left out; where the experiment has a base, from that
    validation  cache of images that are not trained on
    resume      insist that there is a checkpoint

    SIGTERM or Ctrl-C saves after the present step and ends the iteration. Raises ValueError when experiment, images,
    weights or folder do not fit, the folder's run began with other images or weights, or weights lie there without
    checkpoints; FloatingPointError, naming step, scans and last checkpoint, when it is not finite.
    """
    options = options or Options()
    out, accelerator = Path(out), accelerator_of(options)
    images = open_images(data, experiment)
    begun = start_of(images, data, weights, validation)
    with only_writer(out, "training") if accelerator.is_main_process else nullcontext():
        yield from _run(experiment, images, data, out, begun, validation, options, resume, accelerator)


def _run(
    experiment: Experiment,
    images: TrainingImages,
    data: str | Path,
    out: Path,
    begun: Start,
    validation: str | Path | None,
    options: Options,
    resume: bool,
    accelerator: Accelerator,
) -> Iterator[Progress]:
    task = task_of(experiment)
    if options.compile and experiment.model.network == CASCADE:
        raise ValueError("expected no --compile for a cascade, nothing of which is compiled, found it")
    task.share(experiment, share_of(experiment, accelerator.num_processes * accelerator.gradient_accumulation_steps))
    task = replace(task, pictures=completions) if experiment.base else task  # which a base generates
    task.suits(experiment, images, True)
    monitor = Monitor(experiment, task, data, validation)  # first, as it refuses images before anything is written
    experiment, state, note = _begin(experiment, images, data, out, begun, resume, accelerator)
    if accelerator.is_main_process:
        told = "; ".join(filter(None, (note, unfinished(data), shared_images(data, validation))))
        yield Progress(state.step, {}, 0.0, 0.0, note=told)
    with stop_signals() as received, _journal(experiment, out, state.step, options, accelerator) as journal:
        due = state.step and options.sample_every and _due(state.step, options.sample_every, experiment)
        if journal and due and not journal.looked(state.step):  # the run was stopped at this step, before it had looked
            judged = monitor.look(state.ema.to(accelerator.device), state.step, journal)
            yield Progress(state.step, {}, 0.0, 0.0, judged=judged)
        for progress in _named(train(experiment, state, images, options, accelerator), out):
            stop = any_process(accelerator, bool(received))
            if journal:
                journal.step(progress)
                if stop or _due(progress.step, options.save_every, experiment):
                    save_checkpoint(out, _with_history(experiment, state.step, accelerator), state, options.keep)
                if not stop and options.sample_every and _due(progress.step, options.sample_every, experiment):
                    progress = replace(progress, judged=monitor.look(state.ema, state.step, journal))
                yield progress
            if stop:
                break
    accelerator.end_training()


def _begin(
    experiment: Experiment,
    images: TrainingImages,
    data: str | Path,
    out: Path,
    begun: Start,
    resume: bool,
    accelerator: Accelerator,
) -> tuple[Experiment, Run, str]:
    """The experiment with its card, and the run: fresh, from weights, or as the newest whole checkpoint has it.

    And a line that names newer checkpoints that are damaged, or weights that are not used.
    """
    found, expected = images.sensor, build_sensor(experiment)
    if (found.height, found.width) != (expected.height, expected.width):
        raise ValueError(f"{images.source}: expected images of {expected.height} x {expected.width}, "
                         f"found {found.height} x {found.width}")  # fmt: skip
    with fixed_randomness(experiment.training.seed):
        network = build_network(experiment)
    of_any = isinstance(images, Streets) and not OF_ANY.isdisjoint(images.words)
    sensor = "" if of_any else images.sensor.name
    card = replace(experiment.card, data=begun.images, sensor=sensor, synthetic=not _holds_scans(data))
    saved, note = newest_whole(out)
    if resume and not saved:
        raise ValueError(f"{out}: expected a run to resume, found no checkpoint")
    if not saved and (out / WEIGHTS).exists():
        raise ValueError(f"{out}: expected a new folder, or checkpoints to go on from, found {WEIGHTS} without any, "
                         f"which would be lost; name another folder, and --from {out} begins with it")  # fmt: skip
    weights = begun.weights or experiment.base
    if weights and not saved:
        source, trained = load_parts(weights)
        transfer(network, experiment, trained, source, weights)
        card = _gone_on(source, weights, card, data, bool(_given(experiment)))
    state = start(experiment, network, task_of(experiment), accelerator.scaler)
    if saved:
        card = _same_experiment(saved, experiment).card
        note = "; ".join(filter(None, (note, check_start(out, begun, card))))
        # The history's last line is this run's, written anew at each checkpoint.
        card = replace(card, history=card.history[:-1], licence=_given(experiment) or card.licence)
        load_run(saved / STATE, state)
        if state.step > experiment.training.steps:
            raise ValueError(f"{out}: expected training.steps of at least {state.step}, which are done, "
                             f"found {experiment.training.steps}")  # fmt: skip
    if accelerator.is_main_process:
        sweep(out)
        if not saved:
            write_start(out, begun)
    accelerator.wait_for_everyone()
    notes = note, "" if saved else _never_averaged(experiment, state)
    return replace(experiment, card=card), state, "; ".join(filter(None, notes))


def _given(experiment: Experiment) -> str:
    """The licence that the user gave; "" where it is the preset's own, or none."""
    name, licence = experiment.name, experiment.card.licence
    return "" if name in PRESETS and licence == preset(name).card.licence else licence


def _gone_on(source: Experiment, weights: str, card: Card, data: str | Path, given: bool = True) -> Card:
    """The card of a run that begins with the `weights` of `source`: what both learned from, and under which terms.

    given  whether a licence of the card is the user's: a preset's takes no terms away that the weights have
    """
    licence, scans = card.licence or source.card.licence, _holds_scans(data)
    told = source.card.data.removesuffix(UNTRUE_NOW) if scans else source.card.data
    before = f"what `{weights}` learned from" if weights in shipped() else told
    theirs = (scans and not card.licence) or (not given and source.card.licence.startswith(TERMS))
    if theirs and licence and not licence.startswith(TERMS):
        licence = f"{TERMS}; for the rest, {licence}"
    learned = ", then ".join(filter(None, (before, card.data)))
    history = *source.card.history, f"from {source.name}"
    return Card(licence, learned, history, sensor=card.sensor, synthetic=not scans)


def _holds_scans(data: str | Path) -> bool:
    """Whether any of the caches holds others than synthetic streets, as words do."""
    folders = [] if words_of(data) else folders_of(data)
    return any(read_index(Path(folder))["source"].get("name") != SYNTHETIC for folder in folders)


def _never_averaged(experiment: Experiment, state: Run) -> str:
    """A note where the run ends before its average, which is what is kept, has seen more than the first step."""
    training = experiment.training
    if any(state.task.average(training, step) is not None for step in range(2, training.steps + 1)):
        return ""
    return f"the weights that are kept are those after step 1: {training.steps} steps end before their average goes on"


def _same_experiment(checkpoint: Path, experiment: Experiment) -> Experiment:
    """The checkpoint's record. Raises ValueError that names the first field that differs; the number of steps may."""
    found = read_experiment(checkpoint)
    steps = experiment.training.steps
    if replace(found, card=experiment.card, training=replace(found.training, steps=steps)) != experiment:
        theirs, ours = (_flat(e.to_dict()) for e in (found, experiment))
        key = next(key for key in ours if _counts(key) and ours[key] != theirs.get(key))
        words = (key, f"{key}.name", key.removesuffix(".name"))  # a sensor is a word or a table with a name
        said = next((theirs[word] for word in words if word in theirs), None)
        raise ValueError(f"{checkpoint.parents[1]}: expected its own run, with {key} = {said!r:.60}, "
                         f"found {ours[key]!r:.60}; another folder begins a new run")  # fmt: skip
    return found


def _counts(key: str) -> bool:
    """Whether a field makes another run: a card says what was done, and more steps are the same run, longer."""
    return key != "training.steps" and not key.startswith("card.")


def _flat(record: dict) -> dict:
    """The fields of nested records by their names with dots between."""
    flat: dict = {}
    for key, value in record.items():
        flat |= {f"{key}.{name}": v for name, v in _flat(value).items()} if isinstance(value, dict) else {key: value}
    return flat


def _with_history(experiment: Experiment, step: int, accelerator: Accelerator) -> Experiment:
    device = torch.cuda.get_device_name() if accelerator.device.type == "cuda" else accelerator.device.type
    line = f"{step:,} steps of {experiment.training.batch_size} on {accelerator.num_processes} x {device}"
    return replace(experiment, card=replace(experiment.card, history=(*experiment.card.history, line), steps=step))


@torch.no_grad()
def completions(
    experiment: Experiment, network: nn.Module, images: Sequence[RangeImage], count: int = 2
) -> list[np.ndarray]:
    """Pictures (H', W', 3) uint8 of images completed from every fourth beam, where these hold any return."""
    make, pictures = system_of(experiment).model, []
    assert make is not None
    for truth in images[:count]:
        known = np.zeros(truth.shape, bool)
        known[::EVERY] = True
        before = truth.keep(known)
        if before.mask.any():
            filled = make(experiment, network).complete(before, known)
            pictures.append(compare({f"every {EVERY}th beam": before, "completed": filled, "measured": truth}))
    return pictures


def _due(step: int, every: int, experiment: Experiment) -> bool:
    return step % every == 0 or step == experiment.training.steps


def _named(steps: Iterator[Progress], out: Path) -> Iterator[Progress]:
    """The same steps; a loss that is not finite also names the last good checkpoint. Raises what a process that reads
    ahead raised, and OSError where one is gone."""
    try:
        yield from steps
    except (ValueError, OSError, EOFError) as error:
        if "in DataLoader worker process" not in str(error):
            if isinstance(error, ConnectionError | EOFError):  # it went while it handed a batch over
                raise _one_gone() from None
            raise
        raise type(error)(str(error).strip().splitlines()[-1].partition(": ")[2]) from None  # without its traceback
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker"):
            raise
        raise _one_gone() from None
    except FloatingPointError as error:
        raise FloatingPointError(f"{error}; last good checkpoint: {(checkpoints(out) or ['none'])[-1]}") from None


def _one_gone() -> OSError:
    return OSError("expected the processes that read ahead to stay, found one gone (out of memory?); the same command "
                   "goes on, and --workers 0 needs the least")  # fmt: skip


@contextmanager
def _journal(
    experiment: Experiment, out: Path, step: int, options: Options, accelerator: Accelerator
) -> Iterator[Journal | None]:
    """The main process's journal; None in the others."""
    if not accelerator.is_main_process:
        yield None
        return
    parts = task_of(experiment).parts
    with (
        silent_threads(),
        closing(Journal(out, step, experiment.training.batch_size, options.log_every, options.wandb, parts)) as journal,
    ):
        yield journal
