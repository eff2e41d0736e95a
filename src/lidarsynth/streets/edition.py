"""Which edition of the streets this is, by which no set and no cache mixes scans of two."""

from __future__ import annotations

EDITION = 2  # raised when equal settings give other scans, or other boxes; caches tell it since 2026-11-26
