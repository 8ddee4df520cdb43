"""Examples for the help of every command. Each line runs as it stands."""

from typing import Any, Final

from stewart_drake.reporting.analyses import ANALYSES

_LINES: Final = """\
simulate paper --set plant.gravity=true --set delay.steps=1
simulate paper --controller lqi --out out/lqi --replay
compare paper --set start=on_reference --set queue=reference
simulate paper --set plant.kind=exact --log out/run.mcap
export out/lqi/signals.nc --out lqi.csv
replay out/lqi --out out/lqi.html
export-c paper --out out/board
setpoints reachy_mini --out out/setpoints.csv
report paper --set plant.kind=exact --out out/report
identify --plan paper --out out/plan
identify out/lqi/signals.nc --mechanism paper --out out/m
new mine --torque-limit 6Nm --delay 80ms
live --demo --duration 5 --no-browser --out out/live
machine paper --set plant.kind=exact --port 0 --duration 1
list
model check paper --out out/paper
model sdf paper --out paper.sdf
model view desktop
tune dataset paper --out out/data
tune train out/data --out out/tuner.json
tune evaluate --out out/evaluate"""
EXAMPLES: Final[dict[str, list[str]]] = {
    "": [
        "stewart-drake simulate paper --set plant.kind=exact",
        "stewart-drake compare paper --out out/compare",
        "stewart-drake report paper --out out/report",
    ]
}
"""By the words of the command."""
for _line in (*_LINES.splitlines(), *(line for row in ANALYSES.values() for line in row.examples)):
    _words = _line.split()[: 2 if _line.startswith(("model", "tune", "analyze")) else 1]
    EXAMPLES.setdefault(" ".join(_words), []).append(f"stewart-drake {_line}")


def add_examples(app: Any, words: tuple[str, ...] = ()) -> None:
    """Append the examples to the help of a typer application and its commands."""
    app.info.epilog = _epilog(words)
    for command in app.registered_commands:
        name = command.name or command.callback.__name__.replace("_", "-")
        command.epilog = _epilog((*words, name))
    for group in app.registered_groups:
        add_examples(group.typer_instance, (*words, group.name))


def _epilog(words: tuple[str, ...]) -> str | None:
    lines = EXAMPLES.get(" ".join(words), [])
    # The first character keeps the lines as they are.
    head = "Examples:" if len(lines) > 1 else "Example:"
    return "\n".join(("\b", head, *(f"  {line}" for line in lines))) if lines else None
