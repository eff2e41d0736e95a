"""For mkdocstrings: paragraphs of a docstring that are tables in columns of spaces stay as they are set."""

import re

import griffe

COLUMNS = re.compile(r"^\s*\S.*?\S  +\S", re.MULTILINE)


class Columns(griffe.Extension):
    """Puts a fence around such paragraphs, and around examples."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Called for every module, class, function and attribute."""
        if obj.docstring is None:
            return
        parts = obj.docstring.value.split("\n\n")
        obj.docstring.value = "\n\n".join(
            f"```text\n{part}\n```" if COLUMNS.search(part) or ">>>" in part else part for part in parts
        )
