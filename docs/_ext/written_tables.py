"""Write the tables of keys and the help of commands into the pages: ``python docs/_ext/written_tables.py``.

They stand between ``<!-- keys MODEL -->`` or ``<!-- command NAME -->`` and ``<!-- end -->``, so that who reads the
files as they are sees them. `tests/test_docs.py` compares them with the code.
"""

import re
from pathlib import Path

import tables

DOCS = Path(__file__).resolve().parents[1]
PAGES = ("settings", "cli")
BLOCK = re.compile(r"^<!-- (keys|command) (.+?) -->\n.*?^<!-- end -->$", re.MULTILINE | re.DOTALL)


def written(text: str) -> str:
    """Return the text of a page with its tables as the code has them."""
    return BLOCK.sub(lambda found: f"<!-- {found[1]} {found[2]} -->\n{content(found[1], found[2])}\n<!-- end -->", text)


def content(kind: str, name: str) -> str:
    """Return what stands in a block: a table of keys, or the help of a command."""
    if kind == "keys":
        return f"\n{tables.keys_markdown(name)}\n"
    return f"\n```text\n{tables.help_text(name)}\n```\n"


if __name__ == "__main__":
    for page in PAGES:
        path = DOCS / f"{page}.md"
        path.write_text(written(path.read_text("utf-8")), "utf-8")
