"""The mechanism: geometry and inertia, kinematics, the paper's torque map, SDFormat."""
