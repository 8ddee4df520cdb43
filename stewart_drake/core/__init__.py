"""The dynamics in C, generated, and what loads and calls it."""
