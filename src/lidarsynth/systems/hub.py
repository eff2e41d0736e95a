"""Models on the Hugging Face hub: a repository holds our two files and a model card that is filled in from them."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from torch import nn

from lidarsynth.experiment.folder import save
from lidarsynth.experiment.record import RECORD, WEIGHTS, Experiment

REPOSITORY = re.compile(r"(?P<id>[\w-][\w.-]*/[\w-][\w.-]*)(@(?P<revision>[\w./-]+))?", re.ASCII)
HUB = os.environ.get("HF_ENDPOINT", "").rstrip("/") or "https://huggingface.co"  # as huggingface_hub takes it


def is_repository(source: str) -> bool:
    """Whether a word could name a repository: `owner/name` or `owner/name@revision`, and no file."""
    return REPOSITORY.fullmatch(source) is not None and not source.endswith((".pth", ".safetensors"))


def checked_repository(repo_id: str) -> str:
    """The word. Raises ValueError for one that is no `owner/name`."""
    match = REPOSITORY.fullmatch(repo_id) if isinstance(repo_id, str) else None
    if match is None or match["revision"]:
        raise ValueError(f"expected a repository owner/name, found {repo_id!r}")
    return repo_id


def fetch(source: str) -> Path:
    """The folder, in the hub's own cache, of the model of a repository `owner/name` or `owner/name@revision`.

    It is downloaded once; without network the copy of the last time serves. Raises ValueError in one line when there is
    no such repository or no network, ImportError naming the extra `hub`.
    """
    match = REPOSITORY.fullmatch(source)
    if match is None:
        raise ValueError(f"expected a repository owner/name or owner/name@revision, found {source!r}")
    hub = _huggingface_hub()
    with _in_one_line(f"{source}: expected a model folder here, or a repository of {HUB}"):
        folder = Path(hub.snapshot_download(match["id"], revision=match["revision"], allow_patterns=[WEIGHTS, RECORD]))
    if not (folder / RECORD).is_file():
        raise ValueError(f"{HUB}/{source}: expected {WEIGHTS} and {RECORD}, found no {RECORD}")
    return folder


def push(
    experiment: Experiment, network: nn.Module, repo_id: str, card: str, private: bool = False, half: bool = False
) -> str:
    """Upload weights (float16 if `half`), record and Markdown `card` to `owner/name` at once; returns its address.

    The repository is made where there is none. Needs a token, from `hf auth login` or HF_TOKEN. Raises ValueError in
    one line when the hub refuses or there is no network, ImportError naming the extra `hub`.
    """
    repo_id, hub = checked_repository(repo_id), _huggingface_hub()
    with tempfile.TemporaryDirectory() as scratch:
        save(scratch, experiment, network, half)
        (Path(scratch) / "README.md").write_text(card, encoding="utf-8")
        with _in_one_line(f"{repo_id}: expected to write to {HUB}"):
            hub.create_repo(repo_id, private=private, exist_ok=True)
            hub.upload_folder(repo_id=repo_id, folder_path=scratch, commit_message=f"lidarsynth: {experiment.name}")
    return f"{HUB}/{repo_id}"


def _huggingface_hub():
    try:
        import huggingface_hub
    except ImportError:
        raise ImportError("models of the Hugging Face hub need huggingface_hub: "
                          "pip install 'lidarsynth[hub]'") from None  # fmt: skip
    return huggingface_hub


@contextmanager
def _in_one_line(expected: str) -> Iterator[None]:
    """Turns whatever huggingface_hub raises, its own errors and those of its network library, into one line."""
    try:
        yield
    except Exception as error:  # the network library, and with it the errors, differs from version to version
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{expected}, found: {reason:.300}") from None
