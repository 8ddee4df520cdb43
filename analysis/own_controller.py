"""A user's computed-torque controller on the paper's machine, judged like the shipped ones."""

import sys

from pydrake.systems.framework import LeafSystem

import stewart_drake as sd


class ComputedTorque(LeafSystem):
    """T = inverse dynamics of the accelerations r'' - 20 (v - r') - 100 (q - r)."""

    def __init__(self, dynamics: sd.StewartDynamics) -> None:
        super().__init__()
        self.dynamics = dynamics
        self.DeclareVectorInputPort("measurement", 12)
        self.DeclareVectorInputPort("reference", 18)
        self.DeclareVectorOutputPort("torque", 6, self.calc_torque)

    def calc_torque(self, context, output) -> None:
        x, r = (self.GetInputPort(n).Eval(context) for n in ("measurement", "reference"))
        wanted = r[12:] - 20 * (x[6:] - r[6:12]) - 100 * (x[:6] - r[:6])
        output.SetFromVector(self.dynamics.inverse_dynamics(x[:6], x[6:], wanted))


def main(out: str = "out/own_controller", *settings: str) -> sd.SimulationResult:
    """Run it without delay, every 10 ms; write table, figures and replay."""
    fast = ("delay.steps=0", "controller.period=0.01", "start=on_reference")
    scenario = sd.load_scenario("paper", settings=[*fast, *settings])
    dynamics = sd.StewartDynamics(sd.load_mechanism(scenario.mechanism), scenario.plant.gravity)
    result = sd.simulate(scenario, controller=lambda: ComputedTorque(dynamics))
    print(result.table())
    result.save(out)
    result.plot(out)
    result.replay(f"{out}/replay.html")
    return result


if __name__ == "__main__":
    main(*sys.argv[1:])
