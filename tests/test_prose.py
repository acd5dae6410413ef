"""The prose of hand-written pages: CONVENTIONS.md's rules as numbers on file that may only fall."""

import re
import tomllib
from functools import cache
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).resolve().parents[1]
LIMITS: dict[str, float] = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["sideslip"][
    "prose"
]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = ("docs/results/", "docs/reference/api.md")
UNBOUND = (*GENERATED, "docs/reference/", "docs/ARCHITECTURE.md")
BANNED = re.compile(
    r"\b(dear(er|est)?|a share|shares of|nobody knows|told the car|rungs?|ladder|yardstick"
    r"|contest(s|ants?)?|entrants?|moreover|furthermore|utili[sz]e|leverag\w+|seamless\w*)\b",
    re.IGNORECASE,
)
NUMBER = re.compile(r"(?<![\w.,-])\d[\d,.]*(?: ?(?:to|x|,) ?\d[\d,.]*)*")


def name_page(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@cache
def read_prose(path: Path) -> tuple[str, ...]:
    """Paragraphs, items and cells of a page, without code, formulas, targets and made tables."""
    text = re.sub(r"\A---\n.*?\n---\n", "", path.read_text(), flags=re.DOTALL)
    text = re.sub(r"^<!-- tables of .*?^<!-- end -->$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(`{3,}|\$\$).*?^\1\s*?$", "\n", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"^(?: {4}|!\[|<!--|#).*$", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"\{[\w-]+\}`[^`]*`|`[^`]*`|\$[^$]+\$", "code", text)
    text = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"^\s*(?:[-*]|\d+\.)\s", "\n", text, flags=re.MULTILINE)
    text = re.sub(r"^\|.*$", lambda row: "\n\n" + row[0].replace("|", "\n\n") + "\n\n", text,
                  flags=re.MULTILINE)  # fmt: skip
    return tuple(
        " ".join(part.split()) for part in re.split(r"\n\s*\n", text) if part.strip(" -\n")
    )


def list_sentences(path: Path) -> list[str]:
    """Sentences of at least four words; cells of tables have none."""
    parts = (re.split(r"(?<=[.!?])[*)\"]*\s+(?=[A-Z*`(\"a-z])", part) for part in read_prose(path))
    return [sentence for part in parts for sentence in part if len(sentence.split()) > 3]


def count_words(path: Path) -> int:
    return sum(len(part.split()) for part in read_prose(path))


def measure() -> dict[str, float]:
    """The numbers of all pages; of `words` and the sentences those that are not generated."""
    written = [path for path in PAGES if not name_page(path).startswith(GENERATED)]
    sentences = [sentence for path in written for sentence in list_sentences(path)]
    bound = [path for path in PAGES if not name_page(path).startswith(UNBOUND)]
    return {
        "words": sum(map(count_words, written)),
        "longest-page": max(map(count_words, bound)),
        "median-sentence": median(len(sentence.split()) for sentence in sentences),
        "long-sentences": sum(len(sentence.split()) > 25 for sentence in sentences),
        "crowded-sentences": sum(len(NUMBER.findall(sentence)) > 2 for sentence in sentences),
        "banned-words": sum(
            len(BANNED.findall(part)) for path in PAGES for part in read_prose(path)
        ),
    }


@pytest.mark.parametrize("name", LIMITS)
def test_numbers_on_file_only_fall(name: str) -> None:
    now, limit = measure()[name], LIMITS[name]
    assert now <= limit, f"{name} was {limit} and is {now}: CONVENTIONS.md, Prose, says what to do"


@pytest.mark.parametrize("page", sorted((ROOT / "docs/explanation").glob("*.md")), ids=name_page)
def test_an_explanation_begins_with_a_figure(page: Path) -> None:
    head = page.read_text().split("\n## ")[0]
    assert "{image}" in head or "plt.subplots" in head


def test_a_fault_is_counted(tmp_path: Path) -> None:
    """Code, links and tables are no sentences; a long, a crowded and a banned one are."""
    page = tmp_path / "page.md"
    page.write_text(
        "# A ladder\n\n    a ladder of code\n\n```python\nrungs = 1\n```\n\n"
        + "| a cell | 5 |\n|---|---|\n\n"
        + "One of 3 or 4 [words](ladder.md), `rungs` and 5 more. "
        + f"It is a contest {'so ' * 25}long.\n\n- An item that ends\n"
    )
    sentences = list_sentences(page)
    assert [len(sentence.split()) > 25 for sentence in sentences] == [False, True, False]
    assert [len(NUMBER.findall(sentence)) for sentence in sentences] == [3, 0, 0]
    assert sum(len(BANNED.findall(part)) for part in read_prose(page)) == 1
    assert count_words(page) == 10 + 30 + 4 + 3


if __name__ == "__main__":
    for page in sorted(PAGES, key=count_words):
        print(count_words(page), name_page(page))
    print(measure())
