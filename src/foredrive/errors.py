"""The error class for input that users can correct."""


class InputError(ValueError):
    """Invalid input (a path, a log, a recipe name, a shape) that the caller can correct.

    The message is one line. It names the problem and its place. The command line prints it without a
    traceback and exits with code 2.
    """
