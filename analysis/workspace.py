"""Workspace pages of some scenarios, and how much larger each reference could be.

python analysis/workspace.py [SCENARIO ...]        # by default all that are shipped
"""

import sys
from pathlib import Path

from stewart_drake.cli import main as command
from stewart_drake.resources import shipped


def main(names: list[str]) -> int:
    """Run `stewart-drake analyze workspace` on each, into out/workspace/NAME."""
    for name in names or shipped("scenario"):
        print(f"\n{name}")
        folder = Path("out", "workspace", Path(name).stem)
        status = command(["analyze", "workspace", name, "--out", str(folder)])
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
