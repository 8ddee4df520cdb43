"""How much delay a scenario can bear: open loop, closed loop, and in simulations, as a page.

    python analysis/delay.py [SCENARIO] [section.field=value ...]

`stewart-drake analyze delay` does the same.
"""

import sys
from pathlib import Path

import stewart_drake as sd
from stewart_drake.report.delay_page import delay_page, delay_table
from stewart_drake.report.page import Provenance, write_page
from stewart_drake.results import write_json
from stewart_drake.studies.delay_limits import study_delay


def main(scenario: str = "paper", *settings: str) -> None:
    """Write out/delay/report.html and summary.json."""
    study = study_delay(sd.load_scenario(scenario, settings=settings))
    folder = Path("out/delay")
    folder.mkdir(parents=True, exist_ok=True)
    command = " ".join(["python analysis/delay.py", scenario, *settings])
    write_page(delay_page(study, Provenance(command)), folder / "report.html")
    write_json(folder / "summary.json", study.summary)
    print(delay_table(study))


if __name__ == "__main__":
    main(*sys.argv[1:])
