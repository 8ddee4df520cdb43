"""The paper's experiment as a Drake diagram, run with Drake's own Simulator.

    python diagrams/paper_experiment.py [plant.kind=exact section.field=value ...]

`stewart_drake.simulate` does the same with logging, metrics and a clean stop.
"""

import sys

import numpy as np
from pydrake.systems.analysis import Simulator

import stewart_drake as sd
from stewart_drake.scenario.signals import POSE
from stewart_drake.scenario.timing import look_time


def main(settings: list[str]) -> None:
    """Simulate, and print the pose error once a second."""
    scenario = sd.load_scenario("paper", settings=settings)
    loop = sd.build_closed_loop(scenario)
    simulator = Simulator(loop, loop.CreateDefaultContext())
    context = simulator.get_context()
    print("t in s   pose error: roll pitch yaw in mrad, x y z in mm")
    for t in np.arange(1.0, scenario.duration + 0.5):
        status = simulator.AdvanceTo(look_time(t))
        state = loop.GetOutputPort("state").Eval(context)
        reference = loop.GetOutputPort("reference").Eval(context)
        error = 1e3 * (state[POSE] - reference[POSE])
        print(f"{context.get_time():6.3f}  ", " ".join(f"{e:9.4f}" for e in error))
        if not status.succeeded() or context.get_time() < look_time(t):
            print(status.FormatMessage())
            break


if __name__ == "__main__":
    main(sys.argv[1:])
