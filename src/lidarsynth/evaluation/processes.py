"""One set of statistics out of many processes: each gathers its share, then all hold what one pass would have given."""

from __future__ import annotations

from typing import Any, Protocol, TypeVar

import torch.distributed


class Mergeable(Protocol):
    """What adds the like of another process to itself: `Moments`, `BevCounts`, `BeamCounts`, `Statistics`."""

    def merge(self, other: Any, /) -> None:
        """Take in all that `other` has seen."""


M = TypeVar("M", bound=Mergeable)


def over_processes(own: M) -> M:
    """What all processes of torch.distributed gathered together, in the order of their ranks, the same in each.

    `own` itself where there is one process only. It stays as it is elsewhere; its networks do not travel. Raises what
    `merge` raises.
    """
    if not torch.distributed.is_available() or not torch.distributed.is_initialized():
        return own
    parts: list[Any] = [None] * torch.distributed.get_world_size()
    torch.distributed.all_gather_object(parts, own)
    first, *others = parts
    for other in others:
        first.merge(other)
    return first
