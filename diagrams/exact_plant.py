"""The exact plant on its own: constant torques under gravity, any Drake integrator.

python diagrams/exact_plant.py [runge_kutta5 | radau3 | ...]
"""

import sys

from pydrake.systems.analysis import ApplySimulatorConfig, Simulator, SimulatorConfig

import stewart_drake as sd
from stewart_drake.dynamics.workspace import diagnose
from stewart_drake.loop.exact import ExactPlant
from stewart_drake.scenario.signals import POSE


def main(scheme: str = "runge_kutta5") -> None:
    """Lift the plate with two percent more than its weight until it leaves its workspace."""
    mechanism = sd.load_mechanism("paper")
    dynamics = sd.StewartDynamics(mechanism)
    plant = ExactPlant(dynamics)
    context = plant.CreateDefaultContext()
    torque = 1.02 * dynamics.equilibrium_torque(mechanism.home)
    plant.GetInputPort("torque").FixValue(context, torque)
    simulator = Simulator(plant, context)
    ApplySimulatorConfig(SimulatorConfig(integration_scheme=scheme, accuracy=1e-8), simulator)
    context.SetAccuracy(1e-8)  # the witness function is isolated to this
    simulator.AdvanceTo(5.0)
    pose = context.get_continuous_state_vector().CopyToVector()[POSE]
    print(f"{scheme}: {simulator.get_num_steps_taken()} steps to t = {context.get_time():.6f} s")
    print(diagnose(mechanism, context.get_time(), pose) or f"still inside, pose {pose}")


if __name__ == "__main__":
    main(*sys.argv[1:2])
