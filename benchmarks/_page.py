"""Sizes, tables and pages in results/, shared by the scripts of this folder."""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from stewart_drake.files.versions import versions

QUICK = bool(os.environ.get("QUICK"))
"""Whether to run everything once, at the least size, to see that it runs."""
RESULTS = Path("out/bench") if QUICK else Path(__file__).parent / "results"


def size(name: str, usual: int, least: int = 1) -> int:
    """Return a number of runs: the variable `name` of the environment, else the usual one."""
    return int(os.environ.get(name, least if QUICK else usual))


def table(header: Sequence[str], rows: Sequence[Sequence[str]], rule: str = "---") -> str:
    """In Markdown; `rule` is below each head."""
    lines = [" | ".join(header), " | ".join(rule for _ in header), *map(" | ".join, rows)]
    return "\n".join(f"| {line} |" for line in lines) + "\n"


def write(script: str, title: str, parts: Sequence[str], more: str = "") -> None:
    """Print a page and write it: who made it with what (and `more`), then its parts, a line apart.

    Args:
        script: `__file__` of who writes; the page has its name.
    """
    packages = ", ".join(f"{package} {number}" for package, number in versions().items())
    name = Path(script).stem
    head = f"# {title}\n\nMade by `python benchmarks/{name}.py` with {packages}{more}.\n"
    text = "\n".join([head, *parts]).rstrip("\n") + "\n"
    print(text)
    RESULTS.mkdir(parents=True, exist_ok=True)
    (RESULTS / f"{name}.md").write_text(text, encoding="utf-8")


def run_sections(
    script: str, title: str, sections: Mapping[str, Callable[[], str]], chosen: Sequence[str]
) -> None:
    """Print the chosen sections; the page is of all of them, and written where none is chosen.

    Args:
        script, title: as of `write`.
        sections: what makes the text of each, by its name.
        chosen: names.
    """
    texts = []
    for section in chosen or sections:
        texts.append(sections[section]().rstrip("\n") + "\n")
        print(texts[-1], flush=True)
    if not chosen:
        write(script, title, texts)
