"""What `list` prints."""

import re
from pathlib import Path

from stewart_drake.files.resources import Kind, resolve, shipped
from stewart_drake.reporting.document import rows
from stewart_drake.tuner.density import NUM_INPUTS
from stewart_drake.tuner.network import NUM_OUTPUTS, load_network


def shipped_table(kind: Kind) -> str:
    """The shipped files of a kind, each with the first sentence of the comment that opens it.

    A network, whose format has no comments, is described by what it is.
    """
    return rows({f"  {name}": _description(resolve(kind, name)) for name in shipped(kind)})


def _description(path: Path) -> str:
    if path.suffix == ".json":
        network = load_network(path)
        low, high = network.bounds.min(), network.bounds.max()
        return (
            f"A network of {NUM_INPUTS} densities ({network.density}), {network.hidden} hidden "
            f"neurons and {NUM_OUTPUTS} weights from {low:g} to {high:g}"
        )
    comment = re.match(r"(#.*\n)*", path.read_text(encoding="utf-8"))
    text = " ".join(line.strip("# ") for line in comment[0].splitlines()) if comment else ""
    return text.partition(". ")[0].rstrip(".")
