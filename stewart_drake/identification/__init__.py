"""A machine found from its own log: delay, friction, payload, geometry, encoder offsets."""
