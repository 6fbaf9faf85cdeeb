"""The one error that users cause and can mend."""


class InputError(ValueError):
    """Bad input (a path, a log, a recipe name, a shape) that the caller can put right.

    The message is one line that names what is wrong and where. The command line prints it without a
    traceback and exits with code 2.
    """
