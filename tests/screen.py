"""Check that output fits a terminal of 80 columns."""

NAMES_A_FILE = ("written to ", "next: ")


def too_long(printed: str) -> list[str]:
    """Return the lines that do not fit, but for those that name a file or folder, of any length."""
    return [s for s in printed.splitlines() if len(s) > 80 and not s.startswith(NAMES_A_FILE)]
