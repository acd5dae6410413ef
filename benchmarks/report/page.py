"""Tables of suites in a Markdown page, between the marks that ask for them.

A page has `<!-- tables of SUITE -->` and `<!-- end -->`, each on a line of its own; what stands
between them is the suite's, the rest its author's.
"""

import re
import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from ..harness.results import ResultTable, Suite, write_text

_FILL = partial(textwrap.fill, width=120, break_long_words=False, break_on_hyphens=False)
_MARKED = r"(?<=^<!-- tables of {} -->\n).*?(?=^<!-- end -->$)"


def format_table(table: ResultTable) -> str:
    """A heading, the table, and its note in lines of 120."""
    head, *rows = (
        [text.replace("|", r"\|") for text in row] for row in (table.header, *table.cells)
    )
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    lines.insert(1, "|---" * len(head) + "|")
    note = f"\n{_FILL(table.note)}\n" if table.note else ""
    return "\n".join([f"## {table.title}", "", *lines, ""]) + note


def check_page(path: Path | None, names: Sequence[str]) -> None:
    """Before the work: the page has marks for a suite that is asked for; ValueError otherwise."""
    if path is not None:
        text = path.read_text(encoding="utf-8")
        if not any(_compile_pattern(name).search(text) for name in names):
            raise ValueError(
                f"{path}: expected the lines <!-- tables of SUITE --> and <!-- end --> for one of "
                f"{', '.join(names)}"
            )


def write_page(path: Path, suites: Sequence[Suite]) -> None:
    """The page with each marked suite's tables anew; details, which only the report shows, are
    left out."""
    text = path.read_text(encoding="utf-8")
    for suite in suites:
        made = "\n".join(format_table(table) for table in suite.tables if not table.detail)
        before, *marked = _compile_pattern(suite.name).split(text, maxsplit=1)
        text = f"\n{made}\n".join((before, *marked))
    write_text(path, text)


def _compile_pattern(name: str) -> re.Pattern[str]:
    return re.compile(_MARKED.format(re.escape(name)), re.MULTILINE | re.DOTALL)
