"""The closed loop in Drake: systems, plants, diagram, simulation, record."""
