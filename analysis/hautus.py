"""Controllability and observability of a scenario's models, mode by mode, as a page.

    python analysis/hautus.py [SCENARIO] [section.field=value ...]

`stewart-drake analyze hautus` does the same.
"""

import sys
from pathlib import Path

import stewart_drake as sd
from stewart_drake.report.hautus_page import hautus_page, hautus_table
from stewart_drake.report.page import Provenance, write_page
from stewart_drake.results import write_json
from stewart_drake.studies.hautus import study_hautus


def main(scenario: str = "paper", *settings: str) -> None:
    """Write out/hautus/report.html and summary.json."""
    study = study_hautus(sd.load_scenario(scenario, settings=settings))
    folder = Path("out/hautus")
    folder.mkdir(parents=True, exist_ok=True)
    command = " ".join(["python analysis/hautus.py", scenario, *settings])
    write_page(hautus_page(study, Provenance(command)), folder / "report.html")
    write_json(folder / "summary.json", study.summary)
    print(hautus_table(study))


if __name__ == "__main__":
    main(*sys.argv[1:])
