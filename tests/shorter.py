"""Work that a test leaves out where it looks at other results."""

import io
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest


@cache
def blank(kind: str) -> bytes:
    """Return an empty picture."""
    from matplotlib.figure import Figure

    stream = io.BytesIO()
    Figure((3, 2)).savefig(stream, format=kind)
    return stream.getvalue()


def leave_blank(patch: pytest.MonkeyPatch) -> None:
    """Save figures without laying them out or drawing them: seconds for one run."""
    pictures = {kind: blank(kind) for kind in ("png", "svg")}

    def save(_: object, to: Any, format: str, **options: Any) -> None:
        if isinstance(to, str | Path):
            Path(to).write_bytes(pictures[format])
        else:
            to.write(pictures[format])

    patch.setattr("matplotlib.figure.Figure.savefig", save)
    patch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: None)


def map_few_poses(patch: pytest.MonkeyPatch) -> None:
    """Map the workspace on a grid of 15 by 15 poses in the place of 51 by 51."""
    from stewart_drake.studies.workspace_map import sections

    patch.setattr("stewart_drake.studies.workspace_map._ROUGH", 15)
    patch.setattr("stewart_drake.studies.workspace.sections", partial(sections, points=15))


def judge_few_delays(patch: pytest.MonkeyPatch) -> None:
    """Analyse the loop for three delays and for its own, in the place of thirty."""
    from stewart_drake.studies.delay import loop_margins

    patch.setattr("stewart_drake.studies.hautus.LONGEST", 2)
    few = partial(loop_margins, delays=())
    patch.setattr("stewart_drake.studies.delay.loop_margins", few)
