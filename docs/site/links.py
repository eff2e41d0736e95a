"""For mkdocs: links from a page to the source, which is not part of the site, become the names of the files."""

import re

OUTSIDE = re.compile(r"\[([^\]]*)\]\((?:\.\./)+((?!images)[^)#]+)(?:#[^)]*)?\)")


def on_page_markdown(markdown: str, page, config, files) -> str:
    """The page with `[text](../src/x.py)` as `text` in code letters; links within docs/ stay."""
    if page.file.src_uri.startswith("api/"):
        return markdown
    return OUTSIDE.sub(lambda m: m[1] if m[1].startswith("`") else f"`{m[1]}`", markdown)
