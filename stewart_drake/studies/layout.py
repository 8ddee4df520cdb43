"""Search of the layouts and lengths of a machine that suit a motion.

Drake is imported by the search, not by its options.
"""

from pathlib import Path
from typing import TYPE_CHECKING

from stewart_drake.files.fileio import write_whole
from stewart_drake.studies.study_options import LayoutOptions

if TYPE_CHECKING:
    from stewart_drake.scenario.config import Scenario
    from stewart_drake.studies.jobs import Progress
    from stewart_drake.studies.layout_search import LayoutStudy


def study_layout(
    scenario: "Scenario",
    directory: str | Path,
    options: LayoutOptions,
    progress: "Progress | None" = None,
) -> "LayoutStudy":
    """Search machines for a scenario's motion, or go on with that; the best are written.

    Args:
        scenario: its machine, which has a pattern, is what the search begins from.
        directory: machines go there, finished searches below it.
        options: see `LayoutOptions`.
        progress: as `run_jobs` takes it.

    Raises:
        As `run_jobs`, and ConfigError for what does not suit.
    """
    from stewart_drake.studies import layout_search
    from stewart_drake.studies.jobs import run_jobs
    from stewart_drake.studies.layout_space import own_values

    best, starts, generations = options.best, options.starts, options.generations
    workers, seed, folder = options.workers, options.seed, Path(directory)
    problem = layout_search.problem_of(
        scenario, options.goal, options.limits or {}, options.vary or {}, options.keep
    )
    settings = problem.summary | {"seed": seed, "generations": generations}
    jobs = {
        f"{arrangement.key}_{start}": (problem, arrangement, seed, start, generations)
        for arrangement in problem.space.arrangements()
        for start in range(starts)
    }
    searches = run_jobs(
        jobs,
        layout_search.search,
        folder / "searches",
        settings=settings,
        read=layout_search.read_found,
        workers=workers,
        scheduler=options.scheduler,
        progress=_part(progress, 0, len(jobs) + best + 1),
    )
    chosen = layout_search.best_of(problem, list(searches.values()), best)
    texts = {
        f"layout_{k}": layout_search.text(problem, one, f"layout_{k}")
        for k, one in enumerate(chosen, 1)
    }
    layout_search.remove_more(folder, len(texts))
    for name, text in texts.items():
        write_whole(folder / f"{name}.yaml", text)
    own = scenario.mechanism
    places = {"before": own} | {name: str((folder / f"{name}.yaml").resolve()) for name in texts}
    judged = run_jobs(
        {key: (problem, place) for key, place in places.items()},
        layout_search.judge,
        folder / "judged",
        settings=problem.summary | {"machines": texts},
        read=layout_search.read_judged,
        workers=workers,
        progress=_part(progress, len(jobs), len(jobs) + len(places)),
    )
    layouts = [
        layout_search.layout(problem, key, places[key], one.order, one.values, judged[key])
        for key, one in zip(texts, chosen, strict=True)
    ]
    spec, order = problem.space.spec, problem.space.pattern.plate_order
    before = layout_search.layout(problem, "before", own, order, own_values(spec), judged["before"])
    before = before._replace(name=before.mechanism.name)
    return layout_search.LayoutStudy(problem, seed, starts, generations, searches, before, layouts)


def _part(progress: "Progress | None", before: int, whole: int) -> "Progress | None":
    """Return the progress of jobs that are part of more."""
    if progress is None:
        return None
    return lambda done, _: progress(before + done, whole)
