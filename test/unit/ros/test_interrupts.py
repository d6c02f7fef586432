"""Ctrl-C of commands: once, where it breaks nothing, and said in one line."""

import os
import signal
import threading

import pytest
from support.empty_stage import finished

from thermal_fiducial.cli import main as program
from thermal_fiducial.ros.process import interrupts
from thermal_fiducial.ros.process.interrupts import Interrupts


@pytest.fixture(autouse=True)
def pythons_own_handler():
    """A shell's background jobs ignore the signal from the start."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def press():
    os.kill(os.getpid(), signal.SIGINT)


def test_a_second_one_does_not_interrupt_the_clearing_up():
    cleared_up = []

    def work():
        try:
            press()
        finally:
            press()
            cleared_up.append(True)

    with pytest.raises(KeyboardInterrupt), Interrupts(held=False):
        work()
    assert cleared_up


def test_one_that_a_library_has_swallowed_can_be_repeated(monkeypatch):
    monkeypatch.setattr(interrupts, 'PAUSE_S', 0.0)
    with Interrupts(held=False):
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                press()


def test_a_held_one_is_raised_by_a_check():
    with pytest.raises(KeyboardInterrupt), Interrupts(held=True) as held:
        check_around(held, press)
    assert held.asked


def check_around(held, act):
    """An action between two checks, of which the first one must raise nothing."""
    held.check()
    act()
    assert held.asked
    held.check()
    pytest.fail('nothing was raised')


def test_a_held_one_is_raised_at_the_end():
    with pytest.raises(KeyboardInterrupt), Interrupts(held=True):
        press()


def fail():
    press()
    raise ValueError('of another process')


def test_errors_after_it_are_consequences_of_it():
    """A node of the same terminal that has had it too, for example."""
    with pytest.raises(KeyboardInterrupt), Interrupts(held=True):
        fail()


def test_errors_without_it_are_errors():
    with pytest.raises(ValueError, match='own'), Interrupts(held=True):
        raise ValueError('own')


def test_a_job_in_the_background_of_a_shell_goes_on_ignoring_it():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Interrupts(held=True) as held:
        press()
        assert not held.asked
    assert signal.signal(signal.SIGINT, signal.default_int_handler) is signal.SIG_IGN


def test_in_another_thread_it_does_nothing():
    def work():
        with Interrupts(held=True):
            done.append(True)

    done = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done


def test_a_command_says_that_it_was_interrupted_whatever_a_library_makes_of_it(monkeypatch, capsys):
    """The conversions of rclpy raise a TypeError in its place."""

    def convert(argv):
        try:
            press()
        except KeyboardInterrupt:
            raise TypeError('Unable to convert function return value') from None

    monkeypatch.setattr(program, '_run', convert)
    assert program.main(['replay']) == 130
    assert capsys.readouterr().err == 'thermal-fiducial replay: interrupted\n'


def test_a_second_one_at_the_very_end_prints_no_traceback():
    """Between the handler of the command and none, Python's own was there: one in eight double presses met it."""
    done = finished(
        """
import os, signal, sys
from thermal_fiducial.__main__ import main
from thermal_fiducial.cli import main as program

own, calls = signal.signal, []

def press(*_):
    os.kill(os.getpid(), signal.SIGINT)

def press_behind_the_end(number, handler):
    before = own(number, handler)
    calls.append(handler)
    if len(calls) == 3:
        press()
    return before

own(signal.SIGINT, signal.default_int_handler)
signal.signal, program._run = press_behind_the_end, press
sys.exit(main())
""",
        'replay',
    )
    assert (done.returncode, done.stderr) == (-signal.SIGINT, 'thermal-fiducial replay: interrupted\n')


SAID = (130, 'thermal-fiducial map: interrupted\n')


@pytest.mark.parametrize(
    ('module', 'ended'), [('thermal_fiducial.cli.parser', (-signal.SIGINT, '')), ('thermal_fiducial.cli.map', SAID)]
)
def test_one_during_the_imports_prints_no_traceback(module, ended):
    """In the first 0.1 s, before there is anything to clear up, or to say."""
    done = finished(
        f"""
import os, runpy, signal, sys

class Pressing:
    def find_spec(self, name, *_):
        if name == {module!r}:
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Pressing())
sys.argv = ['thermal-fiducial', 'map', 'show', 'hall.yaml']
runpy.run_module('thermal_fiducial', run_name='__main__')
"""
    )
    assert (done.returncode, done.stderr) == ended
