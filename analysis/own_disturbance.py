"""Response of the shipped controller, with 0.8 s of delay, to a kick of the plate at 3 s."""

import sys

from pydrake.systems.framework import LeafSystem

import stewart_drake as sd


class Kick(LeafSystem):
    """A force (3,) in N in the world that pushes the plate's COM for a tenth of a second."""

    def __init__(self, force: tuple[float, ...] = (5.0, 0.0, 0.0), time: float = 3.0) -> None:
        super().__init__()
        self.wrench, self.time = [0.0, 0.0, 0.0, *force], time
        self.DeclareVectorOutputPort("wrench", 6, self.calc_wrench)

    def calc_wrench(self, context, output) -> None:
        pushed = self.time <= context.get_time() < self.time + 0.1
        output.SetFromVector(self.wrench if pushed else [0.0] * 6)


def main(*settings: str) -> dict[str, sd.SimulationResult]:
    """Run the predictor with and without the kick."""
    scenario = sd.load_scenario("paper", "predictor_lqi", settings)
    results = {"calm": sd.simulate(scenario), "kicked": sd.simulate(scenario, disturbance=Kick)}
    for name, result in results.items():
        error = 1e3 * abs(result.signals.error.sel(coordinate="x"))
        print(f"{name}: E_ac {result.accumulated_error:.3g} % s, x off by {error.max():.2g} mm")
    return results


if __name__ == "__main__":
    main(*sys.argv[1:])
