"""The one error that this package raises for what it was given."""


class InputError(ValueError):
    """Unusable input: a file, a message or a parameter.

    The message is one line that says what is wrong and where. Commands print it and exit with 2; nodes
    warn with it, set a diagnostic and live on.
    """


#: What the last refusal of a node begins with that met something nobody foresaw.
INTERNAL_ERROR = 'internal error'
