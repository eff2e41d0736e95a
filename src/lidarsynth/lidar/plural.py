"""Counts in words: `1 scan was`, `2 scans were`."""

from __future__ import annotations


def plural(count: int, noun: str) -> str:
    """A count and its noun, with an s but for 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def was(count: int) -> str:
    """The verb of so many."""
    return "was" if count == 1 else "were"
