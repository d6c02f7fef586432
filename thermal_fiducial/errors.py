"""The error that this package raises for what it was given, and the one for what fails while it runs."""


class InputError(ValueError):
    """Unusable input: a file, a message or a parameter.

    The message is one line that says what is wrong and where. Commands print it and exit with 2; nodes
    warn with it, set a diagnostic and live on.
    """


class RunError(RuntimeError):
    """What went wrong at run time and is no matter of the input: a process that died, say.

    The message is one line. Commands print it and exit with 1.
    """


#: What the last refusal of a node begins with that met something nobody foresaw.
INTERNAL_ERROR = 'internal error'
