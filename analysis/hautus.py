"""Controllability and observability of a scenario's models, by mode.

python analysis/hautus.py [SCENARIO] [section.field=value ...]
"""

import sys

import stewart_drake as sd


def main(scenario: str = "paper", *settings: str, out: str = "out/hautus") -> sd.AnalysisResult:
    """Print the result, and write it as a page."""
    answer = sd.analyze_hautus(sd.load_scenario(scenario, settings=settings))
    print(answer)
    print("written to", answer.save(out))
    return answer


if __name__ == "__main__":
    main(*sys.argv[1:])
