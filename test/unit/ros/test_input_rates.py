"""Rates of inputs: what is expected, what is off, what has stopped."""

import pytest

from thermal_fiducial.ros.base.counting import Input
from thermal_fiducial.ros.base.input_rates import InputRates

SECOND = 1_000_000_000


def watched(*hertz, expected=0.0, regular=True):
    """Rates of inputs ``main``, ``other``, ..., whose messages of each second are ``hertz``."""
    inputs = [Input(f'/{name}') for name, _ in zip(('main', 'other', 'third'), hertz, strict=False)]
    for source in inputs[1:]:
        source.regular = regular
    rates = InputRates(inputs, expected)
    for second in range(len(hertz[0])):
        for source, counts in zip(inputs, hertz, strict=True):
            source.count += counts[second]
        rates.look((second + 1) * SECOND)
    return rates


def test_the_rate_of_the_first_seconds_is_expected_from_there_on():
    rates = watched([12] + [30] * 19)
    assert (rates.expected, rates.doubt()) == (pytest.approx(30.0), '')
    assert rates.figures()['expected rate [Hz]'] == '30 (24 to 36)'
    assert rates.figures()['rate /main [Hz]'] == '30'


@pytest.mark.parametrize(
    ('later', 'words'),
    [(60, 'main at 60 Hz, 30 expected'), (20, 'main at 20 Hz, 30 expected'), (27, ''), (33, '')],
)
def test_a_rate_that_changes_is_named(later, words):
    assert watched([30] * 10 + [later] * 10).doubt() == words


def test_a_rate_that_was_given_counts_from_the_first_full_window():
    assert watched([100] * 10, expected=200.0).doubt() == ''
    assert watched([100] * 12, expected=200.0).doubt() == 'main at 100 Hz, 200 expected'


def test_an_input_that_is_back_has_the_rate_that_it_comes_at():
    """A camera that was unplugged for 20 s and was back was said to be at 3 Hz, and at less than 30 for 10 s."""
    back = watched([30] * 12 + [0] * 20 + [30] * 4)
    assert (back.doubt(), back.figures()['rate /main [Hz]']) == ('', '30')
    assert watched([30] * 12 + [0] * 20 + [15] * 12).doubt() == 'main at 15 Hz, 30 expected'


def test_a_shutter_event_is_no_doubt():
    assert watched([30] * 10 + [14] + [30] * 5).doubt() == ''


def test_other_inputs_are_missed_only_if_they_came_all_the_time():
    rates = watched([30] * 12, [200] * 8 + [0] * 4, [0, 1] + [0] * 10)
    assert (rates.stale, rates.doubt()) == (['other'], 'no other any more')
    assert rates.figures()['stale inputs'] == 'other'
    assert 'rate /third [Hz]' in rates.figures()


def test_an_input_that_comes_when_there_is_something_new_is_not_missed():
    """A map of a carpet changed in each of 22 seconds, then for two not at all."""
    assert watched([30] * 24, [2] * 22 + [0] * 2).doubt() == 'no other any more'
    assert watched([30] * 24, [2] * 22 + [0] * 2, regular=False).doubt() == ''


def test_of_two_inputs_of_one_topic_each_is_watched():
    """As where a driver repeats a calibration that is also latched: what stopped was neither missed nor had a rate."""
    inputs = [Input('/main'), Input('/other'), Input('/other')]
    inputs[2].regular = False
    rates = InputRates(inputs)
    for second in range(12):
        for source in inputs[: 3 if second < 8 else 1]:
            source.count += 30
        rates.look((second + 1) * SECOND)
    assert rates.doubt() == 'no other any more'


def test_the_main_input_is_waited_for_and_missed():
    assert watched([0, 0, 0]).trouble() == 'waiting for main'
    one = watched([30, 30, 0])
    assert (one.silent, one.stopped, one.trouble()) == (True, False, '')
    two = watched([30, 30, 0, 0])
    assert (two.silent, two.stopped, two.trouble()) == (True, True, 'main has stopped')
    assert watched([30, 0, 0, 30]).trouble() == ''


def test_a_clock_that_stands_still_or_goes_back_is_survived():
    source = Input('/main')
    rates = InputRates([source], 30.0)
    for time_ns in (5 * SECOND, 5 * SECOND, 3 * SECOND, 4 * SECOND):
        source.count += 30
        rates.look(time_ns)
    assert (rates.doubt(), rates.figures()['rate /main [Hz]']) == ('', '30')


def test_a_simulated_clock_that_begins_late_is_no_low_rate():
    """It is 0 until its first message; a bag that is played at half speed has 15 Hz by the wall, 30 by this clock."""
    source = Input('/main')
    rates = InputRates([source], expected=30.0)
    for sample in range(40):
        source.count += 15
        rates.look(0 if sample < 3 else 1_700_000_000 * SECOND + sample * SECOND // 2)
        assert rates.doubt() == ''
    assert rates.figures()['rate /main [Hz]'] == '30'


def test_what_comes_while_the_clock_stands_still_is_no_high_rate():
    """A simulated clock that stopped for 6 s while its sensors went on: 30 Hz were said to be 110."""
    source = Input('/main')
    rates = InputRates([source], expected=30.0)
    times = [*range(12), *[11] * 6, *range(12, 26)]
    for time_s in times:
        source.count += 30
        rates.look((100 + time_s) * SECOND)
        assert rates.doubt() == ''
    assert rates.figures()['rate /main [Hz]'] == '30'
