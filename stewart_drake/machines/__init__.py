"""Machines of others: their coordinates, and adapters to their software."""
