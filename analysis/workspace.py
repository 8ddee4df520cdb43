"""How far is a scenario's motion from the ends of its workspace, and which motors does it need?

python analysis/workspace.py [SCENARIO] [section.field=value ...]
"""

import sys

import stewart_drake as sd


def main(scenario: str = "paper", *settings: str, out: str = "out/workspace") -> sd.AnalysisResult:
    """Print the answer, and write it as a page."""
    answer = sd.analyze_workspace(sd.load_scenario(scenario, settings=settings))
    print(answer)
    print("written to", answer.save(out))
    return answer


if __name__ == "__main__":
    main(*sys.argv[1:])
