"""Numbers of things in messages."""


def number_of(count: int, noun: str) -> str:
    """A count and its noun, "1 marker" or "3 markers"; ``noun`` is the singular of one that takes an s."""
    return f'{count} {noun}' if count == 1 else f'{count} {noun}s'
