"""A node that only looks on, in a context of its own."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rclpy.context import Context
from rclpy.node import Node

from thermal_fiducial.ros.process.run import initialise, made, make_executor, OF_A_COMMAND


@contextmanager
def observer(name: str, ros_arguments: Sequence[str], domain_id: int | None) -> Iterator[tuple[Node, Any]]:
    """A node and the executor that spins it, while the context lasts.

    Parameters
    ----------
    ros_arguments : as after ``--ros-args``

    Raises
    ------
    InputError
        Arguments that ROS cannot read, or names that it refuses.
    """
    context = Context()
    initialise([*OF_A_COMMAND, *ros_arguments], context, domain_id)
    executor = make_executor(context)
    node = made(lambda: Node(name, context=context), context)
    try:
        executor.add_node(node)
        yield node, executor
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
