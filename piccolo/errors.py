"""The one exception that bad input raises."""


class InputError(ValueError):
    """Bad input: one line that names the file or option, what was found and what is wanted."""
