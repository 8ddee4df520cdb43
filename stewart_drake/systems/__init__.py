"""LeafSystems of the loop: reference, sensor, density, tuner, controller, delay chain."""
