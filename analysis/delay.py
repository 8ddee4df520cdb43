"""Delay that a scenario tolerates: open loop, closed loop, and in simulations.

python analysis/delay.py [SCENARIO] [section.field=value ...]
"""

import sys

import stewart_drake as sd


def main(
    scenario: str = "paper", *settings: str, out: str = "out/delay", simulations: bool = True
) -> sd.AnalysisResult:
    """Print the result, and write it as a page."""
    answer = sd.analyze_delay(sd.load_scenario(scenario, settings=settings), simulations)
    print(answer)
    print("written to", answer.save(out))
    return answer


if __name__ == "__main__":
    main(*sys.argv[1:])
