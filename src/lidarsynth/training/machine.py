"""The machine under a run: processes and devices through accelerate, workers, global randomness, stop signals."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch

from lidarsynth.training.options import Options

if TYPE_CHECKING:
    from accelerate import Accelerator


def accelerator_of(options: Options) -> Accelerator:
    """What accelerate found: devices, processes, precision; also sets torch's number of threads, if told.

    Raises ImportError naming the extra when accelerate is missing, ValueError when the device has no such precision, or
    an earlier run of this process had another.
    """
    try:
        from accelerate import Accelerator
        from accelerate.utils import parse_flag_from_env
    except ImportError:
        raise ImportError("training needs accelerate: pip install 'lidarsynth[train]'") from None
    # None would be that of an earlier run of this process, and not the default
    default = os.environ.get("ACCELERATE_MIXED_PRECISION", "no").lower()
    precision = {"fp32": "no", None: default}.get(options.precision, options.precision)
    cpu = not torch.accelerator.is_available()  # without this, two processes on CPUs would not know of each other
    if precision == "fp16" and (cpu or parse_flag_from_env("ACCELERATE_USE_CPU")):  # which would train in fp32
        raise ValueError("expected the precision bf16 or fp32 for training on a processor, found fp16")
    try:
        accelerator = Accelerator(mixed_precision=precision, gradient_accumulation_steps=options.accumulate, cpu=cpu)
    except ValueError as error:
        if "already been initialized" not in str(error):
            raise
        found = "fp32" if precision == "no" else precision
        raise ValueError(f"expected the precision of this process's earlier run, found {found}; "
                         "another process can have another") from None  # fmt: skip
    if options.threads:  # behind accelerate, which sets a number of its own for several processes on CPUs
        torch.set_num_threads(options.threads)
    return accelerator


def workers_of(options: Options, wanted: bool) -> int:
    """How many processes read ahead for this one; unless told, half of its cores where reading ahead is `wanted`."""
    if options.workers is not None:
        return options.workers
    cores = (os.cpu_count() or 2) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    return max(1, cores // 2) if wanted else 0


@contextmanager
def fixed_randomness(*key: int) -> Iterator[None]:
    """torch's global generators, seeded by the numbers of `key` inside and put back behind it."""
    devices = [torch.cuda.current_device()] if torch.cuda.is_available() and torch.cuda.is_initialized() else []
    with torch.random.fork_rng(devices):
        torch.random.manual_seed(int(np.random.SeedSequence(key).generate_state(1)[0]))
        yield


@contextmanager
def stop_signals() -> Iterator[list[int]]:
    """A list that SIGTERM and the first Ctrl-C append to instead of ending the process; a second Ctrl-C ends it, and a
    second SIGTERM is none: timeout(1) sends two at once."""
    received: list[int] = []
    former = {}

    def note(number: int, frame: object) -> None:
        received.append(number)
        if number == signal.SIGINT:
            signal.signal(number, former[number])

    for number in (signal.SIGTERM, signal.SIGINT):
        former[number] = signal.getsignal(number)
        signal.signal(number, note)
    try:
        yield received
    finally:
        for number, handler in former.items():
            signal.signal(number, handler)


@contextmanager
def silent_threads() -> Iterator[None]:
    """An OSError that ends a thread is not printed with its traceback: TensorBoard's raises it in the caller, too."""
    former = threading.excepthook

    def say(failure: threading.ExceptHookArgs) -> None:
        if not issubclass(failure.exc_type, OSError):
            former(failure)

    threading.excepthook = say
    try:
        yield
    finally:
        threading.excepthook = former


def any_process(accelerator: Accelerator, flag: bool) -> bool:
    """Whether the flag is up in any process; every process gets the same answer, so that all stop at one step."""
    if accelerator.num_processes == 1:
        return flag
    count = accelerator.reduce(torch.tensor(float(flag), device=accelerator.device), reduction="sum")
    assert isinstance(count, torch.Tensor)
    return bool(count > 0)
