"""The nodes of a second camera, in its namespace, as the launch files start them."""

from thermal_fiducial.config import SHARED_WITH_SECOND_CAMERA


def kind_of(node: str) -> str:
    """Name of a node without its namespace."""
    return node.rpartition('/')[2]


def own_arguments(node: str) -> list[str]:
    """Namespace and remaps of a node of a second camera (``NAME/aruco_detector``), for ``--ros-args``; else none."""
    namespace = node.rpartition('/')[0]
    if not namespace:
        return []
    rules = [f'__ns:=/{namespace}', *(f'{topic}:=/{topic}' for topic in SHARED_WITH_SECOND_CAMERA)]
    return [word for rule in rules for word in ('-r', rule)]
