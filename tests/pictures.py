"""Empty pictures in the place of figures, where a test looks at other results."""

import io
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure


@cache
def blank(kind: str) -> bytes:
    """Return an empty picture."""
    stream = io.BytesIO()
    Figure((3, 2)).savefig(stream, format=kind)
    return stream.getvalue()


def leave_blank(patch: pytest.MonkeyPatch) -> None:
    """Save figures without drawing them, which takes four seconds for one run."""
    pictures = {kind: blank(kind) for kind in ("png", "svg")}

    def save(_: Figure, to: Any, format: str, **options: Any) -> None:
        if isinstance(to, str | Path):
            Path(to).write_bytes(pictures[format])
        else:
            to.write(pictures[format])

    patch.setattr(Figure, "savefig", save)
