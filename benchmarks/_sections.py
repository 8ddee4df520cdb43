"""What benchmarks made of sections have in common: which of them run, and the page of all."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from stewart_drake.files.versions import versions

RESULTS = Path(__file__).parent / "results"


def run_sections(
    name: str, title: str, sections: Mapping[str, Callable[[], str]], chosen: Sequence[str]
) -> None:
    """Prints the chosen sections, all of them if none is; all are written to RESULTS.

    Args:
        name: of the script and its page, without an ending.
        title: of the page.
        sections: what makes the text of each, by its name.
        chosen: names.
    """
    texts = []
    for section in chosen or sections:
        texts.append(sections[section]())
        print(texts[-1], flush=True)
    if not chosen:
        used = ", ".join(f"{package} {number}" for package, number in versions().items())
        head = f"# {title}\n\nMade by `python benchmarks/{name}.py` with {used}."
        (RESULTS / f"{name}.md").write_text("\n\n".join([head, *texts]))
