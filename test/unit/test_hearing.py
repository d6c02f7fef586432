"""Nodes that DDS has left deaf: noticed by what others say that they publish, and started again."""

from pathlib import Path
import signal

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import pytest
from sensor_msgs.msg import Imu
from support.empty_stage import finished
from support.ros_graph import ros_graph

from thermal_fiducial.ros import qos
from thermal_fiducial.ros.counting import CountingNode
from thermal_fiducial.ros.hearing import Hearing

pytestmark = pytest.mark.ros

SHARED = Path('/dev/shm')


class Pair:
    """A node that listens to ``imu/data``, and another one whose diagnostics say how much it has published there."""

    def __init__(self, graph):
        self.graph = graph
        self.node = graph.added(CountingNode('ear', context=graph.context))
        self.node.subscribe(Imu, 'imu/data', lambda _: None, qos.RESULT)
        # As every node of ours.
        self.node.advertise(DiagnosticArray, '/diagnostics')
        self.hearing = Hearing(self.node)
        self.diagnostics = graph.tester.advertise(DiagnosticArray, '/diagnostics')
        graph.send('imu/data', Imu())

    def silent(self, looks, published=()):
        """What is said in each of so many seconds without a message, with a status by each node in each of them."""
        said = []
        for look in range(looks):
            for count in published[look : look + 1]:
                value = KeyValue(key='published /imu/data', value=str(count))
                status = DiagnosticStatus(name='mouth', values=[value, KeyValue(key='refused messages', value='0')])
                self.diagnostics.send(DiagnosticArray(status=[status]))
                self.graph.executor.spin_once(timeout_sec=0.02)
            said.append(self.hearing.look(stopped=look > 1))
            # The subscription begins with the third look; both ends are in this process.
            self.graph.spin_until(lambda n=look: n < 3 or self.diagnostics.listeners == 2)
        return said


@pytest.fixture
def pair():
    with ros_graph() as graph:
        yield Pair(graph)


def test_what_is_published_but_does_not_arrive_is_noticed_in_seconds(pair):
    said = pair.silent(8, [100, 130, 160, 190, 220, 250, 280, 310])
    assert said[:4] == [''] * 4
    assert said[-1] == 'deaf: /imu/data is published but does not arrive'


def test_an_input_that_nobody_publishes_any_more_is_no_deafness(pair):
    assert set(pair.silent(40, [100] * 40)) == {''}


def test_a_node_that_hears_nobody_although_others_are_there_is_deaf(pair):
    said = pair.silent(40)
    assert said.index('deaf: nothing arrives from any node') == 31


def test_a_node_that_hears_no_more_after_it_heard_others_is_deaf_too(pair):
    """It happened in flight: one message still came, and none from the node that publishes the input."""
    said = pair.silent(40, [0, 0, 0, 0, 0, 0])
    assert said.index('deaf: nothing arrives from any node') == 34


def test_a_port_of_shared_memory_that_was_replaced_is_noticed_when_an_input_stops(pair):
    """As Fast DDS replaces it: another process opens a new one under the same name."""
    # Threads give themselves their names.
    pair.graph.spin_until(listening)
    (port, *_) = listening()
    assert pair.hearing.look(stopped=True) == ''
    (SHARED / f'fastrtps_port{port}').unlink()
    assert pair.hearing.look(stopped=False) == ''
    assert pair.hearing.look(stopped=True) == f'deaf: port {port} of the shared memory has been replaced'


def listening():
    """Numbers of the ports of shared memory that threads of this process listen to."""
    names = [file.read_text().strip() for file in Path('/proc/self/task').glob('*/comm')]
    return [name.removeprefix('dds.shm.') for name in names if name.startswith('dds.shm.') and name[8:].isdigit()]


def test_a_message_ends_the_suspicion(pair):
    pair.silent(6, [100, 130, 130, 130, 130, 140])
    pair.graph.send('imu/data', Imu())
    assert pair.hearing.look(stopped=False) == ''
    # Nothing is subscribed to for longer than that.
    pair.graph.spin_until(lambda: pair.diagnostics.listeners == 1)
    assert set(pair.silent(2)) == {''}


PROGRAM = """
from pathlib import Path
import sys
from support.empty_stage import EmptyStage
from thermal_fiducial.ros.run import run

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
    assert done.returncode in (7, -signal.SIGPROF)
