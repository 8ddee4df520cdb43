"""The loop in real time: a machine and a controller that talk over a link."""
