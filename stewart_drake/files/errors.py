"""The error that every reader of user input raises."""


class ConfigError(ValueError):
    """Bad input from a file, an option or a setting.

    The message is one line that names the field, the value, and what would be accepted.
    """

    def __init__(self, message: str) -> None:
        # File names may hold line breaks; what a user sees stays one line.
        super().__init__(" ".join(message.splitlines()))
