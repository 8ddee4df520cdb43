"""How the paper's experiment bears what is not known of the machine, from either start.

python analysis/robustness.py [RUNS] [OPTION ...]   # 200 runs by default; options of the command
"""

import sys
from pathlib import Path

from stewart_drake.cli import main as command

STARTS = {
    "rest": (),
    "on_reference": ("--set", "start=on_reference", "--set", "queue=reference"),
}


def main(words: list[str]) -> int:
    """Run `stewart-drake analyze robustness` for each start, into out/robustness/START."""
    runs, *options = words or ["200"]
    for name, start in STARTS.items():
        print(f"\n{name}")
        folder = str(Path("out", "robustness", name))
        words = ["analyze", "robustness", "paper", *start, "--runs", runs, *options]
        status = command([*words, "--out", folder])
        if status:
            return status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
