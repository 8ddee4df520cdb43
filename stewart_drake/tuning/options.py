"""Options of data, training and evaluation of a tuner; nothing heavy is imported here."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Final, Literal

from stewart_drake.studies.options import JobOptions, Options, option, refuse

if TYPE_CHECKING:
    from stewart_drake.tuning.families import Family, Purpose

Labels = Literal["as_run", "best_in_cell", "best_in_cell_torque"]
Split = Literal["sample", "run", "cell"]
DRAWS: Final = 384
MOST: Final = 10_000
"""Largest number of conditions: each takes 200 kB of memory in the end."""


class FamilyOptions(JobOptions):
    purpose: ClassVar["Purpose"]
    family: Literal["T", "N2"] | None = option(
        None, "Conditions where weights matter: T with the estimator, N2 without."
    )
    seed: int = option(0, "Random seed.", ge=0)

    @property
    def number(self) -> int:
        """Number of conditions to draw; 0 for the paper's grid."""
        raise NotImplementedError

    def conditions(
        self,
        scenario: str | Path,
        controller: str | Path | None,
        settings: Iterable[str],
    ) -> "Family":
        """Return the conditions, on the exact plant unless a setting says otherwise."""
        from stewart_drake.scenario.loading import load_scenario
        from stewart_drake.tuning.families import disturbed_family, faulty_family, paper_grid

        number = self.number
        if self.family is not None:
            given = {
                "SCENARIO": None if scenario == "paper" else scenario,
                "--controller": controller,
            }
            refuse(given, "with --family, which sets it; expected none")
            return faulty_family(self.family, number, self.seed, self.purpose, tuple(settings))
        base = load_scenario(scenario, controller, ("plant.kind=exact", *settings))
        if number == 0:
            return paper_grid(base)
        return disturbed_family(base, number, self.seed, self.purpose)


class DataOptions(FamilyOptions):
    purpose = "training"
    disturbed: int | None = option(
        None, "N drawn conditions instead of the paper's grid.", "N", ge=0, le=MOST
    )
    draws: int | None = option(
        None,
        f"With --family: how many, each with 13 ratios; {DRAWS} by default.",
        "N",
        ge=10,
        le=MOST,
    )

    @property
    def number(self) -> int:
        if self.family is None:
            refuse({"draws": self.draws}, "without --family; expected both or neither")
            return self.disturbed or 0
        why = "with --family, which has --draws; expected one of them"
        refuse({"disturbed": self.disturbed}, why)
        return DRAWS if self.draws is None else self.draws


class EvaluationOptions(FamilyOptions):
    purpose = "evaluation"
    scenarios: int = option(40, "Number of scenarios.", "N", ge=2, le=MOST)

    @property
    def number(self) -> int:
        return self.scenarios


class TrainingOptions(Options):
    regret: bool = option(False, "Train by regret, on data of a family; else as in the paper.")
    start: float | None = option(
        None, "With --regret: log10 w_Q / w_R at first; else the best.", "RATIO"
    )
    labels: Labels | None = option(
        None, "What the network learns to answer; best_in_cell by default."
    )
    split: Split | None = option(None, "Unit of the split into 70 % training data; run by default.")
    density: Literal["magnitude", "signed"] | None = option(
        None, "Form of (45); magnitude by default."
    )
    seed: int = option(0, "Random seed.", ge=0)
    workers: int | None = option(None, "Number of processes; all cores by default.", "N", ge=1)

    def check(self) -> None:
        """Refuse options of the other kind of training."""
        of_labels = {"labels": self.labels, "split": self.split, "density": self.density}
        of_regret = {"start": self.start, "workers": self.workers}
        if self.regret:
            refuse(of_labels, "with --regret; expected it without")
        else:
            refuse(of_regret, "without --regret; expected it with --regret")
