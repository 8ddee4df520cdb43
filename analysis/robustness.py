"""Robustness of the paper's experiment to unknown quantities of the machine, from both starts.

python analysis/robustness.py [RUNS] [section.field=value ...]
"""

import sys

import stewart_drake as sd

STARTS = {"rest": (), "on_reference": ("start=on_reference", "queue=reference")}


def main(
    runs: str = "200", *settings: str, out: str = "out/robustness"
) -> dict[str, sd.AnalysisResult]:
    """Print the results, and write them as pages."""
    answers = {}
    for name, start in STARTS.items():
        scenario = sd.load_scenario("paper", settings=[*start, *settings])
        answers[name] = sd.analyze_robustness(scenario, int(runs))
        print(f"\n{name}\n{answers[name]}")
        print("written to", answers[name].save(f"{out}/{name}"))
    return answers


if __name__ == "__main__":
    main(*sys.argv[1:])
