"""Lines of a node on the console: when they are printed."""

from thermal_fiducial.ros.base.console import CALLS_BETWEEN, Console


class Printed(list):
    """A logger that keeps its lines."""

    info = warning = list.append


def printed_of(headlines):
    """The lines that these headlines, one a second, make."""
    lines = Printed()
    console = Console(lines)
    for headline in headlines:
        console.say(headline, calm=False)
    return list(lines)


def readout(tenths):
    return f'rows are read over {tenths / 10} +- 0.2 ms more than readout_time says: add {tenths / 1e4}'


def test_an_estimate_that_moves_in_its_last_digit_is_printed_twice_a_minute():
    """Undeclared, a read-out of 16 ms made eight lines in 14 s."""
    lines = printed_of([readout(150 + k) for k in range(2 * CALLS_BETWEEN)])
    assert lines == [readout(150), readout(150 + CALLS_BETWEEN)]


def test_other_words_are_printed_at_once():
    assert printed_of(['', readout(150), 'the map leans', readout(151), '', '']) == [
        readout(150),
        'the map leans',
        readout(151),
        f'over: {readout(151)}',
    ]


def test_a_line_that_stays_is_printed_once():
    assert printed_of([readout(150)] * (3 * CALLS_BETWEEN)) == [readout(150)]
