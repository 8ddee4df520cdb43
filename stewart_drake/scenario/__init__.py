"""The scenario: its sections, files, motions, times and the table of signals."""
