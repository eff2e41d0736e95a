"""SQLite bags of ROS 2 that a killed recorder left: their messages up to where the file ends, and those of its log."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

LOG = "-wal"  # the ending of the file that holds what is not yet in the database (sqlite.org/wal.html)


@dataclass(frozen=True)
class CutDatabase:
    """What can be read of a database, as rosbags' readers give a whole one.

    connections  of rosbags, with the number of messages that can be read
    rows         (time in nanoseconds, number in the table, connection's number) of each of these, by time
    """

    base: sqlite3.Connection
    connections: list[Any]
    rows: list[tuple[int, int, int]]

    @property
    def message_count(self) -> int:
        """How many messages can be read."""
        return len(self.rows)

    @property
    def duration(self) -> int:
        """Nanoseconds from the first to the one after the last of them, as rosbags counts."""
        return self.rows[-1][0] + 1 - self.rows[0][0] if self.rows else 0

    def messages(self, connections: Iterable[Any], start: int | None = None) -> Iterator[tuple[Any, int, bytes]]:
        """(connection, time, bytes) of the messages of these, by time, from `start` (nanoseconds) on."""
        wanted = {connection.id: connection for connection in connections}
        for time, number, topic in self.rows:
            if topic in wanted and time >= (start or 0):
                (data,) = self.base.execute("SELECT data FROM messages WHERE id = ?", (number,)).fetchone()
                yield wanted[topic], time, data

    def close(self) -> None:
        """Close the file."""
        self.base.close()


def has_log(path: Path) -> bool:
    """Whether messages lie beside the database, as nobody has closed it."""
    log = path.with_name(path.name + LOG)
    return log.is_file() and log.stat().st_size > 0


def read_database(path: Path) -> CutDatabase | None:
    """The messages that SQLite finds, in the order in which they were recorded, up to the first that is not whole; None
    where there is no table of topics. The file stays as it is."""
    for mode in ("mode=ro", "immutable=1"):  # a log is not read where it lies in a folder without write permission
        base = sqlite3.connect(f"{path.absolute().as_uri()}?{mode}", uri=True, check_same_thread=False)
        try:
            base.execute("PRAGMA writable_schema = 1")  # else a file that is shorter than it says is not looked into
            topics = [
                dict(zip(_columns(base, "topics"), row, strict=True)) for row in base.execute("SELECT * FROM topics")
            ]
            rows = sorted(_rows(base))
            return CutDatabase(base, _connections(base, topics, Counter(topic for _, _, topic in rows)), rows)
        except (sqlite3.Error, LookupError, ValueError):
            base.close()
    return None


def _columns(base: sqlite3.Connection, table: str) -> list[str]:
    return [row[1] for row in base.execute(f"PRAGMA table_info({table})")]


def _rows(base: sqlite3.Connection) -> Iterator[tuple[int, int, int]]:
    with suppress(sqlite3.DatabaseError):  # from here on it is not there
        for number, topic, time, _ in base.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id"):
            yield time, number, topic


def _connections(base: sqlite3.Connection, topics: list[dict[str, Any]], counts: Counter[int]) -> list[Any]:
    from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

    kinds = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
    texts = {}
    with suppress(sqlite3.Error):  # old ones have none
        told = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        texts = {name: MessageDefinition(kinds[kind], text) for name, kind, text in base.execute(told) if kind in kinds}
    none = MessageDefinition(MessageDefinitionFormat.NONE, "")
    return [
        Connection(
            topic["id"],
            topic["name"],
            topic["type"],
            texts.get(topic["type"], none),
            topic.get("type_description_hash", ""),
            counts[topic["id"]],
            ConnectionExtRosbag2(topic["serialization_format"], []),
            None,
        )
        for topic in topics
    ]
