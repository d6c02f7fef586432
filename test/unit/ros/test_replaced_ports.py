"""Nodes that Fast DDS has left deaf: noticed by their ports of shared memory, and started again."""

from contextlib import suppress
from pathlib import Path
import signal
import subprocess
import sys
import threading

import pytest
from sensor_msgs.msg import Imu
from support.empty_stage import environment, finished
from support.ros_graph import ros_graph

from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.replaced_ports import replaced_ports

pytestmark = pytest.mark.ros

SHARED = Path('/dev/shm')
#: Number of the first port of domain 0.
FIRST_OF_DOMAINS = 7400


def test_a_port_of_shared_memory_that_was_deleted_is_noticed():
    """As Fast DDS deletes it, before it opens a new one under the same name."""
    with ros_graph() as graph:
        # Threads give themselves their names.
        graph.spin_until(listening)
        (port, *_) = listening()
        assert replaced_ports() == []
        (SHARED / f'fastrtps_port{port}').unlink()
        assert replaced_ports() == [port]


@pytest.mark.parametrize('error', [FileNotFoundError, ProcessLookupError])
def test_a_thread_that_has_ended_since_it_was_listed_is_no_error(monkeypatch, error):
    """Before its file is opened, or between that and reading it."""
    named = Path.read_text

    def ended(file):
        if file.name == 'comm' and file.parent.name != str(threading.get_native_id()):
            raise error(file)
        return named(file)

    with ros_graph() as graph:
        graph.spin_until(listening)
        monkeypatch.setattr(Path, 'read_text', ended)
        assert replaced_ports() == []


@pytest.mark.nightly
def test_threads_that_end_at_that_moment_are_no_error():
    """Each look lists this process's threads and then reads their names, and in between some have ended."""
    done = threading.Event()

    def begin_and_end():
        while not done.is_set():
            thread = threading.Thread(target=lambda: None)
            thread.start()
            thread.join()

    threads = [threading.Thread(target=begin_and_end) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        # One look in 200 met a thread that ended, and failed.
        for _ in range(500):
            replaced_ports()
    finally:
        done.set()
        for thread in threads:
            thread.join()


def listening():
    """Numbers of the ports of shared memory that threads of this process listen to, but for those below all domains.

    Where one below them is deleted, the next process on this machine, of any domain, complains that it is locked.
    """
    names = []
    for thread in Path('/proc/self/task').iterdir():
        with suppress(FileNotFoundError, ProcessLookupError):
            names.append((thread / 'comm').read_text().strip())
    ports = [name.removeprefix('dds.shm.') for name in names if name.startswith('dds.shm.') and name[8:].isdigit()]
    return [port for port in ports if int(port) >= FIRST_OF_DOMAINS]


LISTENER = """
from pathlib import Path
import sys
from sensor_msgs.msg import Imu
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.process.run import run
from unit.ros.test_replaced_ports import listening, SHARED

marker = Path(sys.argv.pop())

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        self.subscribe(Imu, 'imu/data', self.on_imu, qos.RESULT)
        if not marker.exists():
            self.create_timer(0.1, self.lose_ports)

    def lose_ports(self):
        if listening() and not marker.exists():
            for port in listening():
                (SHARED / f'fastrtps_port{port}').unlink(missing_ok=True)
            marker.touch()
            print('lost', flush=True)

    def on_imu(self, message):
        print('heard', flush=True)
        raise SystemExit(7)

sys.exit(run(Stage, []))
"""


def test_a_node_whose_ports_were_deleted_hears_who_comes_after_that(tmp_path):
    """Before anything has arrived, too: a busy machine starves a node most at its start."""
    command = [sys.executable, '-c', LISTENER, str(tmp_path / 'lost')]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment()
    ) as node:
        try:
            assert node.stdout.readline() == 'lost\n'
            with ros_graph() as graph:
                output = graph.tester.advertise(Imu, 'imu/data', qos.RESULT)

                def sent():
                    output.send(Imu())
                    return node.poll() is not None

                graph.spin_until(sent)
        finally:
            node.kill()
        assert node.stdout.readline() == 'heard\n'
        assert 'of the shared memory has been replaced; the node starts again' in node.stderr.read()


PROGRAM = """
from pathlib import Path
import sys
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.process.run import run

lives = Path(sys.argv[1])

class Stage(EmptyStage):
    def __init__(self):
        super().__init__()
        count = int(lives.read_text()) + 1 if lives.exists() else 1
        lives.write_text(str(count))
        if count == 1:
            self.deaf = 'deaf'
        else:
            self.create_timer(0.01, self.stop)

    def stop(self):
        raise SystemExit(7)

    def close(self):
        print('saved', flush=True)

sys.exit(run(Stage, []))
"""


def test_a_deaf_node_ends_in_order_and_starts_again_as_the_same_process(tmp_path):
    done = finished(PROGRAM, str(tmp_path / 'lives'))
    assert (tmp_path / 'lives').read_text() == '2', done.stderr
    assert done.stdout == 'saved\nsaved\n'
    assert done.returncode in (7, -signal.SIGALRM)
