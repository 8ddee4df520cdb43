"""Equations of motion, compiled, and the workspace."""
