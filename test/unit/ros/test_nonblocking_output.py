"""A node goes on where nobody reads what it prints: a full pipe, a stopped terminal, a journal that hangs."""

import fcntl
import os
import pty
import socket
import subprocess
import sys

import pytest
from support.empty_stage import environment
from support.waiting import PATIENCE_S

pytestmark = pytest.mark.ros

#: As much as a pipe may hold at least; the default is 16 times that.
PAGE = 4096
#: Far more lines than that, and a stop request; the alarm ends a node that hangs, also one that DDS does not let go of.
#: It is run from a file, as a node is: of a program behind ``-c`` rclpy looks in vain for the file with every line, a
#: millisecond each time.
PROGRAM = """
import os, signal, sys
from support.empty_stage import EmptyStage
from thermal_fiducial.errors import InputError
from thermal_fiducial.ros.process import stopping
from thermal_fiducial.ros.process.run import run

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        self.create_timer(0.01, self.talk)

    def talk(self):
        for count in range(2000):
            self.get_logger().warning(f'line {count} that says as much as an ordinary one says')
        os.kill(os.getpid(), signal.SIGINT)

class Refused(EmptyStage):
    def __init__(self):
        super().__init__()
        for count in range(2000):
            self.get_logger().warning(f'line {count} that says as much as an ordinary one says')
        raise InputError('no such file')

signal.alarm(200)
stopping.LEAVING_S = stopping.LEAVING_CPU_S = 200.0
sys.exit(run({'talks': Stage, 'refused': Refused}[sys.argv[1]], []))
"""


@pytest.fixture
def command(tmp_path):
    """What runs one of the nodes, but for its name."""
    file = tmp_path / 'stage.py'
    file.write_text(PROGRAM)
    return [sys.executable, str(file)]


def full_pipe():
    """The end that is written to, once it is full, and the one that nobody reads."""
    reading, writing = os.pipe()
    fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, PAGE)
    own = os.open(f'/proc/self/fd/{writing}', os.O_WRONLY | os.O_NONBLOCK)
    os.write(own, PAGE * b'x')
    os.close(own)
    return writing, reading


def stopped_terminal():
    """A terminal whose other end nobody reads."""
    other, terminal = pty.openpty()
    return terminal, other


def stuck_socket():
    """As the system's journal gives it to a unit."""
    ours, other = socket.socketpair()
    ours.shutdown(socket.SHUT_RD)
    return ours.detach(), other.detach()


@pytest.mark.parametrize(
    ('make', 'way', 'status'),
    [
        (full_pipe, 'talks', 0),
        (stopped_terminal, 'talks', 0),
        (stuck_socket, 'refused', 2),
        pytest.param(full_pipe, 'refused', 2, marks=pytest.mark.nightly),
        pytest.param(stopped_terminal, 'refused', 2, marks=pytest.mark.nightly),
        pytest.param(stuck_socket, 'talks', 0, marks=pytest.mark.nightly),
    ],
)
def test_a_node_whose_output_nobody_reads_works_on_and_ends_as_it_should(command, make, way, status):
    writing, reading = make()
    try:
        done = subprocess.run(
            [*command, way], stdout=writing, stderr=writing, timeout=PATIENCE_S, check=False, env=environment()
        )
        assert done.returncode == status
    finally:
        os.close(writing)
        os.close(reading)


def test_other_programs_at_the_same_pipe_still_wait_for_their_reader(command):
    reading, writing = os.pipe()
    with os.fdopen(reading):
        done = subprocess.run([*command, 'talks'], stderr=writing, timeout=PATIENCE_S, check=False, env=environment())
        assert (done.returncode, os.get_blocking(writing)) == (0, True)
        os.close(writing)


@pytest.mark.parametrize(
    'closing', ['>&- 2>&-', *(pytest.param(closing, marks=pytest.mark.nightly) for closing in ('2>&-', '2>/dev/null'))]
)
def test_a_node_without_a_console_runs(command, closing):
    line = f'exec "$0" "$1" talks {closing}'
    done = subprocess.run(['sh', '-c', line, *command], timeout=PATIENCE_S, check=False, env=environment())
    assert done.returncode == 0


def test_what_is_written_to_a_file_is_complete(command, tmp_path):
    """Also behind what it held before."""
    log = tmp_path / 'log'
    log.write_text('before\n')
    with log.open('a') as file:
        done = subprocess.run([*command, 'refused'], stderr=file, timeout=PATIENCE_S, check=False, env=environment())
    lines = log.read_text().splitlines()
    assert (done.returncode, len(lines)) == (2, 2002)
    assert (lines[0], lines[-1]) == ('before', 'stage.py: no such file')
