"""An example for the help of every command, and of the whole."""

from typing import Any, Final

from stewart_drake.reporting.analyses import ANALYSES, words_of

EXAMPLES: Final = {
    "": (
        "stewart-drake simulate paper --set plant.kind=exact",
        "stewart-drake compare paper --out out/compare",
        "stewart-drake report paper --out out/report",
    ),
    "simulate": (
        "stewart-drake simulate paper --set plant.gravity=true --set delay.steps=1",
        "stewart-drake simulate paper --controller lqi --out out/lqi --replay",
    ),
    "compare": ("stewart-drake compare paper --set start=on_reference --set queue=reference",),
    "export": ("stewart-drake export out/lqi/signals.nc --out lqi.csv",),
    "export-c": ("stewart-drake export-c paper --out out/board",),
    "report": ("stewart-drake report paper --set plant.kind=exact --out out/report",),
    "identify": (
        "stewart-drake identify --plan paper --out out/plan",
        "stewart-drake identify out/lqi/signals.nc --mechanism paper --out out/m",
    ),
    "new": ("stewart-drake new mine --torque-limit 6 --delay 0.08",),
    "live": ("stewart-drake live --demo --duration 5 --no-browser --out out/live",),
    "machine": ("stewart-drake machine paper --set plant.kind=exact --port 0 --duration 1",),
    "list": ("stewart-drake list",),
    "model check": ("stewart-drake model check paper --out out/paper",),
    "model sdf": ("stewart-drake model sdf paper --out paper.sdf",),
    "model view": ("stewart-drake model view desktop",),
    "tune dataset": ("stewart-drake tune dataset paper --out out/data",),
    "tune train": ("stewart-drake tune train out/data --out out/tuner.json",),
    "tune evaluate": ("stewart-drake tune evaluate --out out/evaluate",),
} | {
    " ".join(words_of(name)): tuple(f"stewart-drake {line}" for line in row.examples)
    for name, row in ANALYSES.items()
}
"""By the words of the command; each line runs as it stands."""


def add_examples(app: Any, words: tuple[str, ...] = ()) -> None:
    """Put the examples below the help of an application of typer and of all in it."""
    app.info.epilog = _epilog(EXAMPLES.get(" ".join(words), ()))
    for command in app.registered_commands:
        name = command.name or command.callback.__name__.replace("_", "-")
        command.epilog = _epilog(EXAMPLES.get(" ".join((*words, name)), ()))
    for group in app.registered_groups:
        add_examples(group.typer_instance, (*words, group.name))


def _epilog(lines: tuple[str, ...]) -> str | None:
    # The first character keeps the lines as they are.
    head = "Examples:" if len(lines) > 1 else "Example:"
    return "\n".join(("\b", head, *(f"  {line}" for line in lines))) if lines else None
