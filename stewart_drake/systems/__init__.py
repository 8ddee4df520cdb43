"""LeafSystems of the loop, in loop order: reference, sensor, controller, delay chain."""
