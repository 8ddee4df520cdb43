"""What the scripts beside it share: a table, and the page in results/ that a script writes."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from stewart_drake.files.versions import versions

RESULTS = Path(__file__).parent / "results"


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
    RESULTS.mkdir(exist_ok=True)
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
