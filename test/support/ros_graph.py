"""Real nodes in a context of their own, with a tester that publishes and listens."""

from contextlib import contextmanager
import time

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.parameter import Parameter

from support.waiting import PATIENCE_S
from thermal_fiducial.ros.base import qos
from thermal_fiducial.ros.base.counting import CountingNode
from thermal_fiducial.ros.process.run import make_executor


class Graph:
    """The nodes of a test; :meth:`spin_until` runs them."""

    def __init__(self, context):
        self.context = context
        self.executor = make_executor(context)
        self.nodes = []
        self.tester = self.added(CountingNode('tester', context=context))
        self._outputs = {}
        self.heard = {}
        self.listen(DiagnosticArray, '/diagnostics')

    def added(self, node):
        """A node, run with the others."""
        self.executor.add_node(node)
        self.nodes.append(node)
        return node

    def add(self, kind, live=False, **parameters):
        overrides = [Parameter(name.replace('__', '.'), value=value) for name, value in parameters.items()]
        return self.added(kind(live=live, context=self.context, parameter_overrides=overrides))

    def listen(self, kind, topic, profile=qos.RESULT):
        """Collect the messages of a topic in ``heard``."""
        messages = self.heard[topic] = []
        self.tester.subscribe(kind, topic, messages.append, profile)

    def send(self, topic, *messages, profile=qos.RESULT):
        """Publish, and wait until every subscription in the graph has it."""
        if topic not in self._outputs:
            self._outputs[topic] = self.tester.advertise(type(messages[0]), topic, profile)
        output = self._outputs[topic]
        readers = [source for node in self.nodes for source in node.inputs if source.topic == output.topic]
        self.spin_until(lambda: output.listeners == len(readers) and all(reader.publishers for reader in readers))
        for message in messages:
            before = [reader.count for reader in readers]
            output.send(message)
            self.spin_until(lambda before=before: all(r.count > n for r, n in zip(readers, before, strict=True)))

    def diagnose(self, node):
        """The node's next diagnostic status: (level, message, figures)."""
        heard = self.heard['/diagnostics']
        count = len(heard)
        output = self.output(node, 'diagnostics')
        self.spin_until(lambda: output.listeners == 1 and self.tester.inputs[0].publishers)
        node.diagnose(0)
        self.spin_until(lambda: len(heard) > count)
        (status,) = heard[-1].status
        return status.level, status.message, {item.key: item.value for item in status.values}

    def published(self, node, topic):
        """How many messages a node has published on a topic."""
        return self.output(node, topic).count

    @staticmethod
    def output(node, topic):
        """What a node publishes on a topic."""
        (output,) = [output for output in node.outputs if output.topic == f'/{topic}']
        return output

    @staticmethod
    def input(node, topic):
        """What a node receives on a topic."""
        (source,) = [source for source in node.inputs if source.topic == f'/{topic}']
        return source

    def spin_until(self, condition):
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            # Short: some inputs are polled by take_waiting, and wake no executor.
            self.executor.spin_once(timeout_sec=0.002)
            for node in self.nodes:
                node.take_waiting()
            assert time.monotonic() < deadline, 'waited in vain'

    def call(self, kind, name, request):
        """Response of a service."""
        client = self.tester.create_client(kind, name)
        self.spin_until(client.service_is_ready)
        future = client.call_async(request)
        self.spin_until(future.done)
        self.tester.destroy_client(client)
        return future.result()


@contextmanager
def ros_graph(*arguments):
    """A graph; ``arguments`` as after ``--ros-args``."""
    context = Context()
    context.init(args=['--ros-args', *arguments])
    graph = Graph(context)
    try:
        yield graph
    finally:
        graph.executor.shutdown()
        for node in graph.nodes:
            node.destroy_node()
        context.try_shutdown()
